"""A scene with known depth: a textured ball and box before a textured wall, filmed by cameras on an arc.

Rays are cast through every pixel (four a pixel, against aliasing), and the texture is noise evaluated at the point that
a ray hits, so that views agree as photographs of one thing do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry import Camera, Floats

BALL_CENTRE, BALL_RADIUS = np.array([0.0, 0.0, 0.0]), 1.0
BOX_LOW, BOX_HIGH = np.array([0.5, 0.2, -1.3]), np.array([1.4, 1.3, -0.3])
WALL_Z = 2.5


@dataclass(frozen=True)
class Rendered:
    """image (h, w) uint8, true z-depth (h, w) float32, mask (h, w) bool of ball and box."""

    camera: Camera
    image: np.ndarray
    depth: np.ndarray
    mask: np.ndarray


def look_at(
    centre: Floats, target: Floats, *, width: int, height: int, focal: float, roll_deg: float = 0.0, distortion: Floats
) -> Camera:
    """A camera at `centre` that looks at `target`, world y down, turned by `roll_deg` about its axis."""
    z = (target - centre) / np.linalg.norm(target - centre)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ R
    K = np.array([[focal, 0, width / 2 + 3.3], [0, focal * 1.01, height / 2 - 2.1], [0, 0, 1]])
    return Camera(width, height, K, np.asarray(distortion, float), R, -R @ centre)


def arc(
    angles_deg: list[float],
    *,
    width: int = 320,
    height: int = 240,
    focal: float = 340.0,
    vertical: bool = False,
    roll_deg: float = 0.0,
    distortion: tuple[float, ...] = (0.06, -0.08, 0.001, -0.0005),
    distance: float = 4.0,
) -> list[Camera]:
    """Cameras on an arc (horizontal or vertical) around the ball, in front of the wall."""
    cameras = []
    for angle in np.radians(angles_deg):
        offset = [0.0, np.sin(angle), -np.cos(angle)] if vertical else [np.sin(angle), -0.15, -np.cos(angle)]
        cameras.append(
            look_at(
                distance * np.array(offset),
                np.array([0.1, 0.1, 0.0]),
                width=width,
                height=height,
                focal=focal,
                roll_deg=roll_deg,
                distortion=np.array(distortion),
            )
        )
    return cameras


def render(camera: Camera) -> Rendered:
    """Cast four rays a pixel for the image and one through the pixel's centre for depth and mask."""
    depth, mask, _ = _cast(camera, 0.5, 0.5)
    shades = [_cast(camera, dx, dy)[2] for dx in (0.25, 0.75) for dy in (0.25, 0.75)]
    image = np.clip(np.mean(shades, axis=0) * 255, 0, 255).astype(np.uint8)
    return Rendered(camera, image, depth.astype(np.float32), mask)


def _cast(camera: Camera, dx: float, dy: float) -> tuple[Floats, np.ndarray, Floats]:
    x, y = np.meshgrid(np.arange(camera.width) + dx, np.arange(camera.height) + dy)
    xy = camera.to_normalised(np.stack([x.ravel(), y.ravel()], axis=1))
    directions = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ camera.R  # z-depth is the parameter
    origin = camera.centre
    wall = (WALL_Z - origin[2]) / directions[:, 2]
    ball, box = _ball(origin, directions), _box(origin, directions)
    nearest = np.minimum(np.minimum(ball, box), wall)
    hits = origin + directions * nearest[:, None]
    shape = (camera.height, camera.width)
    on_object = np.minimum(ball, box) < wall
    return nearest.reshape(shape), on_object.reshape(shape), noise(hits).reshape(shape)


def _ball(origin: Floats, directions: Floats) -> Floats:
    offset = origin - BALL_CENTRE
    a, b = (directions**2).sum(1), directions @ offset
    root = b * b - a * (offset @ offset - BALL_RADIUS**2)
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def _box(origin: Floats, directions: Floats) -> Floats:
    first, second = (BOX_LOW - origin) / directions, (BOX_HIGH - origin) / directions
    enter, leave = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def noise(points: Floats) -> Floats:
    """Smooth value noise in [0, 1] of points (N, 3): five octaves of trilinear interpolation of a hashed lattice."""
    total, weight = np.zeros(len(points)), 0.0
    for octave in range(5):
        frequency = 3.0 * 2**octave
        scaled = points * frequency + 17.3 * octave
        base = np.floor(scaled).astype(np.int64)
        f = scaled - base
        f = f * f * (3 - 2 * f)
        value = np.zeros(len(points))
        for corner in np.ndindex(2, 2, 2):
            share = np.prod(np.where(corner, f, 1 - f), axis=1)
            value += share * _hash(base + np.array(corner))
        total += 0.75**octave * value
        weight += 0.75**octave
    return np.clip((total / weight - 0.5) * 2.2 + 0.5, 0, 1)


def _hash(cells: np.ndarray) -> Floats:
    h = (cells * np.array([73856093, 19349663, 83492791])).sum(axis=1).astype(np.uint64)
    for shift, factor in ((33, 0xFF51AFD7ED558CCD), (33, 0xC4CEB9FE1A85EC53)):
        h = (h ^ (h >> np.uint64(shift))) * np.uint64(factor)
    return (h >> np.uint64(40)).astype(float) / 2**24


def surface_points(rendered: Rendered, count: int, seed: int = 0) -> Floats:
    """Random world points (count, 3) that a view sees, wall included: what a reconstruction would give."""
    rng = np.random.default_rng(seed)
    index = rng.choice(rendered.depth.size, count, replace=False)
    y, x = np.unravel_index(index, rendered.depth.shape)
    return rendered.camera.unproject(np.stack([x, y], axis=1) + 0.5, rendered.depth[y, x])
