"""Small scenes for tests of renderers, and what they must look like by closed formulas."""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Camera
from pipeline.render.scene import Ground, Light, Model, Part, Scene, Shot, Surface


def look_at(azimuth: float, zenith: float, distance: float, size=(64, 64), f=(53.3, 53.3), centre=None) -> Camera:
    """A camera that looks at the origin, upright; angles in radians, size (width, height) and f in pixels."""
    position = distance * np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
    z = -position / distance
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    cx, cy = centre or (size[0] / 2, size[1] / 2)
    K = np.array([[f[0], 0, cx], [0, f[1], cy], [0, 0, 1.0]])
    return Camera(size[0], size[1], K, np.zeros(4), R, -R @ position)


def rays(camera: Camera) -> np.ndarray:
    """(H, W, 3) directions through the pixels' centres in the world, with z-depth 1."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    xy = camera.to_normalised(np.stack([x.ravel(), y.ravel()], axis=1))
    directions = np.column_stack([xy, np.ones(len(xy))]) @ camera.R
    return directions.reshape(camera.height, camera.width, 3)


def box_depth(camera: Camera, half) -> np.ndarray:
    """Z-depth of the box |x| <= half around the origin, by slabs; infinite where it is missed."""
    with np.errstate(divide="ignore"):
        t = (np.array([-1.0, 1.0])[:, None, None, None] * half - camera.centre) / rays(camera)
    near, far = t.min(axis=0).max(axis=-1), t.max(axis=0).min(axis=-1)
    return np.where(near <= far, near, np.inf)


def sphere_depth(camera: Camera, radius: float) -> np.ndarray:
    """Z-depth of the sphere around the origin; infinite where it is missed."""
    d, o = rays(camera), camera.centre
    a, b, c = (d * d).sum(-1), d @ o, o @ o - radius**2
    under = b * b - a * c
    return np.where(under >= 0, (-b - np.sqrt(np.maximum(under, 0))) / a, np.inf)


def plane_depth(camera: Camera, height: float) -> np.ndarray:
    """Z-depth of the plane z = height, infinite above the horizon."""
    with np.errstate(divide="ignore"):
        t = (height - camera.centre[2]) / rays(camera)[..., 2]
    return np.where(t > 0, t, np.inf)


def box(half=(0.5, 0.4, 0.3), **look) -> Part:
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(half)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))])
    return Part(corners, faces, **look)


def sphere(radius: float = 0.5, rings: int = 128) -> Part:
    """A UV sphere with its true normals, within radius * (pi / rings)^2 / 8 * 2 of the round one."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.arange(2 * rings) * np.pi / rings, indexing="ij")
    normals = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij"))
    a, b = i * 2 * rings + j, i * 2 * rings + (j + 1) % (2 * rings)
    below_a, below_b = a + 2 * rings, b + 2 * rings
    faces = np.concatenate([np.stack([a, below_a, below_b], 1), np.stack([a, below_b, b], 1)])
    corners = normals[faces]
    whole = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 1e-9
    return Part(normals * radius, faces[whole], normals=normals)


def ground(height: float, albedo=None, **more) -> Ground:
    albedo = np.full((4, 4, 3), 140, np.uint8) if albedo is None else albedo
    return Ground(height, albedo, **more)


def even_light(strength: float = 0.65) -> Light:
    return Light(np.ones((8, 16, 3), np.float32), strength)


def small_scene(*cameras: Camera, part: Part | None = None, on: Ground | None = None, seed: int = 0, **more) -> Scene:
    surface, light = more.get("surface", Surface()), more.get("light", even_light())
    shots = tuple(Shot(camera) for camera in cameras or (look_at(0.3, 1.0, 2.5),))
    return Scene(Model((part or box(),)), surface, on, light, shots, seed)
