"""Polygons to triangles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.geometry import Floats

Indices = NDArray[np.int64]
MOST_CORNERS = 2000
"""Of a face that is not convex; cutting it up takes time with the square of them."""


def triangulate(corners: Floats, sizes: Indices, path: Path) -> tuple[Indices, Indices]:
    """Cut polygons into triangles that cover them, also where they are not convex.

    Args:
        corners: (N, 3) positions of the corners of all polygons, one polygon after the other.
        sizes: (P,) corners of each; those of fewer than three are left out.

    Returns:
        (F, 3) rows of `corners`, and (F,) the polygon of each triangle, in the order of the polygons.
    """
    if len(sizes) and (sizes == 3).all():
        return np.arange(3 * len(sizes)).reshape(-1, 3), np.arange(len(sizes))
    starts = np.cumsum(sizes) - sizes
    found: list[Indices] = [starts[sizes == 3, None] + np.arange(3)]
    owners: list[Indices] = [np.nonzero(sizes == 3)[0]]
    quads = np.nonzero(sizes == 4)[0]
    if len(quads):
        found.append(_cut_quads(corners, starts[quads]))
        owners.append(np.repeat(quads, 2))
    for polygon in np.nonzero(sizes > 4)[0]:
        start, size = starts[polygon], sizes[polygon]
        cut = _cut(corners[start : start + size], path)
        found.append(cut + start)
        owners.append(np.full(len(cut), polygon))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(found)[order], owner[order]


def _cut_quads(corners: Floats, starts: Indices) -> Indices:
    """Along the diagonal whose two triangles look the same way; the first one where both do."""
    p = corners[starts[:, None] + np.arange(4)]

    def agreement(a: tuple[int, int, int], b: tuple[int, int, int]) -> Floats:
        n = [np.cross(p[:, j] - p[:, i], p[:, k] - p[:, i]) for i, j, k in (a, b)]
        return np.einsum("ij,ij->i", n[0], n[1])

    first = np.array([[0, 1, 2], [0, 2, 3]])
    other = np.array([[1, 2, 3], [1, 3, 0]])
    with np.errstate(all="ignore"):  # what is not finite is refused later
        turned = (agreement((0, 1, 2), (0, 2, 3)) < 0) & (agreement((1, 2, 3), (1, 3, 0)) > 0)
    return (starts[:, None, None] + np.where(turned[:, None, None], other, first)).reshape(-1, 3)


def _cut(points: Floats, path: Path) -> Indices:
    """A fan where the polygon is convex, else its ears one by one."""
    count = len(points)
    fan = np.stack([np.zeros(count - 2, np.int64), np.arange(1, count - 1), np.arange(2, count)], axis=1)
    if not np.isfinite(points).all():
        return fan
    following = np.roll(points, -1, axis=0)
    normal = np.cross(points - points[0], following - points[0]).sum(axis=0)  # Newell's
    axis = int(np.abs(normal).argmax())
    flat = np.delete(points, axis, axis=1) * (1.0, -1.0 if axis == 1 else 1.0)  # x, z turn against y
    flat = flat if normal[axis] >= 0 else flat[:, ::-1]
    edges = np.roll(flat, -1, axis=0) - flat
    before = np.roll(edges, 1, axis=0)
    turns = np.arctan2(_cross(before, edges), (before * edges).sum(axis=1))
    if turns.min() >= -1e-9 and turns.sum() < 7:  # once round: 2 pi
        return fan
    if count > MOST_CORNERS:
        what = f"has a face with {count} corners that is not convex"
        raise BadInput(what, where=path, remedy="Triangulate it in the program that made it")
    return _ears(flat)


def _ears(flat: Floats) -> Indices:
    left = list(range(len(flat)))
    found: list[tuple[int, int, int]] = []
    while len(left) > 3:
        at = next((i for i in range(len(left)) if _is_ear(flat, left, i)), 0)  # crossing itself: any
        found.append((left[at - 1], left[at], left[(at + 1) % len(left)]))
        del left[at]
    return np.array([*found, tuple(left)], dtype=np.int64)


def _is_ear(flat: Floats, left: list[int], at: int) -> bool:
    a, b, c = flat[left[at - 1]], flat[left[at]], flat[left[(at + 1) % len(left)]]
    if _cross(b - a, c - b) <= 0:
        return False
    others = flat[left]
    inside = (_cross(b - a, others - a) >= 0) & (_cross(c - b, others - b) >= 0) & (_cross(a - c, others - c) >= 0)
    same = (others == a).all(axis=1) | (others == b).all(axis=1) | (others == c).all(axis=1)
    return not bool((inside & ~same).any())


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
