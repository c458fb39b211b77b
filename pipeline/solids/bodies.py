"""Closed bodies as meshes: extruded outlines with holes, sections drawn along paths, turned profiles, superquadrics."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.geometry import Floats
from pipeline.solids import grids
from pipeline.solids.mesh import Mesh, outward, welded
from pipeline.solids.outlines import circle, finer, inset, rectangle, rounded
from pipeline.solids.triangulate import triangulate


def extrude(
    outline: Floats,
    height: float,
    *,
    holes: Sequence[Floats] = (),
    bevel: float = 0.0,
    bevel_steps: int = 1,
    levels: int = 1,
    top: ArrayLike = 1.0,
    twist_deg: float = 0.0,
) -> Mesh:
    """A prism over an outline, from z = 0 to `height`.

    Args:
        outline: (N, 2) counter-clockwise.
        holes: (M, 2) each, counter-clockwise, inside of the outline.
        bevel: width of the slope along the edges of both ends; more than one step makes it round.
        levels: pieces the height is cut into.
        top: scale of the top end, one or along x and y; between the ends it changes evenly.
        twist_deg: by how much the top is turned.
    """
    loops = [outline, *(hole[::-1] for hole in holes)]
    if twist_deg:  # long sides would be too warped for two triangles
        loops = [finer(loop, 0.25 * float(np.abs(outline).max())) for loop in loops]
    starts = np.cumsum([0, *(len(loop) for loop in loops)])
    flat = np.concatenate(loops)
    rings: list[tuple[float, Floats]] = [(z, flat) for z in np.linspace(0, 1, levels + 1)]
    if bevel > 0:
        angle = np.linspace(0, np.pi / 2, bevel_steps + 1)[:-1]
        depth = min(bevel / height, 0.45)
        edge = [
            (depth * (1 - np.cos(a)), np.concatenate([inset(loop, bevel * (1 - np.sin(a))) for loop in loops]))
            for a in angle
        ]
        inner = [(depth + (1 - 2 * depth) * z, flat) for z in np.linspace(0, 1, levels + 1)]
        rings = [*edge, *inner, *((1 - z, ring) for z, ring in edge[::-1])]
    end_scale = np.broadcast_to(np.asarray(top, dtype=float), 2)
    points = []
    for z, ring in rings:
        c, s = np.cos(np.radians(twist_deg) * z), np.sin(np.radians(twist_deg) * z)
        plane = (ring * (1 + (end_scale - 1) * z)) @ np.array([[c, s], [-s, c]])
        points.append(np.concatenate([plane, np.full((len(plane), 1), height * z)], axis=1))
    end = rings[0][1]
    cap = triangulate(end[: starts[1]], [end[a:b] for a, b in pairwise(starts[1:])])
    ahead = np.concatenate([np.roll(np.arange(a, b), -1) for a, b in pairwise(starts)])
    return _tube(np.stack(points), ahead, cap)


def _tube(rings: Floats, ahead: NDArray[np.int64], cap: NDArray[np.int64] | None) -> Mesh:
    """Walls between rings (L, P, 3) of the same points, `ahead` (P,) each one's neighbour; ends closed by `cap`.

    Without a cap the last ring leads back to the first.
    """
    n_rings, count = rings.shape[:2]
    low = np.arange(n_rings if cap is None else n_rings - 1)[:, None] * count
    high = (low + count) % (n_rings * count)
    vertices = rings.reshape(-1, 3)
    a, b, c, d = (
        index.ravel() for index in (low + np.arange(count), low + ahead, high + ahead, high + np.arange(count))
    )
    ac, bd = (np.linalg.norm(vertices[p] - vertices[q], axis=1) for p, q in ((a, c), (b, d)))
    other = bd < (1 - 1e-6) * ac  # cut along the shorter diagonal: sheared walls would be ragged
    walls = [np.stack([a, b, np.where(other, d, c)], axis=1), np.stack([np.where(other, b, a), c, d], axis=1)]
    ends = [] if cap is None else [cap[:, ::-1], cap + (n_rings - 1) * count]
    return Mesh(vertices, np.concatenate([*walls, *ends]))


def along(
    path: ArrayLike,
    section: Floats,
    *,
    closed: bool = False,
    scale: ArrayLike = 1.0,
    twist_deg: float = 0.0,
    up: ArrayLike | None = None,
) -> Mesh:
    """A section (S, 2), counter-clockwise, drawn along a path (K, 3); sharp bends are mitred.

    Args:
        closed: the path leads back to its first point, which is not given twice.
        scale: of the section, one or one a point.
        twist_deg: turn of the section on its way, evenly; a closed path wants the section's symmetry to allow it.
        up: the section's y at the path's beginning, as far as it is across it; None: any direction.
    """
    p = np.asarray(path, dtype=float)
    steps = np.diff(np.concatenate([p, p[:1]]) if closed else p, axis=0)
    steps = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    guess = np.eye(3)[np.abs(steps[0]).argmin()] if up is None else np.asarray(up, dtype=float)
    y = _across(guess, steps[0])
    if np.linalg.norm(y) < 1e-6:
        y = np.eye(3)[np.abs(steps[0]).argmin()]
    ys = []
    for i, step in enumerate(steps):  # parallel transport from one piece of the path to the next
        if i:
            y = _transported(y, steps[i - 1], step)
        y = _across(y, step)
        y = y / np.linalg.norm(y)
        ys.append(y)
    turns = np.radians(twist_deg) * np.linspace(0, 1, len(p) + closed)[: len(p)]
    if closed:  # what the frame turned by on its way round is given back evenly
        last = _transported(ys[-1], steps[-1], steps[0])
        back = np.arctan2(np.cross(ys[0], last) @ steps[0], ys[0] @ last)
        turns = turns - back * np.linspace(0, 1, len(p), endpoint=False)
    factor = np.broadcast_to(np.asarray(scale, dtype=float), len(p))
    rings = np.empty((len(p), len(section), 3))
    for i in range(len(p)):
        k = min(i, len(steps) - 1) if not closed else i
        other = steps[i - 1] if i or closed else steps[0]
        x = np.cross(ys[k], steps[k])
        c, s = np.cos(turns[i]) * factor[i], np.sin(turns[i]) * factor[i]
        offset = section @ np.array([c * x + s * ys[k], c * ys[k] - s * x])
        bisector = other + steps[k]
        slide = (offset @ bisector) / (steps[k] @ bisector)
        rings[i] = p[i] + offset - slide[:, None] * steps[k]
    ahead = np.roll(np.arange(len(section)), -1)
    return outward(_tube(rings, ahead, None if closed else triangulate(section)))


def _across(v: Floats, direction: Floats) -> Floats:
    return np.asarray(v - direction * (v @ direction))


def _transported(v: Floats, a: Floats, b: Floats) -> Floats:
    """v after the smallest rotation that takes unit vector a to b."""
    axis, cosine = np.cross(a, b), a @ b
    if cosine < -0.999:
        return v
    return np.asarray(v * cosine + np.cross(axis, v) + axis * (axis @ v) / (1 + cosine))


def tube(path: ArrayLike, radius: ArrayLike, *, sides: int = 14, closed: bool = False) -> Mesh:
    """A round bar along a path, with a radius or one a point."""
    return along(path, circle(1.0, sides), closed=closed, scale=radius)


def turned_body(profile: ArrayLike, segments: int = 40) -> Mesh:
    """A profile (K, 2) of radius and height turned about z.

    It begins and ends on the axis, or its last point is its first and it goes round beside the axis.
    """
    mesh = welded(grids.lathe(profile, segments))
    return outward(mesh)


def cylinder(radius: float, height: float, *, top: float = 1.0, bevel: float = 0.0, segments: int = 32) -> Mesh:
    """A cylinder from z = 0 about the z axis, or with a `top` other than 1 a cone's slice."""
    return extrude(circle(radius, segments), height, bevel=bevel, top=top)


