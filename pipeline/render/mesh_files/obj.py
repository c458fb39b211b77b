"""Wavefront OBJ files and their materials (MTL)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from mmap import mmap
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.geometry import Floats
from pipeline.render.mesh_files.beside import beside, decode_texture, read_beside
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

LIBRARY = re.compile(rb"^[ \t]*mtllib[ \t]([^\r\n]*)", re.MULTILINE)
LARGEST_LIBRARY = 1 << 24
"""Bytes; some hundred thousand materials."""
MAP_OPTIONS = {"-blendu": 1, "-blendv": 1, "-boost": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-texres": 1, "-type": 1,
               "-bm": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3}  # fmt: skip
"""Options before the file's name in `map_Kd`, and how many words follow each (at most, for -o, -s, -t)."""


@dataclass(frozen=True)
class Material:
    """Diffuse colour and the name of its picture."""

    colour: tuple[float, float, float] | None = None
    texture: str | None = None


@dataclass(frozen=True)
class Words:
    """Words of lines, one line after the other; a list a line would keep Python's garbage collector busy."""

    words: list[bytes]
    sizes: NDArray[np.int64]
    """(N,) of each line."""

    @classmethod
    def of(cls, lines: list[bytes]) -> Words:
        sizes = np.fromiter([len(line.split()) for line in lines], np.int64)
        return cls(b" ".join(lines).split(), sizes)

    def numbers(self, width: int, path: Path) -> Floats:
        """(N, `width`) the first numbers of each line, none of which is shorter."""
        if len(self.words) == width * len(self.sizes):
            return floats(self.words, path).reshape(-1, width)
        starts = np.cumsum(self.sizes) - self.sizes
        rows = (starts[:, None] + np.arange(width)).ravel().tolist()
        return floats((self.words[row] for row in rows), path).reshape(-1, width)


@dataclass(frozen=True)
class Lines:
    """The lines of an OBJ file by what they are, without the first word."""

    v: Words
    vt: Words
    vn: Words
    faces: Words
    materials: list[tuple[int, str]]
    """From which face on which material is in use."""


def read_obj(path: Path, max_faces: int) -> list[Part]:
    """The mesh of an OBJ file, a part for each material: its normals, texture coordinates and colours of vertices.

    A material that the library does not have, or a library that is absent, is none: its faces get no look.

    Raises:
        BadInput: it is cut off, refers to vertices that it lacks, has too many faces, refers to files outside its
            folder, or a texture of a material in use is missing.
    """
    data = read(path, max_faces)
    lines = _lines(data, path)
    sizes = lines.faces.sizes
    require_faces(len(sizes), max_faces, path)
    xyz, colours = _vertices(lines.v, path)
    uv, vn = _table(lines.vt, 2, path), _table(lines.vn, 3, path)
    if sizes.min() < 3:
        raise damaged(path, "a face has fewer than three corners")
    refs = _corners(lines.faces.words, path)
    for k, count in enumerate((len(xyz), len(uv), len(vn))):
        used = refs[:, k] if k == 0 else refs[refs[:, k] >= 0, k]
        require_indices(used, count, path)
    cut, owner = triangulate(xyz[refs[:, 0]], sizes, path)
    require_faces(len(cut), max_faces, path)
    library = read_materials(path, data)
    textures: dict[str, NDArray[np.uint8]] = {}
    parts = []
    for name, faces in _by_material(lines.materials, owner):
        material = library.get(name, Material())
        part = _part(cut[faces], refs, xyz, colours, uv, vn, material)
        if material.texture is not None and part.uv is not None:
            if material.texture not in textures:
                picture = read_beside(path, material.texture, "texture")
                textures[material.texture] = decode_texture(picture, path, material.texture)
            part = Part(
                part.vertices, part.faces, part.normals, part.uv, None, textures[material.texture], (1.0, 1.0, 1.0)
            )
        parts.append(part)
    return parts


