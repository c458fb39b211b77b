"""Mesh files to models that a renderer can rely on: finite, not degenerate, with normals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from dope.common.errors import BadInput
from pipeline.geometry import Floats
from pipeline.render.creases import crease_normals, go_round_sharp_edges
from pipeline.render.load_checks import checked
from pipeline.render.mesh_files.gltf import read_gltf
from pipeline.render.mesh_files.obj import read_obj
from pipeline.render.mesh_files.off import read_off
from pipeline.render.mesh_files.ply import read_ply_mesh
from pipeline.render.mesh_files.stl import read_stl
from pipeline.render.scene import Model, Part

READERS: dict[str, Callable[[Path, int], list[Part]]] = {
    ".off": read_off,
    ".obj": read_obj,
    ".ply": read_ply_mesh,
    ".stl": read_stl,
    ".glb": read_gltf,
    ".gltf": read_gltf,
}
FARTHEST_UV = 1e4


def load_model(path: Path, *, max_faces: int) -> Model:
    """The mesh of a file, in the file's own frame and units, a part for each material.

    Polygons are cut into triangles; degenerate triangles, and those that lie on one another, are left out. Normals are
    the file's where all of them can be used and they are not mere means over sharp edges, else smooth up to creases
    (`crease_normals`); vertices are split there.

    Args:
        path: an OFF, OBJ, PLY, STL, GLB or glTF file.
        max_faces: meshes with more triangles are refused, where the file says how many by its header.

    Raises:
        BadInput: it cannot be rendered; says why, names the file and a remedy.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        known = ", ".join(suffix[1:] for suffix in READERS)
        raise BadInput("is no mesh that can be read", where=path, remedy=f"Convert it to one of {known}")
    try:
        parts = checked(reader(path, max_faces), path, max_faces)
    except OSError as error:  # of a file that it names: a name that is too long
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
    return Model(tuple(_finished(part) for part in parts))


def _finished(part: Part) -> Part:
    normals = _usable(part.normals)
    vertices, faces, rows = part.vertices, part.faces, None
    if normals is None or go_round_sharp_edges(vertices, faces, normals):
        rows, faces, normals = crease_normals(vertices, faces)
        vertices = vertices[rows]
    uv = part.uv
    if uv is not None:
        uv = np.clip(np.nan_to_num(uv, posinf=0, neginf=0), -FARTHEST_UV, FARTHEST_UV)
        uv = uv if rows is None else uv[rows]
    colours = part.colours if rows is None or part.colours is None else part.colours[rows]
    return Part(vertices, faces, normals, uv, colours, part.texture if uv is not None else None, part.colour)


def _usable(normals: Floats | None) -> Floats | None:
    """Unit normals, or None where one is zero or not finite."""
    if normals is None:
        return None
    with np.errstate(all="ignore"):
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        if not (np.isfinite(length) & (length > 1e-12)).all():
            return None
        return np.asarray(normals / length)
