"""OFF files, those of ModelNet included, whose first line may read `OFF3514 3546 0`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dope.common.errors import BadInput
from pipeline.render.mesh_files.text import (
    WRITE_AGAIN,
    colours_01,
    damaged,
    floats,
    integers,
    read,
    require_faces,
    require_indices,
)
from pipeline.render.mesh_files.triangulate import triangulate
from pipeline.render.scene import Part

HEAD = re.compile(rb"\s*(ST)?(C)?(N)?(4)?(n)?OFF")


def read_off(path: Path, max_faces: int) -> list[Part]:
    """The mesh of a text OFF file: colours of vertices (COFF) or faces, normals (NOFF) where it has them.

    Raises:
        BadInput: it is no OFF file, is cut off, refers to vertices that it lacks, or claims too many faces.
    """
    data = read(path, max_faces)
    head = HEAD.match(data)
    if head is None:
        raise BadInput("is not an OFF file", where=path, remedy=WRITE_AGAIN)
    textured, coloured, with_normals, four, any_ = (group is not None for group in head.groups())
    body = data[head.end() :]
    if four or any_ or re.match(rb"\s*BINARY", body):
        raise BadInput("is a kind of OFF that is not read (4OFF, nOFF or binary)", where=path, remedy="Write text OFF")
    lines = [line for line in re.sub(rb"#[^\n]*", b"", body).splitlines() if line.strip()]
    counts = integers(lines[0].split()[:3], path) if lines else np.empty(0, np.int64)
    if len(counts) < 2 or counts[0] < 0 or counts[1] < 0:
        raise damaged(path, "no numbers of vertices and faces")
    n_vertices, n_faces = int(counts[0]), int(counts[1])
    require_faces(n_faces, max_faces, path)
    if n_vertices + n_faces > len(lines) - 1:
        raise damaged(path, f"claims {n_vertices} vertices and {n_faces} faces, has {len(lines) - 1} lines of them")
    width = len(lines[1].split())
    least = 3 + 3 * with_normals + 3 * coloured + 2 * textured
    table = floats(b" ".join(lines[1 : n_vertices + 1]).split(), path)
    if width < least or len(table) != n_vertices * width:
        raise damaged(path, "lines of vertices have too few or too many numbers")
    table = table.reshape(n_vertices, width)
    normals = table[:, 3:6] if with_normals else None
    at = 3 + 3 * with_normals
    colours = colours_01(table[:, at : at + 3]) if coloured else None
    faces = [line.split() for line in lines[n_vertices + 1 : n_vertices + 1 + n_faces]]
    sizes = integers((words[0] for words in faces), path)
    if any(len(words) <= size or size < 0 for words, size in zip(faces, sizes, strict=True)):
        raise damaged(path, "a face has fewer corners than it says")
    flat = integers(
        (word for words, size in zip(faces, sizes.tolist(), strict=True) for word in words[1 : size + 1]), path
    )
    require_indices(flat, n_vertices, path)
    xyz = np.ascontiguousarray(table[:, :3])
    corners, owner = triangulate(xyz[flat], sizes, path)
    extra = [words[size + 1 :] for words, size in zip(faces, sizes.tolist(), strict=True)]
    if colours is None and len(owner) and all(len(words) in (3, 4) for words in extra):  # a colour a face
        by_face = colours_01(floats((w for words in extra for w in words[:3]), path).reshape(-1, 3))
        rows = flat[corners.ravel()]
        own = np.arange(len(rows)).reshape(-1, 3)
        return [
            Part(xyz[rows], own, None if normals is None else normals[rows], colours=np.repeat(by_face[owner], 3, 0))
        ]
    return [Part(xyz, flat[corners], normals, colours=colours)]
