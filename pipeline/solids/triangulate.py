"""Polygons with holes to triangles by ear clipping; holes are first tied to the outline by bridges (Eberly 2002)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Floats


def triangulate(outline: Floats, holes: Sequence[Floats] = ()) -> NDArray[np.int64]:
    """Triangles (T, 3), counter-clockwise, that fill a polygon: indices into the outline's and then the holes' points.

    Every edge of outline and holes is the edge of one triangle, and no points are added, so walls fit to it without
    cracks.

    Args:
        outline: (N, 2) counter-clockwise, not crossing itself.
        holes: (M, 2) each, clockwise, inside of the outline and outside of each other.
    """
    points = np.concatenate([outline, *holes])
    starts = np.cumsum([0, len(outline), *(len(hole) for hole in holes)])
    loops = [list(range(a, b)) for a, b in pairwise(starts)]
    ring, waiting = loops[0], loops[1:]
    # from right to left: a hole's bridge then has the ring, not another hole, nearby
    waiting.sort(key=lambda loop: -points[loop, 0].max())
    while waiting:
        ring = _bridged(points, ring, waiting.pop(0), waiting)
    return np.array(_clip(points[:, 0].tolist(), points[:, 1].tolist(), ring), np.int64).reshape(-1, 3)


def _bridged(points: Floats, ring: list[int], hole: list[int], others: Sequence[list[int]]) -> list[int]:
    """The ring with a hole inserted by a two-way bridge from the hole's rightmost point to the nearest it can see."""
    first = int(np.argmax(points[hole, 0]))
    hole = hole[first:] + hole[:first]
    start = points[hole[0]]
    loops = [np.array(loop) for loop in (ring, hole, *others)]
    a = np.concatenate(loops)
    b = np.concatenate([np.roll(loop, -1) for loop in loops])
    at = points[ring]
    before, after = np.roll(at, 1, 0), np.roll(at, -1, 0)
    convex = _turn(before, at, after) >= 0
    left, right = _turn(before, at, start) > 0, _turn(at, after, start) > 0
    inside = np.where(convex, left & right, left | right)  # the corner opens towards the hole
    order = np.argsort(((at - start) ** 2).sum(1) + np.where(inside, 0.0, 1e9), kind="stable")
    for k in order[: int(inside.sum())]:
        end = at[k]
        side_a, side_b = _turn(start, end, points[a]), _turn(start, end, points[b])
        side_s, side_e = _turn(points[a], points[b], start), _turn(points[a], points[b], end)
        crossing = (side_a * side_b <= 0) & (side_s * side_e <= 0)
        for place in (start, end):  # edges that end where the bridge does only touch it
            crossing &= (points[a] != place).any(1) & (points[b] != place).any(1)
        if not crossing.any():
            break
    else:
        k = order[0]
    return ring[: k + 1] + hole + [hole[0]] + ring[k:]


def _turn(a: Floats, b: Floats, c: Floats) -> Floats:
    """Twice the signed area of triangles, broadcast."""
    left: Floats = (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1])
    return left - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


def _clip(x: list[float], y: list[float], ring: list[int]) -> list[tuple[int, int, int]]:
    """Ears cut off one after the other. Places in the ring have their own numbers, as bridges visit points twice."""
    count = len(ring)
    px, py = [x[i] for i in ring], [y[i] for i in ring]
    before, after = [count - 1, *range(count - 1)], [*range(1, count), 0]
    smallest = 1e-12 * (max(px) - min(px)) * (max(py) - min(py))

    def area(i: int, j: int, k: int) -> float:
        return (px[j] - px[i]) * (py[k] - py[i]) - (py[j] - py[i]) * (px[k] - px[i])

    areas = [area(before[i], i, after[i]) for i in range(count)]
    blunt = {i for i in range(count) if areas[i] <= smallest}  # only these can lie in an ear
    triangles: list[tuple[int, int, int]] = []
    i, tried = 0, 0
    while count > 3:
        p, n = before[i], after[i]
        stuck = tried > count
        if stuck:  # cannot be by the two-ears theorem, but by rounding: the roundest corner goes
            ringed = [i]
            while after[ringed[-1]] != i:
                ringed.append(after[ringed[-1]])
            i = max(ringed, key=areas.__getitem__)
            p, n = before[i], after[i]
        if stuck or (i not in blunt and not _holds_any(px, py, p, i, n, blunt)):
            triangles.append((ring[p], ring[i], ring[n]))
            after[p], before[n] = n, p
            blunt.discard(i)
            for corner in (p, n):
                areas[corner] = area(before[corner], corner, after[corner])
                (blunt.add if areas[corner] <= smallest else blunt.discard)(corner)
            count, i, tried = count - 1, after[n], 0
        else:
            i, tried = n, tried + 1
    triangles.append((ring[before[i]], ring[i], ring[after[i]]))
    return triangles


def _holds_any(px: list[float], py: list[float], a: int, b: int, c: int, others: set[int]) -> bool:
    """Whether triangle abc holds one of the other places, its border included, its corners' own positions not."""
    ax, ay, bx, by, cx, cy = px[a], py[a], px[b], py[b], px[c], py[c]
    low_x, high_x, low_y, high_y = min(ax, bx, cx), max(ax, bx, cx), min(ay, by, cy), max(ay, by, cy)
    for i in others:
        x, y = px[i], py[i]
        if x < low_x or x > high_x or y < low_y or y > high_y:
            continue
        if (x == ax and y == ay) or (x == bx and y == by) or (x == cx and y == cy):
            continue
        if (
            (bx - ax) * (y - ay) >= (by - ay) * (x - ax)
            and (cx - bx) * (y - by) >= (cy - by) * (x - bx)
            and (ax - cx) * (y - cy) >= (ay - cy) * (x - cx)
        ):
            return True
    return False
