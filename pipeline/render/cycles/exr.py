"""OpenEXR files as Blender writes them without compression: one part, scan lines, 16- or 32-bit channels."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

MAGIC = 20000630
_TYPES = ("<u4", "<f2", "<f4")
_UNUSUAL_FLAGS = 0x200 | 0x800 | 0x1000
"""Tiles, deep data, several parts."""


def read_exr(path: Path) -> dict[str, NDArray[np.float32]]:
    """Channels of an uncompressed EXR file, each (H, W), by name ("ViewLayer.Depth.Z").

    Format: openexr.com, "OpenEXR File Layout": magic, version, attributes (name, type, size, value), a table of
    offsets, then for each scan line its y, its size, and channel after channel.

    Raises:
        ValueError: it is something else, or not whole.
    """
    data = path.read_bytes()
    try:
        attributes, place = _read_header(data)
        x1, y1, x2, y2 = struct.unpack("<4i", attributes["dataWindow"])
        if attributes["compression"] != b"\0":
            raise ValueError("is compressed")
        channels = _channels(attributes["channels"])
    except (struct.error, KeyError, IndexError) as error:
        raise ValueError(f"no EXR header: {error!r}") from None
    width, height = x2 - x1 + 1, y2 - y1 + 1
    row = np.dtype(
        [("y", "<i4"), ("size", "<i4"), *((f"c{i}", kind, (width,)) for i, (_, kind) in enumerate(channels))]
    )
    if len(data) < place + height * (8 + row.itemsize):
        raise ValueError(f"ends after {len(data)} bytes")
    rows = np.frombuffer(data, row, count=height, offset=place + 8 * height)
    if not np.array_equal(rows["y"], np.arange(y1, y2 + 1)) or np.any(rows["size"] != row.itemsize - 8):
        raise ValueError("scan lines in another order or of another size than its header says")
    return {name: rows[f"c{i}"].astype(np.float32) for i, (name, _) in enumerate(channels)}


def _read_header(data: bytes) -> tuple[dict[str, bytes], int]:
    magic, version = struct.unpack_from("<ii", data)
    if magic != MAGIC or version & _UNUSUAL_FLAGS:
        raise ValueError("is no EXR of scan lines in one part")
    place, attributes = 8, {}
    while data[place]:
        name, place = _text(data, place)
        _, place = _text(data, place)
        (size,) = struct.unpack_from("<i", data, place)
        attributes[name] = data[place + 4 : place + 4 + size]
        place += 4 + size
    return attributes, place + 1


def _channels(data: bytes) -> list[tuple[str, str]]:
    place, channels = 0, []
    while data[place]:
        name, place = _text(data, place)
        kind, _, xs, ys = struct.unpack_from("<4i", data, place)
        if (xs, ys) != (1, 1):
            raise ValueError(f"channel {name} is subsampled")
        channels.append((name, _TYPES[kind]))
        place += 16
    return channels


def _text(data: bytes, place: int) -> tuple[str, int]:
    end = data.index(b"\0", place)
    return data[place:end].decode(), end + 1
