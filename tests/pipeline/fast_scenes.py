"""Small scenes for the tests of renderers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dope.common.errors import DopeError
from pipeline.geometry import Camera
from pipeline.render.config import FastConfig
from pipeline.render.fast import FastRenderer
from pipeline.render.scene import Ground, Light, Model, Part, Picture, Scene, Shot, Surface


def camera_at(
    azimuth_deg: float, zenith_deg: float, distance: float, target: Any = (0, 0, 0), size: tuple[int, int] = (96, 96)
) -> Camera:
    """Looks at `target` from a distance, at a focal length of 5/6 of the width."""
    a, z = np.radians([azimuth_deg, zenith_deg])
    ahead = -np.array([np.cos(a) * np.sin(z), np.sin(a) * np.sin(z), np.cos(z)])
    centre = np.asarray(target, float) - distance * ahead
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(ahead, right), ahead])
    f = size[0] * 5 / 6
    K = np.array([[f, 0, size[0] / 2], [0, f, size[1] / 2], [0, 0, 1]])
    return Camera(*size, K, np.zeros(4), R, -R @ centre)


def looking(direction: Any, size: tuple[int, int] = (64, 64), focal: float = 200.0) -> Camera:
    """At the origin, looking along a direction that is not vertical, z up."""
    ahead = np.asarray(direction, float) / np.linalg.norm(direction)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    return Camera(*size, K, np.zeros(4), np.stack([right, np.cross(ahead, right), ahead]), np.zeros(3))


def box(half: Any = (0.5, 0.3, 0.2), middle: Any = (0, 0, 0), **look: Any) -> Part:
    """12 faces, each corner shared."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return Part(corners * half + middle, np.array(faces), **look)


def sphere(radius: float = 0.5, rings: int = 96, **look: Any) -> Part:
    """Latitudes and longitudes; its faces at the poles have no area."""
    polar, around = np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings + 1)
    p, a = np.meshgrid(polar, around, indexing="ij")
    xyz = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1).reshape(-1, 3)
    n = 2 * rings + 1
    first = (np.arange(rings)[:, None] * n + np.arange(2 * rings)).ravel()
    faces = np.concatenate(
        [np.stack([first, first + n, first + 1], 1), np.stack([first + 1, first + n, first + n + 1], 1)]
    )
    return Part(radius * xyz, faces, normals=xyz, **look)


def panorama(fill: Any = 1.0, rows: int = 64) -> np.ndarray:
    return np.full((rows, 2 * rows, 3), fill, np.float32)


def sunny(azimuth_deg: float, elevation_deg: float, power: float = 400.0, rows: int = 64) -> np.ndarray:
    """An even sky with a sun of about 6 degrees."""
    sky = panorama(1.0, rows)
    row = round((90 - elevation_deg) / 180 * rows)
    column = round((0.5 - azimuth_deg / 360) * 2 * rows) % (2 * rows)
    sky[row - 1 : row + 1, [column - 1, column]] = power
    return sky


def checker(side: int = 64, cells: int = 4) -> np.ndarray:
    y, x = np.mgrid[:side, :side] * cells // side
    return np.where(((x + y) % 2)[..., None] > 0, 200, 60).repeat(3, axis=2).astype(np.uint8)


def scene(*parts: Part, cameras: Any = (), **more: Any) -> Scene:
    """A grey scene under an even sky without a ground, but for what is given."""
    cameras = [cameras] if isinstance(cameras, Camera) else cameras
    given: dict[str, Any] = {"surface": Surface("own"), "ground": None, "light": Light(panorama())}
    shots = tuple(camera if isinstance(camera, Shot) else Shot(camera) for camera in cameras)
    return Scene(Model(parts), **(given | more), shots=shots)


def plain_ground(height: float, **more: Any) -> Ground:
    return replace(Ground(height, np.full((8, 8, 3), 128, np.uint8)), **more)


def rays(camera: Camera) -> np.ndarray:
    """World directions (H, W, 3) of the pixels' centres, whose z-depth is 1."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.K).T @ camera.R


def box_depth(camera: Camera, half: Any, middle: Any = (0, 0, 0)) -> np.ndarray:
    """z-depth (H, W) at which the rays enter a box, or leave it where the camera is inside; 0 where they miss it."""
    with np.errstate(divide="ignore"):
        walls = np.stack([(np.asarray(middle) + s * np.asarray(half) - camera.centre) / rays(camera) for s in (-1, 1)])
    enter, leave = walls.min(axis=0).max(axis=-1), walls.max(axis=0).min(axis=-1)
    return np.where(enter < leave, np.where(enter > 0, enter, np.maximum(leave, 0)), 0)


def sphere_depth(camera: Camera, radius: float) -> np.ndarray:
    """z-depth (H, W) of a sphere around the origin, 0 where the rays miss it."""
    d, o = rays(camera), camera.centre
    a, b, c = (d * d).sum(-1), d @ o, o @ o - radius**2
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)


def make(supersample: int = 1) -> FastRenderer:
    try:
        return FastRenderer(FastConfig(supersample=supersample))
    except DopeError as error:
        pytest.skip(f"no OpenGL here: {error}")


def one(renderer: FastRenderer, given: Scene) -> Picture:
    (picture,) = renderer.render(given)
    return picture
