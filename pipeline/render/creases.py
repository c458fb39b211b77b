"""Normals for meshes that come without: smooth across gentle edges, sharp across others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Floats
from pipeline.render.extra import missing

Indices = NDArray[np.int64]
CREASE_DEG = 32.0
"""Edges that turn by more stay sharp: a prism of twelve sides is meant to be round, one of eight is not."""

SHARP_DEG, FEW, SAME = 60.0, 0.02, 0.999
"""Of `go_round_sharp_edges`: what is sharp, which share of edges is few, and the cosine between equal normals."""


def weld(vertices: Floats) -> tuple[Indices, Indices]:
    """Vertices at exactly the same place: (W,) a row for each place, and (V,) the number of each vertex's place."""
    x, y, z = vertices.T
    order = np.lexsort((z, y, x))
    placed = vertices[order]
    new = np.ones(len(vertices), dtype=bool)
    new[1:] = (placed[1:] != placed[:-1]).any(axis=1)
    ids = np.empty(len(vertices), dtype=np.int64)
    ids[order] = np.cumsum(new) - 1
    return order[new], ids


def face_normals(vertices: Floats, faces: Indices) -> Floats:
    """(F, 3) normals as long as twice the area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def crease_normals(vertices: Floats, faces: Indices, crease_deg: float = CREASE_DEG) -> tuple[Indices, Indices, Floats]:
    """Normals at the corners, the same on both sides of an edge that turns by less than `crease_deg`.

    Corners at one place belong together when gentle edges connect them; their normal is the mean of their faces',
    weighted by the angle at the corner. Edges of one face, of more than two, and of two that are wound against each
    other are sharp.

    Args:
        vertices: (V, 3); those at the same place count as one.
        faces: (F, 3), none of them degenerate.

    Returns:
        (V', ) the row of `vertices` that each new vertex repeats, (F, 3) faces of new vertices, (V', 3) unit normals.
    """
    try:
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components
    except ImportError:
        raise missing("scipy") from None

    places = weld(vertices)[1][faces]
    normals = _unit_face_normals(vertices, faces)
    one, other = _shared_edges(places)
    gentle = (normals[one // 3] * normals[other // 3]).sum(axis=1) >= np.cos(np.radians(crease_deg))
    one, other = one[gentle], other[gentle]
    rows = np.concatenate([one, _next(one)])
    columns = np.concatenate([_next(other), other])
    n_corners = faces.size
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(n_corners, n_corners))
    count, label = connected_components(graph, directed=False)
    weights = corner_angles(vertices, faces).ravel()
    each = np.repeat(normals, 3, axis=0) * weights[:, None]
    sums = np.stack([np.bincount(label, each[:, k], count) for k in range(3)], axis=1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    by_label = np.divide(sums, length, out=np.zeros_like(sums), where=length > 1e-9)
    new, first, new_faces = np.unique(
        label.astype(np.int64) * len(vertices) + faces.ravel(), return_index=True, return_inverse=True
    )
    result = by_label[new // len(vertices)]
    lost = ~result.any(axis=1)
    result[lost] = normals[first[lost] // 3]
    return new % len(vertices), new_faces.reshape(-1, 3), result


def go_round_sharp_edges(vertices: Floats, faces: Indices, normals: Floats) -> bool:
    """Whether unit normals at vertices are means over all faces there, sharp edges or not, as MeshLab writes them.

    Cubes shaded with those look like balloons. Who means his normals splits them at sharp edges, at some at least.
    """
    of_faces = _unit_face_normals(vertices, faces)
    one, other = _shared_edges(weld(vertices)[1][faces])
    sharp = (of_faces[one // 3] * of_faces[other // 3]).sum(axis=1) < np.cos(np.radians(SHARP_DEG))
    if not len(one) or sharp.mean() < FEW:
        return False
    one, other = one[sharp], other[sharp]
    corners = normals[faces.ravel()]
    same = (corners[one] * corners[_next(other)]).sum(axis=1) > SAME
    same &= (corners[_next(one)] * corners[other]).sum(axis=1) > SAME
    return bool(same.mean() > 1 - FEW)


def _unit_face_normals(vertices: Floats, faces: Indices) -> Floats:
    normals = face_normals(vertices, faces)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _shared_edges(places: Indices) -> tuple[Indices, Indices]:
    """Both half-edges of each edge of two faces that are wound alike; half-edge 3 f + k starts at corner k of f."""
    start, end = places.ravel(), np.roll(places, -1, axis=1).ravel()
    key = np.minimum(start, end) * (places.max() + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    same = np.concatenate([[False], key[order[1:]] == key[order[:-1]], [False]])  # as the one before
    two = np.nonzero(same[1:-1] & ~same[:-2] & ~same[2:])[0]
    one, other = order[two], order[two + 1]
    alike = start[one] == end[other]
    return one[alike], other[alike]


def corner_angles(vertices: Floats, faces: Indices) -> Floats:
    """(F, 3) angles in radians."""
    p = vertices[faces]
    ahead, back = np.roll(p, -1, axis=1) - p, np.roll(p, 1, axis=1) - p
    sine = np.linalg.norm(np.cross(ahead, back), axis=2)
    return np.asarray(np.arctan2(sine, (ahead * back).sum(axis=2)))


def _next(half_edge: Indices) -> Indices:
    """The corner at which a half-edge ends."""
    return half_edge - half_edge % 3 + (half_edge + 1) % 3
