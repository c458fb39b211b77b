"""A model as the arrays that the shaders read."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.render.exposure import to_linear
from pipeline.render.scene import Model, Part

GREY = 0.6  # sRGB, of parts that say nothing of how they look
MAX_TEXELS = 1 << 25  # of all textures of a model together
MAX_SIDE = 2048
OCCLUDER_FACES = 1500
OCCLUDER_CELLS = (128, 64, 48)


@dataclass(frozen=True)
class Geometry:
    """All parts one after the other.

    Attributes:
        vertices: (V, 8) float32: x y z u, normal v. A normal of length 0: flat shading.
        colours: (V, 4) float16 linear colours of vertices: between them light is mixed, as in Blender and glTF.
        faces: (F, 4) uint32: three vertices and the part.
        materials: (P, 4) float32: linear colour, and the texture's number (-1: none).
        textures: (T, S, S', 4) uint8 sRGB, first row at the top.
        low, high: (3,) corners of the bounding box.
    """

    vertices: NDArray[np.float32]
    colours: NDArray[np.float16]
    faces: NDArray[np.uint32]
    materials: NDArray[np.float32]
    textures: NDArray[np.uint8]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def corners(self) -> NDArray[np.float64]:
        """(8, 3) of the bounding box."""
        return np.array(np.meshgrid(*zip(self.low, self.high, strict=True))).reshape(3, -1).T


def geometry_of(model: Model) -> Geometry:
    """Raises BadInput for a model without faces, with a face that names no vertex, or with numbers that are not."""
    parts = [part for part in model.parts if len(part.faces)]
    if not parts:
        raise BadInput("the mesh has no faces")
    for part in parts:
        if part.faces.min() < 0 or part.faces.max() >= len(part.vertices):
            raise BadInput("the mesh has a face that names a vertex it does not have")
        if not np.isfinite(part.vertices).all():
            raise BadInput("the mesh has vertices that are no numbers")
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([_vertices(part) for part in parts])
    faces = np.concatenate(
        [
            np.column_stack([part.faces + start, np.full(len(part.faces), number)]).astype(np.uint32)
            for number, (part, start) in enumerate(zip(parts, starts, strict=False))
        ]
    )
    textured = [number for number, part in enumerate(parts) if part.texture is not None and part.uv is not None]
    materials = np.full((len(parts), 4), -1, np.float32)
    for number, part in enumerate(parts):
        materials[number, :3] = to_linear(_base_colour(part))
    materials[textured, 3] = np.arange(len(textured))
    colours = np.concatenate([_colours(part) for part in parts])
    points = vertices[:, :3].astype(np.float64)
    textures = _stack([parts[number].texture for number in textured])  # type: ignore[misc]
    return Geometry(vertices, colours, faces, materials, textures, points.min(axis=0), points.max(axis=0))


def occluder_faces(geometry: Geometry) -> NDArray[np.uint32]:
    """Faces (F', 3) that cast shadows: all of a small mesh, of others about what a shadow map tells apart.

    Vertices of a cell of a grid become one of them, which leaves no gaps. Faces that become lines by that, and lie at
    no other face, are thin rods: two for each line stay as they are.
    """
    faces = geometry.faces[:, :3]
    for cells in OCCLUDER_CELLS:
        if len(faces) <= OCCLUDER_FACES:
            return faces
        faces = _clustered(geometry, cells)
    return faces


def _clustered(geometry: Geometry, cells: int) -> NDArray[np.uint32]:
    faces = geometry.faces[:, :3]
    size = max(float((geometry.high - geometry.low).max()), 1e-12)
    place = ((geometry.vertices[:, :3] - geometry.low.astype(np.float32)) * np.float32(cells / size)).astype(np.int64)
    _, first, cell = np.unique(place @ np.array([1, 1 << 10, 1 << 20]), return_index=True, return_inverse=True)
    corners = np.sort(cell.reshape(-1).astype(np.int64)[faces], axis=1)
    names = (corners[:, 0] * len(first) + corners[:, 1]) * len(first) + corners[:, 2]
    distinct = (corners[:, 0] != corners[:, 1]).astype(np.int8) + (corners[:, 1] != corners[:, 2])
    _, solid = np.unique(np.where(distinct == 2, names, -1), return_index=True)
    solid = solid[distinct[solid] == 2]
    lines = np.flatnonzero(distinct == 1)
    ends = corners[lines, 0] * len(first) + corners[lines, 2]
    edges = [corners[solid][:, a] * len(first) + corners[solid][:, b] for a, b in ((0, 1), (1, 2), (0, 2))]
    bare = ~np.isin(ends, np.concatenate(edges))  # the others lie at a face that is kept
    lines, ends = lines[bare], ends[bare]
    kept = [np.unique(order, return_index=True)[1] for order in (ends, ends[::-1])]
    both = np.unique(np.concatenate([lines[kept[0]], lines[::-1][kept[1]]]))
    return np.concatenate([first[corners[np.sort(solid)]].astype(np.uint32), faces[both]])


def _vertices(part: Part) -> NDArray[np.float32]:
    out = np.zeros((len(part.vertices), 8), np.float32)
    out[:, :3] = part.vertices
    if part.normals is not None:
        out[:, 4:7] = np.nan_to_num(part.normals, nan=0, posinf=0, neginf=0)
    if part.uv is not None:
        uv = np.nan_to_num(part.uv, nan=0, posinf=0, neginf=0)
        out[:, [3, 7]] = uv - np.floor(uv.min(axis=0))  # it wraps around; float32 is finest near 0
    return out


def _colours(part: Part) -> NDArray[np.float16]:
    out = np.ones((len(part.vertices), 4), np.float16)
    if part.colours is not None:
        out[:, :3] = to_linear(np.clip(np.nan_to_num(part.colours), 0, 1))
    return out


def _base_colour(part: Part) -> NDArray[np.floating]:
    if part.colour is not None:
        return np.clip(np.asarray(part.colour, np.float64), 0, 1)
    textured = part.texture is not None and part.uv is not None
    return np.full(3, 1.0 if textured or part.colours is not None else GREY)


def _stack(textures: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Pictures of any sizes as one array of one size, the largest that all of them need and that has room."""
    if not textures:
        return np.zeros((0, 1, 1, 4), np.uint8)
    height, width = (min(MAX_SIDE, max(texture.shape[axis] for texture in textures)) for axis in (0, 1))
    shrink = min(1.0, np.sqrt(MAX_TEXELS / (height * width * len(textures))))
    height, width = max(1, int(height * shrink)), max(1, int(width * shrink))
    out = np.full((len(textures), height, width, 4), 255, np.uint8)
    for layer, texture in zip(out, textures, strict=True):
        smaller = texture.shape[0] > height or texture.shape[1] > width
        way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        layer[..., :3] = cv2.resize(texture[..., :3], (width, height), interpolation=way)
    return out