def _lines(data: bytes, path: Path) -> Lines:
    v: list[bytes] = []
    vt: list[bytes] = []
    vn: list[bytes] = []
    faces: list[bytes] = []
    materials: list[tuple[int, str]] = []
    lists = {b"v": v, b"vt": vt, b"vn": vn, b"f": faces}
    if b"\\" in data:  # a line that goes on
        data = re.sub(rb"\\\r?\n", b" ", data)
    for line in data.splitlines():
        kind, _, rest = line.partition(b" ")
        if kind not in lists:
            words = line.split(None, 1)
            if not words or (words[0] not in lists and words[0] != b"usemtl"):
                continue
            kind, rest = words[0], words[1] if len(words) > 1 else b""
            if kind == b"usemtl":
                materials.append((len(faces), rest.strip().decode(errors="surrogateescape")))
                continue
        if b"#" in rest:
            rest = rest.partition(b"#")[0]
        if kind == b"f" and b"-" in rest:
            rest = b" ".join([_absolute(word, (len(v), len(vt), len(vn)), path) for word in rest.split()])
        lists[kind].append(rest)
    return Lines(Words.of(v), Words.of(vt), Words.of(vn), Words.of(faces), materials)


def _absolute(word: bytes, counts: tuple[int, int, int], path: Path) -> bytes:
    """A corner whose negative numbers count back from the last line before the face."""
    numbers = word.split(b"/")
    try:
        return b"/".join(
            b"%d" % (counts[k] + 1 + int(number)) if number.startswith(b"-") else number
            for k, number in enumerate(numbers[:3])
        )
    except ValueError as error:
        raise damaged(path, str(error)) from None


def _vertices(lines: Words, path: Path) -> tuple[Floats, Floats | None]:
    """(V, 3) positions, and (V, 3) colours where all lines have six numbers or more."""
    if not len(lines.sizes):
        raise BadInput("has no vertices", where=path, remedy=WRITE_AGAIN)
    least = int(lines.sizes.min())
    if least < 3:
        raise damaged(path, "a vertex has fewer than three numbers")
    table = lines.numbers(6 if least in (6, 7) else 3, path)
    return np.ascontiguousarray(table[:, :3]), colours_01(table[:, 3:]) if table.shape[1] == 6 else None


def _table(lines: Words, width: int, path: Path) -> Floats:
    if not len(lines.sizes):
        return np.empty((0, width))
    least = int(lines.sizes.min())
    if width == 2 and least == 1:  # textures of one dimension
        return lines.numbers(1, path) * (1.0, 0.0)
    if least < width:
        raise damaged(path, "a normal or texture coordinate has too few numbers")
    return lines.numbers(width, path)


def _corners(words: list[bytes], path: Path) -> NDArray[np.int64]:
    """(N, 3) rows of vertices, texture coordinates and normals of all corners, from 0; -1 = none."""
    text = b" ".join(words)
    slashes, twice = text.count(b"/"), text.count(b"//")
    result = np.full((len(words), 3), -1, dtype=np.int64)
    columns = None
    if slashes == 0:
        columns = [0]
    elif slashes == len(words) * 2 and twice == len(words):
        columns = [0, 2]
    elif twice == 0 and slashes == len(words) and b"/ " not in text and not text.endswith(b"/"):
        columns = [0, 1]
    elif twice == 0 and slashes == 2 * len(words) and b"/ " not in text and not text.endswith(b"/"):
        columns = [0, 1, 2]
    if columns is not None:
        numbers = integers(text.replace(b"/", b" ").split(), path)
        if len(numbers) == len(words) * len(columns):
            result[:, columns] = numbers.reshape(-1, len(columns)) - 1
            if int(numbers.min()) < 1:
                raise damaged(path, "a face refers to vertex 0 or below")
            return result
    for row, word in enumerate(words):
        for k, number in enumerate(word.split(b"/")[:3]):
            if number or k == 0:
                try:
                    result[row, k] = int(number) - 1
                except (ValueError, OverflowError) as error:
                    raise damaged(path, str(error)) from None
                if result[row, k] < 0:
                    raise damaged(path, "a face refers to vertex 0 or below")
    return result


