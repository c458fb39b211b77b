"""Meshes in PLY files, ASCII or binary."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.geometry import Floats
from pipeline.ply import FORMATS, LONGEST_HEADER, TYPES
from pipeline.render.mesh_files.beside import decode_texture, read_beside
from pipeline.render.mesh_files.text import (
    WRITE_AGAIN,
    colours_01,
    damaged,
    floats,
    read,
    require_faces,
    require_indices,
)
from pipeline.render.mesh_files.triangulate import triangulate
from pipeline.render.scene import Part

UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
CORNER_NAMES = ("vertex_indices", "vertex_index")


@dataclass
class Element:
    """`property`s are (name, type, type of the list's length or None for a number)."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)


@dataclass(frozen=True)
class Lists:
    """Lists of different lengths, one after the other."""

    sizes: NDArray[np.int64]
    values: Floats


Columns = dict[str, "Floats | Lists"]


@dataclass(frozen=True)
class Header:
    format: str
    elements: list[Element]
    textures: list[str]
    """Names of pictures (MeshLab's `comment TextureFile`)."""
    size: int
    """Bytes of the header."""


def read_ply_mesh(path: Path, max_faces: int) -> list[Part]:
    """The mesh of a PLY file: normals, colours of vertices or faces, and texture coordinates where it has them.

    Raises:
        BadInput: it is no PLY file, is cut off, refers to vertices that it lacks, or claims too many faces.
    """
    data = read(path, max_faces)
    header = read_header(data, path)
    claimed = {element.name: element.count for element in header.elements}
    require_faces(claimed.get("face", 0), max_faces, path)
    table = _text(data, header, path) if header.format == "ascii" else _binary(data, header, path)
    vertex, face = table.get("vertex", {}), table["face"]
    xyz, corners = _together(vertex, "xyz"), next((face[name] for name in CORNER_NAMES if name in face), None)
    if xyz is None or not isinstance(corners, Lists):
        raise BadInput("is a PLY file without vertices or faces", where=path, remedy=WRITE_AGAIN)
    if not np.isfinite(corners.values).all():  # indices may be floats
        raise damaged(path, "an index is not finite")
    flat = np.clip(corners.values, -1, 1 << 40).astype(np.int64)
    require_indices(flat, len(xyz), path)
    normals, colours = _together(vertex, ("nx", "ny", "nz")), _colours(vertex)
    uv = next((uv for names in UV_NAMES if (uv := _together(vertex, names)) is not None), None)
    texture = None
    if header.textures:
        if len(header.textures) > 1:
            raise BadInput("has several textures", where=path, remedy="Convert it to GLB, which says what each covers")
        name = header.textures[0]
        texture = decode_texture(read_beside(path, name, "texture"), path, name)
    cut, owner = triangulate(xyz[flat], corners.sizes, path)
    own_uv, by_face = face.get("texcoord"), _colours(face) if colours is None else None
    wedges = isinstance(own_uv, Lists) and bool((own_uv.sizes == 2 * corners.sizes).all())
    if by_face is None and not wedges:
        return [Part(xyz, flat[cut], normals, uv, colours, texture, (1.0, 1.0, 1.0) if texture is not None else None)]
    rows = flat[cut.ravel()]
    if isinstance(own_uv, Lists) and wedges:
        uv = own_uv.values.reshape(-1, 2)[cut.ravel()]
    elif uv is not None:
        uv = uv[rows]
    if by_face is not None:
        colours = np.repeat(by_face[owner], 3, axis=0)
    elif colours is not None:
        colours = colours[rows]
    own = np.arange(len(rows)).reshape(-1, 3)
    normals = None if normals is None else normals[rows]
    return [Part(xyz[rows], own, normals, uv, colours, texture, (1.0, 1.0, 1.0) if texture is not None else None)]


def read_header(data: bytes, path: Path) -> Header:
    """What a PLY file says about itself. Raises `BadInput` where that cannot be understood."""
    head, found, _ = data[:LONGEST_HEADER].partition(b"end_header")
    size = data.find(b"\n", len(head)) + 1
    if not data.startswith(b"ply") or not found or not size:
        raise BadInput("is not a PLY file", where=path, remedy=WRITE_AGAIN)
    kind, elements, textures = "", list[Element](), list[str]()
    for line in head.decode(errors="replace").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                kind = words[1]
            elif words[:1] == ["element"]:
                elements.append(Element(words[1], int(words[2])))
            elif words[:2] == ["property", "list"]:
                elements[-1].properties.append((words[4], TYPES[words[3]], TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1].properties.append((words[2], TYPES[words[1]], None))
            elif words[:2] == ["comment", "TextureFile"]:
                textures.append(line.split(None, 2)[2].strip())
        except (IndexError, KeyError, ValueError):
            raise damaged(path, f"its header says {' '.join(words)[:80]!r}") from None
    names = [element.name for element in elements]
    if kind not in FORMATS or len(set(names)) < len(names) or any(e.count < 0 or not e.properties for e in elements):
        raise damaged(path, "its header is not understood")
    return Header(kind, elements, textures, size)


def _text(data: bytes, header: Header, path: Path) -> dict[str, Columns]:
    lines = [line for line in data[header.size :].split(b"\n") if line.strip()]
    claimed = sum(element.count for element in header.elements)
    if claimed > len(lines):
        raise damaged(path, f"claims {claimed!s:.20} lines, has {len(lines)}")
    table, at = {}, 0
    for element in header.elements:
        rows = [line.split() for line in lines[at : at + element.count]]
        at += element.count
        if any(len(row) < len(element.properties) for row in rows):
            raise damaged(path, f"a line of {element.name} is too short")
        if any(length is not None for _, _, length in element.properties):
            table[element.name] = _text_lists(rows, element, path)
            continue
        width = len(element.properties)
        values = floats((word for row in rows for word in row[:width]), path).reshape(-1, width)
        table[element.name] = {name: values[:, k] for k, (name, _, _) in enumerate(element.properties)}
    return table


def _text_lists(rows: list[list[bytes]], element: Element, path: Path) -> Columns:
    words: list[list[bytes]] = [[] for _ in element.properties]
    sizes: list[list[int]] = [[] for _ in element.properties]
    for row in rows:
        at = 0
        for k, (_, _, length) in enumerate(element.properties):
            try:
                size = 1 if length is None else int(row[at])
            except (IndexError, ValueError):
                raise damaged(path, f"a line of {element.name} is too short") from None
            at += length is not None
            if not 0 <= size <= len(row) - at:
                raise damaged(path, f"a line of {element.name} is too short")
            words[k] += row[at : at + size]
            sizes[k].append(size)
            at += size
    return {
        name: floats(words[k], path) if length is None else Lists(np.array(sizes[k], np.int64), floats(words[k], path))
        for k, (name, _, length) in enumerate(element.properties)
    }


def _binary(data: bytes, header: Header, path: Path) -> dict[str, Columns]:
    table, at = {}, header.size
    for element in header.elements:
        table[element.name], at = _binary_element(data, at, element, FORMATS[header.format], path)
    return table


def _binary_element(data: bytes, at: int, element: Element, order: str, path: Path) -> tuple[Columns, int]:
    """Its columns, and where it ends."""
    smallest = sum(np.dtype(length or type_).itemsize for _, type_, length in element.properties)
    if element.count * smallest > len(data) - at:
        raise damaged(path, f"claims {element.count!s:.20} of {element.name}")
    if not element.count:
        empty = np.empty(0)
        return {
            name: empty if length is None else Lists(np.empty(0, np.int64), empty)
            for name, _, length in element.properties
        }, at
    sizes = _sizes_of_one(data, at, element, order, path)  # mostly those of all
    fields = []
    for k, (_, type_, length) in enumerate(element.properties):
        if length is not None:
            fields.append((f"size{k}", order + length))
            fields.append((f"value{k}", order + type_, (sizes[k],)))  # type: ignore[arg-type]
        else:
            fields.append((f"value{k}", order + type_))
    dtype = np.dtype(fields)
    end = at + element.count * dtype.itemsize
    if end <= len(data):
        rows = np.frombuffer(data, dtype, element.count, at)
        lists = [k for k, (_, _, length) in enumerate(element.properties) if length is not None]
        if all((rows[f"size{k}"] == sizes[k]).all() for k in lists):
            return {
                name: rows[f"value{k}"].astype(np.float64)
                if length is None
                else Lists(np.full(element.count, sizes[k]), rows[f"value{k}"].astype(np.float64).ravel())
                for k, (name, _, length) in enumerate(element.properties)
            }, end
    return _binary_lists(data, at, element, order, path)


def _binary_lists(data: bytes, at: int, element: Element, order: str, path: Path) -> tuple[Columns, int]:
    """One row at a time, where the lengths of lists differ."""
    values: list[list[Floats]] = [[] for _ in element.properties]
    sizes: list[list[int]] = [[] for _ in element.properties]
    types = [np.dtype(order + type_) for _, type_, _ in element.properties]
    for _ in range(element.count):
        of_row = _sizes_of_one(data, at, element, order, path)
        for k, (_, _, length) in enumerate(element.properties):
            at += np.dtype(length).itemsize if length is not None else 0
            values[k].append(np.frombuffer(data, types[k], of_row[k], at))
            sizes[k].append(of_row[k])
            at += of_row[k] * types[k].itemsize
    joined = [np.concatenate(column).astype(np.float64) for column in values]
    return {
        name: joined[k] if length is None else Lists(np.array(sizes[k], np.int64), joined[k])
        for k, (name, _, length) in enumerate(element.properties)
    }, at


def _sizes_of_one(data: bytes, at: int, element: Element, order: str, path: Path) -> list[int]:
    """How many values each property of the row at `at` has, all of which lie within the file."""
    sizes = []
    for _, type_, length in element.properties:
        size = 1
        if length is not None:
            width = np.dtype(length).itemsize
            if at + width > len(data):
                raise damaged(path, f"{element.name} is not whole")
            size = int(np.frombuffer(data, order + length, 1, at)[0])
            at += width
        at += size * np.dtype(type_).itemsize
        if size < 0 or at > len(data):
            raise damaged(path, f"{element.name} is not whole")
        sizes.append(size)
    return sizes


def _together(columns: Columns, names: str | tuple[str, ...]) -> Floats | None:
    """(N, k) of k columns of numbers, or None where one is missing."""
    found = [columns.get(name) for name in names]
    arrays = [column for column in found if isinstance(column, np.ndarray)]
    return np.stack(arrays, axis=1) if len(arrays) == len(names) else None


def _colours(columns: Columns) -> Floats | None:
    for names in (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")):
        if (values := _together(columns, names)) is not None:
            return colours_01(values)
    return None
