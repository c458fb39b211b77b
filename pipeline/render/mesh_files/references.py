"""Which files a mesh names, found without reading the mesh itself."""

from __future__ import annotations

import json
import mmap
import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import unquote

from dope.common.errors import BadInput
from pipeline.ply import LONGEST_HEADER
from pipeline.render.mesh_files.beside import beside
from pipeline.render.mesh_files.obj import library_names, read_library
from pipeline.render.mesh_files.ply import read_header

URI = re.compile(rb'"uri"\s*:\s*"((?!data:)(?:[^"\\]|\\.){0,8192})"')
"""A name in glTF's JSON, as it is written there."""


def references(mesh: Path) -> list[tuple[str, Path | None]]:
    """Names of materials, textures and buffers, and where they lie; None = outside the mesh's folder, not to be read.

    A file that is damaged names none. Raises OSError where the mesh cannot be read.
    """
    names = {".obj": _obj, ".ply": _ply, ".glb": _gltf, ".gltf": _gltf}.get(mesh.suffix.lower())
    found: dict[str, Path | None] = {}
    for name in names(mesh) if names is not None else ():
        try:
            found[name] = beside(mesh, name)
        except BadInput:
            found[name] = None
    return list(found.items())


def _obj(mesh: Path) -> Iterator[str]:
    if not mesh.stat().st_size:
        return
    with mesh.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        libraries = list(library_names(mesh, data))
    for name in libraries:
        yield name
        try:
            path = beside(mesh, name)
            materials = read_library(path) if path.is_file() else {}
        except BadInput:
            continue
        yield from (material.texture for material in materials.values() if material.texture is not None)


def _ply(mesh: Path) -> list[str]:
    with mesh.open("rb") as file:
        head = file.read(LONGEST_HEADER)
    try:
        return read_header(head, mesh).textures
    except BadInput:
        return []


def _gltf(mesh: Path) -> Iterator[str]:
    """By its text: JSON of some size takes thirty times the memory when it is read, and this process has no limit."""
    if not mesh.stat().st_size:
        return
    with mesh.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        start, end = 0, len(data)
        if data[:4] == b"glTF" and end >= 20:
            (size,) = struct.unpack_from("<I", data, 12)
            start, end = 20, min(20 + size, end)
        texts = [match[1] for match in URI.finditer(data, start, end)]
    for text in texts:
        with suppress(ValueError):
            yield unquote(json.loads(b'"' + text + b'"'))
