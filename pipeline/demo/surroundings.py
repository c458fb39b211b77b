"""What stands around the object: a room with floor, walls and a mat, and clutter that never hides the object."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.demo.light import Light
from pipeline.demo.raster import Panel
from pipeline.demo.textures import painted_plane
from pipeline.geometry import Floats
from pipeline.solids.grids import box, cylinder, ellipsoid, placed, turn_about

ROOM_RADIUS, ROOM_WALLS = 5.6, 6
NEAR_RING, FAR_RING = (0.95, 1.5), (3.7, 4.9)
"""Distances from the object at which things stand around; the camera moves between the two rings."""
LOWEST_ELEVATION_DEG = 22.0
"""Nothing hides the object from a camera at or above this elevation: near things are kept low enough."""


def clutter(rng: np.random.Generator, object_reach: float) -> list[tuple[Floats, ...]]:
    """Boxes, balls, drums and cones around the object, none standing between it and a camera."""
    slope = np.tan(np.radians(LOWEST_ELEVATION_DEG))
    placed_at: list[tuple[Floats, float]] = []
    things: list[tuple[Floats, ...]] = []
    for ring, count, sizes in ((NEAR_RING, 9, (0.09, 0.17)), (FAR_RING, 11, (0.2, 0.5))):
        for _ in range(count * 6):
            if len(things) >= (9 if ring is NEAR_RING else 20):
                break
            radius, angle, distance = rng.uniform(*sizes), rng.uniform(0, 2 * np.pi), rng.uniform(*ring)
            at = distance * np.array([np.cos(angle), np.sin(angle)])
            if any(np.linalg.norm(at - other) < 1.1 * (radius + r) for other, r in placed_at):
                continue
            tall = radius * rng.uniform(0.6, 2.6)
            if ring is NEAR_RING:
                tall = min(tall, (distance - radius - object_reach) * slope)
                if tall < 0.03:
                    continue
            placed_at.append((at, radius))
            things.append(_thing(rng, radius, tall, at))
    return things


def _thing(rng: np.random.Generator, radius: float, tall: float, at: Floats) -> tuple[Floats, ...]:
    """One piece of clutter that fits a cylinder of that radius and height."""
    match rng.integers(4):
        case 0:
            size = np.array([np.cos(a := rng.uniform(0.5, 1.0)), np.sin(a), 0]) * 2 * radius
            grids = box(size + np.array([0, 0, tall]), (0, 0, tall / 2), 0.06)
        case 1:
            grids = cylinder(radius, 0, tall)
        case 2:
            ball = min(radius, tall / 2)
            grids = ellipsoid((ball, ball, ball), (0, 0, ball))
        case _:
            grids = cylinder(radius, 0, tall, radius * rng.uniform(0.2, 0.7))
    return placed(grids, turn=turn_about(2, float(rng.uniform(0, 360))), shift=(*at, 0))


def room(
    rng: np.random.Generator, light: Light, vertices: Floats, faces: NDArray[np.int64], detail: float
) -> tuple[Panel, ...]:
    """Floor, walls and the mat under the object, with light and shadows."""
    x, y, z = np.eye(3)
    corners = (np.arange(ROOM_WALLS) + 0.5) * 2 * np.pi / ROOM_WALLS
    outer = ROOM_RADIUS / np.cos(np.pi / ROOM_WALLS)
    ring = np.stack([outer * np.cos(corners), outer * np.sin(corners), np.zeros(ROOM_WALLS)], axis=1)

    def ground(half: float, texels: float, step: float, style: str, outline: Floats) -> Panel:
        side = int(2 * half * texels)
        picture = painted_plane(rng, side, side, int(step * texels), style)
        bare = Panel(np.array([-half, -half, 0]), x / texels, y / texels, outline, picture)
        return Panel(bare.origin, bare.right, bare.down, outline, light.on_ground(bare, vertices, faces))

    panels = [ground(outer, 130 * detail, 0.385, str(rng.choice(["tiles", "boards"])), ring)]
    texels, tall = 120 * detail, 3.4
    for first, second in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        width = float(np.linalg.norm(second - first))
        picture = painted_plane(rng, int(tall * texels), int(width * texels), int(0.75 * texels), "paper")
        shade = rng.uniform(0.7, 1.0)
        right = (second - first) / width / texels
        outline = np.array([first, second, second + 12 * z, first + 12 * z])
        panels.append(Panel(first + tall * z, right, -z / texels, outline, (picture * shade).astype(np.uint8)))
    half = 1.75
    mat = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    style = str(rng.choice(["shapes", "tiles", "boards"]))
    panels.append(ground(half, 380 * detail, rng.uniform(0.16, 0.32), style, mat))
    return tuple(panels)