def pipe(radius: float, inner: float, height: float, *, segments: int = 32) -> Mesh:
    """A hollow cylinder from z = 0."""
    profile = [(inner, 0), (radius, 0), (radius, height), (inner, height), (inner, 0)]
    return turned_body(profile, segments)


def ring(radius: float, thick: float, *, segments: int = 32, sides: int = 12) -> Mesh:
    """A torus in the plane z = 0: radius of its middle line and of its bar."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    angle[-1] = 0
    return turned_body(np.stack([radius + thick * np.cos(angle), thick * np.sin(angle)], axis=1), segments)


def ball(radius: ArrayLike, *, count: int = 16) -> Mesh:
    """An ellipsoid with one or three half axes about the origin."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, count)
    profile = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    profile[[0, -1], 0] = 0
    return turned_body(profile, 2 * count - 2).scaled(radius)


def block(size: ArrayLike, *, bevel: float = 0.0) -> Mesh:
    """A box from z = 0, centred about the z axis, its edges cut off by `bevel`."""
    x, y, z = np.asarray(size, dtype=float)
    bevel = min(bevel, 0.3 * min(x, y, z))
    if bevel <= 0:
        return extrude(rectangle(x, y), z)
    return extrude(rounded(rectangle(x, y), bevel, steps=1), z, bevel=0.6 * bevel)


def soft_box(size: ArrayLike, round_share: float) -> Mesh:
    """A box from z = 0, centred about the z axis, its edges rounded: 0.5 = the smallest side is all round."""
    mesh = welded(grids.box(size, bevel=min(round_share, 0.49)))
    return mesh.at(z=0.5 * float(np.asarray(size, dtype=float)[2]))


def superquadric(radii: ArrayLike, power_round: float, power_up: float, *, rows: int = 24, columns: int = 40) -> Mesh:
    """A superellipsoid (Barr 1981) about the origin; powers 2 = ellipsoid, larger = boxier, 1 = octahedral."""
    v = np.linspace(-np.pi / 2, np.pi / 2, rows)
    u = np.linspace(0, 2 * np.pi, columns + 1)
    u[-1] = 0
    across = _on_curve(v, power_up)
    across[[0, -1], 0] = 0
    around = _on_curve(u, power_round)
    grid = np.empty((rows, columns + 1, 3))
    grid[..., :2] = across[:, None, :1] * around
    grid[..., 2] = across[:, 1:]
    return welded([grid]).scaled(radii)


def supertoroid(
    radius: float, half: ArrayLike, power_round: float, power_up: float, *, rows: int = 20, columns: int = 48
) -> Mesh:
    """A ring (Barr 1981) of middle radius `radius` whose section has half sizes (2,) across and up."""
    v, u = np.linspace(0, 2 * np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns + 1)
    v[-1] = u[-1] = 0
    section = _on_curve(v, power_up) * np.asarray(half, dtype=float)
    around = _on_curve(u, power_round)
    grid = np.empty((rows + 1, columns + 1, 3))
    grid[..., :2] = (radius + section[:, None, :1]) * around
    grid[..., 2] = section[:, 1:]
    return outward(welded([grid]))


def _on_curve(angle: Floats, power: float) -> Floats:
    """Points (N, 2) of the superellipse |x|^p + |y|^p = 1 in these directions."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c, s], axis=1) * ((np.abs(c) ** power + np.abs(s) ** power) ** (-1 / power))[:, None]
