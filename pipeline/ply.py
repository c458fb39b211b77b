"""Point clouds in PLY files, ASCII or binary, as PyTorch3D and most tools write them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.geometry import Floats

LONGEST_HEADER = 1 << 16
END = b"end_header"
REMEDY = "Write or download it again"
FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
         "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
         "float32": "f4", "float64": "f8"}  # fmt: skip


@dataclass(frozen=True)
class Points:
    """Points (N, 3) and their colours (N, 3) uint8 RGB, or None."""

    xyz: Floats
    rgb: NDArray[np.uint8] | None

    def thinned(self, count: int) -> Points:
        """At most so many of them, evenly chosen."""
        if len(self.xyz) <= count:
            return self
        chosen = np.linspace(0, len(self.xyz) - 1, count).astype(np.int64)
        return Points(self.xyz[chosen], None if self.rgb is None else self.rgb[chosen])


def read_ply(path: Path) -> Points:
    """The vertices of a PLY file, which must be its first element, and their colours (uchar, or floats from 0 to 1).

    Points that are not finite are left out; none may be left.

    Raises:
        BadInput: the file is no such PLY, is cut off, or claims more vertices than it holds.
    """
    try:
        with path.open("rb") as file:
            head = file.read(LONGEST_HEADER)
            header, found, _ = head.partition(END)
            start = head.find(b"\n", len(header)) + 1
            if not head.startswith(b"ply") or not found or not start:
                raise BadInput("is not a PLY file", where=path)
            kind, count, fields = _parse_header(header.decode(errors="replace"), path)
            file.seek(start)
            table = _read_table(file.read(), kind, count, fields, path)
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
    names = table.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise BadInput("is a PLY file without x, y, z", where=path)
    xyz = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1)
    finite = np.isfinite(xyz).all(axis=1)
    rgb = None
    if {"red", "green", "blue"} <= set(names):
        colours = np.stack([table[name] for name in ("red", "green", "blue")], axis=1)
        if np.issubdtype(colours.dtype, np.floating):
            colours = np.rint(np.clip(np.nan_to_num(colours), 0, 1) * 255)
        rgb = colours.astype(np.uint8)[finite]
    return Points(xyz[finite], rgb)


def _parse_header(header: str, path: Path) -> tuple[str, int, list[tuple[str, str]]]:
    """Format, number of vertices, and (name, NumPy type) of their properties."""
    kind, count, fields, element = "", -1, list[tuple[str, str]](), 0
    for words in (line.split() for line in header.splitlines()):
        try:
            if words[:1] == ["format"]:
                kind = words[1]
            elif words[:1] == ["element"]:
                element += 1
                if element == 1:
                    count = int(words[2]) if words[1] == "vertex" else -1
            elif words[:1] == ["property"] and element == 1:
                fields.append((words[2], TYPES[words[1]]))
        except (IndexError, KeyError, ValueError):
            raise BadInput(f"has a PLY header that is not understood ({' '.join(words)[:80]!r})", where=path) from None
    if kind not in FORMATS or count < 0 or not fields or len(dict(fields)) < len(fields):
        raise BadInput("has a PLY header that is not understood", where=path)
    return kind, count, fields


def _read_table(body: bytes, kind: str, count: int, fields: list[tuple[str, str]], path: Path) -> NDArray[np.void]:
    dtype = np.dtype([(name, FORMATS[kind] + type_) for name, type_ in fields])
    shortest = dtype.itemsize if kind != "ascii" else len(fields)  # a digit for each
    if count * shortest > len(body):
        raise BadInput(f"is cut off: it claims {count!s:.20} points", where=path, remedy=REMEDY)
    if kind != "ascii":
        return np.ndarray(count, dtype, body)
    try:
        values = np.array(body.split(None, count * len(fields))[: count * len(fields)], dtype=np.float64)
        rows = values.reshape(count, len(fields))
    except ValueError as error:
        raise BadInput(f"is cut off or damaged ({error})", where=path, remedy=REMEDY) from error
    table = np.empty(count, dtype)
    for column, (name, _) in enumerate(fields):
        table[name] = rows[:, column]
    return table
