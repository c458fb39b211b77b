"""STL files, binary and text."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np

from pipeline.geometry import Floats
from pipeline.render.creases import weld
from pipeline.render.mesh_files.text import damaged, floats, read, require_faces
from pipeline.render.scene import Part

HEAD, RECORD = 84, 50
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read_stl(path: Path, max_faces: int) -> list[Part]:
    """The triangles of an STL file; corners at the same place become one vertex. Its normals are not read: many lie.

    Raises:
        BadInput: it is no STL file, is cut off, its number of triangles is wrong, or claims too many faces.
    """
    data = read(path, max_faces)
    text = data[:HEAD].lstrip()[:5].lower() == b"solid" and b"facet" in data[:4096].lower()
    soup = _text(data, path, max_faces) if text else _binary(data, path, max_faces)
    first, ids = weld(soup)
    return [Part(soup[first], ids.reshape(-1, 3))]


def _binary(data: bytes, path: Path, max_faces: int) -> Floats:
    if len(data) < HEAD:
        raise damaged(path, "shorter than the head of an STL file")
    (count,) = struct.unpack_from("<I", data, HEAD - 4)
    require_faces(count, max_faces, path)
    held = (len(data) - HEAD) // RECORD
    if held != count:
        raise damaged(path, f"claims {count} triangles, holds {held}")
    return np.frombuffer(data, TRIANGLE, count, HEAD)["corners"].reshape(-1, 3).astype(np.float64)


def _text(data: bytes, path: Path, max_faces: int) -> Floats:
    found = VERTEX.findall(data)
    require_faces(len(found) // 3, max_faces, path)
    if len(found) % 3 or not re.search(rb"endsolid", data[-512:], re.IGNORECASE):
        raise damaged(path, "the last triangle is not whole")
    return floats((word for words in found for word in words), path).reshape(-1, 3)