def _by_material(changes: list[tuple[int, str]], owner: NDArray[np.int64]) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """The triangles of each material, in the order of first use."""
    names: dict[str, int] = {}
    starts = [0, *(face for face, _ in changes)]
    numbers = [names.setdefault(name, len(names)) for name in ["", *(name for _, name in changes)]]
    of_face = np.array(numbers)[np.searchsorted(starts, owner, side="right") - 1]
    for name, number in names.items():
        faces = np.nonzero(of_face == number)[0]
        if len(faces):
            yield name, faces


def _part(
    cut: NDArray[np.int64],
    refs: NDArray[np.int64],
    xyz: Floats,
    colours: Floats | None,
    uv: Floats,
    vn: Floats,
    material: Material,
) -> Part:
    """The triangles `cut` (rows of `refs`), with a vertex for each combination of position, coordinate and normal."""
    used = refs[cut.ravel()]
    has_uv, has_vn = bool((used[:, 1] >= 0).all()), bool((used[:, 2] >= 0).all())
    combined = used[:, 0].copy()
    for k, count, has in ((1, len(uv), has_uv), (2, len(vn), has_vn)):
        if has:  # numbered anew each time: three counts multiplied may be too large for an integer
            combined = np.unique(combined, return_inverse=True)[1] * count + used[:, k]
    _, first, faces = np.unique(combined, return_index=True, return_inverse=True)
    rows = used[first]
    return Part(
        xyz[rows[:, 0]],
        faces.reshape(-1, 3),
        vn[rows[:, 2]] if has_vn else None,
        uv[rows[:, 1]] if has_uv else None,
        None if colours is None else colours[rows[:, 0]],
        None,
        material.colour,
    )


def read_materials(path: Path, data: bytes) -> dict[str, Material]:
    """The materials of the libraries that an OBJ file names. Those that are absent have none.

    Raises:
        BadInput: a library lies outside the mesh's folder.
    """
    materials: dict[str, Material] = {}
    for name in library_names(path, data):
        library = beside(path, name)
        if library.is_file():
            materials |= read_library(library)
    return materials


def library_names(path: Path, data: bytes | mmap) -> Iterator[str]:
    """The material libraries that an OBJ file names."""
    for match in LIBRARY.finditer(data):
        whole = match[1].decode(errors="surrogateescape").strip(" \t")
        if not whole:
            continue
        try:
            single = len(whole.split()) < 2 or beside(path, whole).is_file()
        except (BadInput, OSError):
            single = False
        yield from [whole] if single else whole.split()  # one name with spaces, or several names


def read_library(path: Path) -> dict[str, Material]:
    """The materials of an MTL file. Raises `BadInput` where it cannot be read."""
    try:
        if (size := path.stat().st_size) > LARGEST_LIBRARY:
            what = f"is huge for a library of materials ({size >> 20} MiB, at most {LARGEST_LIBRARY >> 20})"
            raise BadInput(what, where=path, remedy="Is it the file that the mesh means?")
        text = path.read_bytes().decode(errors="surrogateescape")
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
    materials: dict[str, Material] = {}
    name = None
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["newmtl"]:
            name = line.split(None, 1)[1].strip() if len(words) > 1 else ""
            materials[name] = Material()
        elif name is not None and words[:1] == ["Kd"]:
            materials[name] = Material(_colour(words[1:4]), materials[name].texture)
        elif name is not None and words and words[0].lower() == "map_kd" and (texture := _texture_name(line)):
            materials[name] = Material(materials[name].colour, texture)
    return materials


def _colour(words: list[str]) -> tuple[float, float, float] | None:
    try:
        r, g, b = (min(max(float(word), 0.0), 1.0) for word in (words if len(words) == 3 else words[:1] * 3))
    except ValueError:  # `Kd spectral file.rfl`, or none
        return None
    return r, g, b


def _texture_name(line: str) -> str:
    rest = line.split(None, 1)[1].strip() if len(line.split()) > 1 else ""
    while rest.startswith("-"):
        option, _, rest = rest.partition(" ")
        for _ in range(MAP_OPTIONS.get(option.lower(), 1)):
            word, _, after = rest.strip().partition(" ")
            if option in ("-o", "-s", "-t") and not re.fullmatch(r"[-+.\deE]+", word):
                break
            rest = after
        rest = rest.strip()
    return rest
