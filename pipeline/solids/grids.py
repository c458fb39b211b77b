"""Closed surfaces made of grids of points: turned, swept, lofted and boxed bodies.

A grid is an (m, n, 3) array of points; its outward normal is (next column - this) x (next row - this). z is up. A
grid row given twice in the same place makes a sharp edge: the normals of the two sides are not blended.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from pipeline.geometry import Floats


def spline(points: ArrayLike, count: int) -> Floats:
    """A smooth curve through points (K, D), resampled to (count, D) at equal steps of length (Catmull-Rom)."""
    p = np.asarray(points, dtype=float)
    padded = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    t = np.linspace(0, 1, 24, endpoint=False)[:, None]
    pieces = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(padded, padded[1:], padded[2:], padded[3:], strict=False)
    ]
    fine = np.concatenate([*pieces, p[-1:]])
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    steps = np.linspace(0, length[-1], count)
    return np.stack([np.interp(steps, length, axis) for axis in fine.T], axis=1)


def lathe(profile: ArrayLike, segments: int = 40) -> tuple[Floats, ...]:
    """Turn a profile (K, 2) of radius and height about z. It must run upwards on the outside."""
    radius, height = np.asarray(profile, dtype=float).T
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    angle[-1] = 0  # the seam closes to the bit
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    grid = np.empty((len(radius), len(angle), 3))
    grid[..., :2] = np.maximum(radius, 0)[:, None, None] * ring
    grid[..., 2] = height[:, None]
    return (grid,)


def cylinder(radius: float, low: float, high: float, top_radius: float | None = None) -> tuple[Floats, ...]:
    """A closed cylinder, or a cone's slice, about z."""
    top = radius if top_radius is None else top_radius
    return lathe([(0, low), (radius, low), (radius, low), (top, high), (top, high), (0, high)])


def ellipsoid(radii: ArrayLike, centre: ArrayLike = (0, 0, 0), count: int = 24) -> tuple[Floats, ...]:
    """An ellipsoid with half axes (3,)."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, count)
    (grid,) = lathe(np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return (grid * np.asarray(radii, dtype=float) + np.asarray(centre, dtype=float),)


def box(size: ArrayLike, centre: ArrayLike = (0, 0, 0), bevel: float = 0.1) -> tuple[Floats, ...]:
    """A box of full sizes (3,) with rounded edges of radius `bevel` times the smallest size."""
    half = 0.5 * np.asarray(size, dtype=float)
    radius = 2 * bevel * half.min()
    inner = half - radius
    bend = radius * np.tan(np.radians([0.0, 22.5, 45.0]))
    grids = []
    for axis in range(3):
        for side in (-1, 1):
            # the order of the two other axes decides which way the normal points
            across, along = ((axis + 1) % 3, (axis + 2) % 3)[::side]
            lines = [np.concatenate([-(inner[k] + bend)[::-1], inner[k] + bend]) for k in (across, along)]
            q = np.empty((len(lines[1]), len(lines[0]), 3))
            q[..., axis] = side * half[axis]
            q[..., across], q[..., along] = np.meshgrid(*lines)
            core = np.clip(q, -inner, inner)
            out = q - core
            grids.append(core + radius * out / np.linalg.norm(out, axis=2, keepdims=True))
    return placed(grids, shift=centre)


def sweep(
    path: ArrayLike, radius: ArrayLike, *, flat: float = 1.0, sides: int = 18, sharp: bool = False
) -> tuple[Floats, ...]:
    """A tube along a path (K, 3) with a radius each point, closed at the ends.

    `flat` scales the cross-section at right angles to the path's own plane; `sharp` gives the ends an edge.
    """
    p = np.asarray(path, dtype=float)
    radii = np.broadcast_to(np.asarray(radius, dtype=float), len(p))
    tangent = np.gradient(p, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.empty_like(p)
    bend = p[-1] + p[0] - 2 * p[len(p) // 2]
    start = bend if np.linalg.norm(np.cross(bend, tangent[0])) > 1e-6 else np.eye(3)[np.abs(tangent[0]).argmin()]
    for i, direction in enumerate(tangent):  # parallel transport: the frame never twists
        start = start - direction * (start @ direction)
        normal[i] = start = start / np.linalg.norm(start)
    binormal = np.cross(tangent, normal)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    angle[-1] = 0
    ring = np.cos(angle)[:, None] * normal[:, None] + flat * np.sin(angle)[:, None] * binormal[:, None]
    return (capped(p[:, None] + radii[:, None, None] * ring, sharp=sharp),)


def loft(stations: ArrayLike, *, power: float = 2.0, sides: int = 32, axis: int = 0) -> tuple[Floats, ...]:
    """A body along x (axis 0) or y (axis 1) through superellipses, closed at the ends.

    Args:
        stations: (K, 5): position along the axis, centre and half size across, centre and half height.
        power: 2 = ellipses; larger = boxier.
    """
    s = np.asarray(stations, dtype=float)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    angle[-1] = 0
    cosine, sine = np.cos(angle), np.sin(angle)
    across = np.sign(cosine) * np.abs(cosine) ** (2 / power)
    up = np.sign(sine) * np.abs(sine) ** (2 / power)
    grid: Floats = np.empty((len(s), sides + 1, 3))
    grid[..., 0] = s[:, :1]
    grid[..., 1] = s[:, 1:2] + s[:, 2:3] * across
    grid[..., 2] = s[:, 3:4] + s[:, 4:5] * up
    grid = capped(grid, sharp=True)
    if axis == 1:
        grid = np.stack([-grid[..., 1], grid[..., 0], grid[..., 2]], axis=2)
    return (grid,)


def capped(grid: Floats, *, sharp: bool) -> Floats:
    """Close a tube-like grid at both ends with a fan about the rings' centres."""
    ends = [np.broadcast_to(ring[:-1].mean(0), ring.shape)[None] for ring in (grid[0], grid[-1])]
    rims = [grid[:1], grid[-1:]] if sharp else [grid[:0], grid[:0]]
    return np.concatenate([ends[0], rims[0], grid, rims[1], ends[1]])


def placed(
    grids: Iterable[Floats], *, shift: ArrayLike = (0, 0, 0), turn: Floats | None = None, scale: ArrayLike = 1.0
) -> tuple[Floats, ...]:
    """The same surface scaled, then turned by a rotation (3, 3), then shifted."""
    rotation = np.eye(3) if turn is None else turn
    return tuple((grid * np.asarray(scale)) @ rotation.T + np.asarray(shift, dtype=float) for grid in grids)


def turn_about(axis: int, degrees: float) -> Floats:
    """The rotation (3, 3) about a coordinate axis by the right-hand rule."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation[[i, j], [i, j]] = c
    rotation[i, j], rotation[j, i] = -s, s
    return rotation


def joined(*bodies: Sequence[Floats]) -> tuple[Floats, ...]:
    """Several bodies as one tuple of grids."""
    return tuple(grid for body in bodies for grid in body)
