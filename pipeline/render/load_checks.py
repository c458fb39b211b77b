"""What a mesh must be before it is rendered. Importers accept nearly anything in silence; pictures show it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.geometry import Floats
from pipeline.render.creases import face_normals, weld
from pipeline.render.mesh_files.text import WRITE_AGAIN, require_faces
from pipeline.render.scene import Part

LARGEST, SMALLEST = 1e12, 1e-20
"""Extents that are refused: beyond these products of coordinates lose their digits."""
ROUNDED = 1e-8
"""A mesh smaller than this share of its distance from the origin has lost its shape to rounding."""
OUTLIER = 100.0
"""The farthest vertex may be so many times as far from the median as 99.9% of them."""
THIN = 1e-12
"""Triangles with less than this share of the square of the extent have no area."""


def checked(parts: list[Part], path: Path, max_faces: int) -> list[Part]:
    """The parts without degenerate and repeated triangles, and without vertices that no triangle uses.

    An object that is wound inside out is turned over.

    Raises:
        BadInput: no faces, too many, not finite, of an absurd extent, or without area.
    """
    require_faces(sum(len(part.faces) for part in parts), max_faces, path)
    parts = [_compact(part) for part in parts if len(part.faces)]
    vertices = np.concatenate([part.vertices for part in parts])
    _require_sane_extent(vertices, path)
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets[:-1], strict=True)])
    kept = _worth_keeping(vertices, faces)
    if not kept.any():
        raise BadInput("has no area: all its triangles are degenerate", where=path, remedy=WRITE_AGAIN)
    inside_out = _signed_volume(vertices, faces[kept]) < 0
    masks = np.split(kept, np.cumsum([len(part.faces) for part in parts])[:-1])
    thinned = [replace(part, faces=part.faces[mask]) for part, mask in zip(parts, masks, strict=True) if mask.any()]
    return [_compact(_turned_over(part) if inside_out else part) for part in thinned]


def _signed_volume(vertices: Floats, faces: NDArray[np.int64]) -> float:
    """Six times the volume inside, negative where the faces are wound clockwise from outside."""
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2  # of open surfaces the volume depends on it
    a, b, c = (vertices[faces[:, k]] - middle for k in range(3))
    return float((a * np.cross(b, c)).sum())


def _turned_over(part: Part) -> Part:
    return replace(part, faces=part.faces[:, ::-1].copy(), normals=None if part.normals is None else -part.normals)


def _compact(part: Part) -> Part:
    """Without the vertices that no face uses."""
    used = np.zeros(len(part.vertices), dtype=bool)
    used[part.faces.ravel()] = True
    if used.all():
        return part
    new = np.cumsum(used) - 1

    def of(values: Floats | None) -> Floats | None:
        return None if values is None else values[used]

    return replace(
        part,
        vertices=part.vertices[used],
        faces=new[part.faces],
        normals=of(part.normals),
        uv=of(part.uv),
        colours=of(part.colours),
    )


def _require_sane_extent(vertices: Floats, path: Path) -> None:
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        what = f"has {int((~finite).sum())} vertices that are not finite (NaN or infinite)"
        raise BadInput(what, where=path, remedy=WRITE_AGAIN)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    farthest = float(np.abs([low, high]).max())
    with np.errstate(over="ignore"):
        extent = float((high - low).max())
    if farthest > LARGEST or extent < SMALLEST:
        what = f"has an absurd extent: {extent:.3g}, up to {farthest:.3g} from the origin"
        raise BadInput(what, where=path, remedy=f"Scale it to between {SMALLEST:g} and {LARGEST:g}")
    if extent < ROUNDED * farthest:
        what = f"is {extent:.3g} large and lies {farthest:.3g} from the origin: its shape is lost to rounding"
        raise BadInput(what, where=path, remedy="Move it to the origin in the program that made it")
    away = np.abs(vertices - np.median(vertices, axis=0)).max(axis=1)
    most = float(np.percentile(away, 99.9, method="lower"))
    if float(away.max()) > OUTLIER * most:
        what = f"has vertices {away.max():.3g} away where 99.9% lie within {most:.3g}"
        raise BadInput(what, where=path, remedy="Remove the stray ones")


def _worth_keeping(vertices: Floats, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Triangles with an area, and of those with the same three places the first one."""
    extent = float(np.ptp(vertices, axis=0).max())
    double_area = np.linalg.norm(face_normals(vertices / extent, faces), axis=1)
    places = np.sort(weld(vertices)[1][faces], axis=1)
    order = np.lexsort(places.T)  # stable: the first of equals stays first
    placed = places[order]
    first = np.ones(len(faces), dtype=bool)
    first[1:] = (placed[1:] != placed[:-1]).any(axis=1)
    kept = np.zeros(len(faces), dtype=bool)
    kept[order[first]] = True
    return kept & (double_area > 2 * THIN)
