"""Closed triangle meshes: moved, deformed, measured, shaded with edges where they bend sharply."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.geometry import Floats
from pipeline.solids.grids import turn_about


@dataclass(frozen=True)
class Mesh:
    """A closed surface, or several: every edge belongs to two faces, which run along it in opposite directions.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3) counter-clockwise from outside.
    """

    vertices: Floats
    faces: NDArray[np.int64]

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
        """Shifted."""
        return Mesh(self.vertices + np.array([x, y, z]), self.faces)

    def turned(self, axis: int, degrees: float) -> Mesh:
        """Turned about a coordinate axis by the right-hand rule."""
        return Mesh(self.vertices @ turn_about(axis, degrees).T, self.faces)

    def scaled(self, factors: ArrayLike) -> Mesh:
        """Scaled along the axes; a negative factor mirrors, and the faces still look outwards."""
        factors = np.broadcast_to(np.asarray(factors, dtype=float), 3)
        flip = bool(np.prod(factors) < 0)
        return Mesh(self.vertices * factors, self.faces[:, ::-1] if flip else self.faces)

    def deformed(self, x: Floats, y: Floats, z: Floats) -> Mesh:
        """The same faces over other coordinates (V,) each."""
        return Mesh(np.stack([x, y, z], axis=1), self.faces)

    @property
    def low(self) -> Floats:
        """(3,) corner of the bounding box."""
        return np.asarray(self.vertices.min(0))

    @property
    def high(self) -> Floats:
        """(3,) corner of the bounding box."""
        return np.asarray(self.vertices.max(0))


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one, not welded."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def welded(grids: Iterable[Floats]) -> Mesh:
    """Grids (m, n, 3) (see `grids`) as a mesh: points in one place are one vertex, faces without area are gone."""
    grids = list(grids)
    points = np.concatenate([grid.reshape(-1, 3) for grid in grids])
    starts = np.cumsum([0, *(grid.shape[0] * grid.shape[1] for grid in grids)])
    faces = np.concatenate([_grid_faces(*grid.shape[:2]) + start for grid, start in zip(grids, starts, strict=False)])
    step = 1e-7 * float(np.ptp(points, axis=0).max())
    places = np.round(points / step + 0.2718281828).astype(np.int64)  # off round numbers, where rounding is a toss-up
    key = (places[:, 0] * 0x9E3779B1 + places[:, 1]) * 0x85EBCA77 + places[:, 2]
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    faces = of.reshape(-1)[faces]
    a, b, c = faces.T
    return Mesh(points[first], faces[(a != b) & (b != c) & (c != a)])


def _grid_faces(m: int, n: int) -> NDArray[np.int64]:
    """Two triangles a cell (F, 3) of a grid of m rows and n columns."""
    a = (np.arange(m - 1)[:, None] * n + np.arange(n - 1)).ravel()
    return np.concatenate([np.stack([a, a + 1, a + n], axis=1), np.stack([a + 1, a + n + 1, a + n], axis=1)])


def signed_volume(mesh: Mesh) -> float:
    """Volume of a closed mesh, negative where its faces look inwards (divergence theorem)."""
    a, b, c = mesh.vertices[mesh.faces.T]
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def outward(mesh: Mesh) -> Mesh:
    """The same body with its faces looking outwards."""
    return mesh if signed_volume(mesh) >= 0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])


def area_vectors(mesh: Mesh) -> Floats:
    """(F, 3) the faces' normals, as long as twice their areas."""
    a, b, c = mesh.vertices[mesh.faces.T]
    return np.cross(b - a, c - a)


def subdivided(mesh: Mesh) -> Mesh:
    """The same surface with four triangles for each."""
    edges, of = _edges(mesh)
    middle = mesh.vertices[edges].mean(1)
    a, b, c = mesh.faces.T
    ab, bc, ca = of.reshape(3, -1) + len(mesh.vertices)
    faces = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return Mesh(np.concatenate([mesh.vertices, middle]), np.concatenate([np.stack(face, axis=1) for face in faces]))


def _edges(mesh: Mesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges (E, 2), and for each face's first, then second, then third side (3F,) which edge it is."""
    start, stop = mesh.faces.T.ravel(), np.roll(mesh.faces, -1, axis=1).T.ravel()
    count = len(mesh.vertices)
    keys, of = np.unique(np.minimum(start, stop) * count + np.maximum(start, stop), return_inverse=True)
    return np.stack(np.divmod(keys, count), axis=1), of.reshape(-1)


def shaded(mesh: Mesh, crease_deg: float = 38.0) -> tuple[Floats, NDArray[np.int64], Floats]:
    """Vertices, faces and unit normals of a mesh: smooth where it bends little, split along sharper edges.

    Faces round a vertex share its normal (the mean by angle) as far as they hang together through edges that bend by
    less than `crease_deg`.
    """
    n_faces = len(mesh.faces)
    areas = area_vectors(mesh)
    unit = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-300)
    start, stop = mesh.faces.T.ravel(), np.roll(mesh.faces, -1, axis=1).T.ravel()
    count = len(mesh.vertices)
    keys = np.minimum(start, stop) * count + np.maximum(start, stop)
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    one, two = order[same], order[same + 1]
    flat = np.einsum("ij,ij->i", unit[one % n_faces], unit[two % n_faces]) > np.cos(np.radians(crease_deg))
    one, two = one[flat], two[flat]
    # corner k of face f is number k F + f, and so is the side that begins there; sides run against each other
    ends = [np.where(start[one] == start[two], two, (two + n_faces) % (3 * n_faces))]
    ends.append(np.where(start[one] == start[two], (two + n_faces) % (3 * n_faces), two))
    links = np.concatenate([one, (one + n_faces) % (3 * n_faces)]), np.concatenate(ends)
    group, found = np.unique(_connected(3 * n_faces, *links), return_inverse=True)
    corner_of = found.reshape(-1).astype(np.int64)
    source = np.concatenate([mesh.faces[:, k] for k in range(3)])[group]
    corners = mesh.vertices[mesh.faces.T]  # by angle: by area, a quad's diagonal would pull the normal to one side
    to_next, to_last = np.roll(corners, -1, 0) - corners, np.roll(corners, 1, 0) - corners
    angles = np.arctan2(np.linalg.norm(areas, axis=1), np.einsum("kij,kij->ki", to_next, to_last)).ravel()
    sums = np.stack([np.bincount(corner_of, np.tile(axis, 3) * angles, len(group)) for axis in unit.T], axis=1)
    normals = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)
    return mesh.vertices[source], corner_of.reshape(3, -1).T, normals


def _connected(count: int, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each of `count` nodes the smallest one that links (a, b) lead to."""
    label = np.arange(count)
    while True:
        low = np.minimum(label[a], label[b])
        new = label.copy()
        np.minimum.at(new, a, low)
        np.minimum.at(new, b, low)
        new = new[new]
        if np.array_equal(new, label):
            return label
        label = new
