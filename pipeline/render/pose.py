"""How an object lies: an axis up, at rest on the plane, turned at random, of one size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Floats
from pipeline.render.extra import missing
from pipeline.render.scene import Model

TO_Z_UP = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "x": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
}
FLAT = 1e-5
"""An object thinner than this share of its extent is a sheet: it lies on one of its two sides."""
MOST_POINTS = 10_000
"""Of a hull in full; of more vertices those count that are farthest in one of `DIRECTIONS` directions."""
DIRECTIONS = 500
BLOCK = 1024
"""Vertices at a time: their heights stay in the cache."""


def posed(model: Model, *, up: str, pose: str, rng: np.random.Generator) -> Model:
    """The object as it is rendered: z up, the middle of its bounding box at the origin, largest coordinate 0.5.

    Args:
        model: as loaded.
        up: axis of the file that points up: "x", "y" or "z".
        pose: "stable": on a side on which its convex hull rests, drawn by `resting_sides`' probabilities; "upright": as
            in the file.
        rng: of the side and of the turn about z, U(0, 360) degrees; both are drawn whatever `pose` is.
    """
    rotation, drawn = TO_Z_UP[up], rng.random()
    if pose == "stable":
        vertices = model.vertices() @ rotation.T
        normals, probabilities = resting_sides(vertices)
        side = min(int(np.searchsorted(np.cumsum(probabilities), drawn)), len(normals) - 1)
        rotation = _turning_down(normals[side]) @ rotation
    turn = rng.uniform(0, 2 * np.pi)
    cosine, sine = np.cos(turn), np.sin(turn)
    rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) @ rotation
    turned = [part.vertices @ rotation.T for part in model.parts]
    low = np.min([vertices.min(axis=0) for vertices in turned], axis=0)
    high = np.max([vertices.max(axis=0) for vertices in turned], axis=0)
    middle, size = (low + high) / 2, float((high - low).max())
    parts = [
        replace(
            part,
            vertices=(vertices - middle) / size,
            normals=None if part.normals is None else part.normals @ rotation.T,
        )
        for part, vertices in zip(model.parts, turned, strict=True)
    ]
    return Model(tuple(parts))


def resting_sides(vertices: Floats) -> tuple[Floats, Floats]:
    """The sides on which the convex hull of points comes to rest on a plane, and how probable each is.

    The hull is taken for a solid body. On a side it rests where its centre of mass lies above that side; thrown at
    random it first touches with each side in proportion to the solid angle under which the centre of mass sees it,
    and from a side where it does not rest it rolls over the edge that the centre of mass is farthest beyond (the
    quasi-static estimate of Goldberg et al., "Part pose statistics", IEEE T-RO 15(5), 1999).

    Args:
        vertices: (V, 3).

    Returns:
        (S, 3) outward unit normals of the sides, and (S,) probabilities. Points in a plane rest on either side of it.
    """
    try:
        from scipy.spatial import ConvexHull, QhullError
    except ImportError:
        raise missing("scipy") from None
    points = _outermost((vertices - vertices.mean(axis=0)) / np.ptp(vertices, axis=0).max())
    points = points - points.mean(axis=0)
    axes = np.linalg.eigh(points.T @ points)[1]
    thickness = np.ptp(points @ axes, axis=0)
    thinnest = axes[:, int(thickness.argmin())]
    flat = np.stack([thinnest, -thinnest]), np.array([0.5, 0.5])
    if thickness.min() < FLAT:
        return flat
    try:
        hull = ConvexHull(points)
    except QhullError:
        return flat
    faces, neighbours = hull.simplices.astype(np.int64), hull.neighbors
    a, b, c = (points[faces[:, k]] for k in range(3))
    inwards = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0  # Qhull leaves the order open
    faces[inwards], neighbours[inwards] = faces[inwards, ::-1], neighbours[inwards, ::-1]
    return _sides(points, faces, neighbours, hull.equations)


def _outermost(vertices: Floats) -> Floats:
    """Vertices that may lie on the hull, at most a few thousand."""
    if len(vertices) <= MOST_POINTS:
        return vertices
    k = np.arange(DIRECTIONS) + 0.5
    z, angle = 1 - 2 * k / DIRECTIONS, np.pi * (1 + 5**0.5) * k  # evenly over the sphere: a Fibonacci spiral
    across = np.sqrt(1 - z * z)
    directions = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
    directions = directions.astype(np.float32)
    best, which = np.full(DIRECTIONS, -np.inf, np.float32), np.zeros(DIRECTIONS, np.int64)
    for start in range(0, len(vertices), BLOCK):
        heights = directions @ vertices[start : start + BLOCK].T.astype(np.float32)
        top = heights.argmax(axis=1)
        height = heights[np.arange(DIRECTIONS), top]
        higher = height > best
        best[higher], which[higher] = height[higher], top[higher] + start
    return vertices[np.unique(which)]


def _sides(
    points: Floats, faces: NDArray[np.int64], neighbours: NDArray[np.int32], equations: Floats
) -> tuple[Floats, Floats]:
    """`resting_sides` of a hull.

    Args:
        points: (V, 3).
        faces: (F, 3) triangles, counter-clockwise from outside.
        neighbours: (F, 3) the triangle opposite to each corner.
        equations: (F, 4) outward unit normal n and offset d of each triangle's plane, n x + d = 0.
    """
    a, b, c = (points[faces[:, k]] for k in range(3))
    volume = (a * np.cross(b, c)).sum(axis=1)  # six times that of the tetrahedron to the origin
    centre = ((a + b + c) / 4 * volume[:, None]).sum(axis=0) / volume.sum()
    # triangles of one side share their equation: Qhull merges what is coplanar and cuts it up again
    first, side = np.unique(equations, axis=0, return_index=True, return_inverse=True)[1:]
    side = side.ravel()
    normals = equations[first, :3]
    solid = np.bincount(side, _solid_angles(a - centre, b - centre, c - centre), len(first))
    # beyond which edge of its side the centre is, and by how much
    beyond, across = np.full(len(first), -np.inf), np.arange(len(first))
    for k in range(3):
        start, end = points[faces[:, k]], points[faces[:, (k + 1) % 3]]
        other = neighbours[:, (k + 2) % 3]
        outward = np.cross(end - start, equations[:, :3])
        length = np.linalg.norm(outward, axis=1)
        distance = (outward * (centre - start)).sum(axis=1) / np.maximum(length, 1e-300)
        distance[(side[other] == side) | (length < 1e-9)] = -np.inf
        order = np.lexsort((distance, side))
        last = order[np.append(side[order][1:] != side[order][:-1], True)]  # the greatest of each side
        greater = distance[last] > beyond[side[last]]
        chosen = last[greater]
        beyond[side[chosen]], across[side[chosen]] = distance[chosen], side[other[chosen]]
    height = -equations[first, 3] - normals @ centre
    rolls = (beyond > 1e-9) & (height[across] < height)  # downhill only: no circles
    rest = np.where(rolls, across, np.arange(len(first)))
    for _ in range(int(np.log2(len(first))) + 1):
        rest = rest[rest]
    probability = np.bincount(rest, solid, len(first))
    resting = np.nonzero(probability > 0)[0]
    return normals[resting], probability[resting] / probability[resting].sum()


def _solid_angles(a: Floats, b: Floats, c: Floats) -> Floats:
    """(F,) solid angle of each triangle from the origin (van Oosterom and Strackee, 1983)."""
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    triple = np.abs((a * np.cross(b, c)).sum(axis=1))
    below = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    return np.asarray(2 * np.arctan2(triple, below))


def _turning_down(normal: Floats) -> Floats:
    """(3, 3) a rotation R that turns a unit vector n to -z: R = I + [v] + [v]^2 / (1 - n_z), v = n x -z."""
    if normal[2] > 0:  # near +z the formula loses its digits: over by half a turn about x first
        over = np.diag([1.0, -1.0, -1.0])
        return np.asarray(_turning_down(over @ normal) @ over)
    x, y, z = normal
    cross = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])  # [v] of v = (-y, x, 0)
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 - z))
