"""How large an image says it is, read from its header: what claims too much is refused before anything is allocated.

A PNG of 100 bytes can claim 60,000 x 60,000 pixels: 10 GB for a decoder that believes it.
"""

from __future__ import annotations

import re
import struct

from dope.common.errors import BadInput

MAX_MEGAPIXELS = 200
"""Larger images are refused. The largest sensors of today's cameras have 150 to 200 megapixels."""

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"


def refuse_huge(data: bytes) -> None:
    """Raise `BadInput` (without a file's name) where an image's header claims more than `MAX_MEGAPIXELS`.

    Knows PNG, JPEG, TIFF and BigTIFF, BMP, WebP and OpenEXR; a header that it cannot read is left to the decoder.
    """
    try:
        size = claimed_size(data)
    except struct.error:  # cut off in the middle of its header
        return
    if size is not None and size[0] * size[1] > MAX_MEGAPIXELS * 10**6:
        raise BadInput(
            f"claims {size[0]}x{size[1]} pixels, more than the {MAX_MEGAPIXELS} megapixels that are allowed",
            remedy="Shrink it, or leave it out if it is broken",
        )


def claimed_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) in the header of an encoded image, or None. Raises `struct.error` where it is cut off."""
    if data.startswith(PNG_MAGIC):
        width, height = struct.unpack_from(">II", data, 16)
        return width, height
    if data.startswith(b"\xff\xd8"):
        return _jpeg(data)
    if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _tiff(data)
    if data.startswith(b"BM"):
        width, height = struct.unpack_from("<ii", data, 18)
        return abs(width), abs(height)  # a negative height says that the rows run downwards
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return _webp(data)
    if data.startswith(b"\x76\x2f\x31\x01"):
        return _exr(data)
    return None


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """The largest frame header before the image data: the decoder obeys the last, and a thumbnail lies in none."""
    sizes, position = [], data.find(b"\xff", 2)  # decoders skip what lies between two segments, so do we
    while 0 <= position <= len(data) - 4:
        marker, (length,) = data[position + 1], struct.unpack_from(">H", data, position + 2)
        if marker == 0xFF:  # a fill byte before a marker
            position += 1
            continue
        if marker == 0xDA:
            break
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, position + 5)
            sizes.append((width, height))
        position = data.find(b"\xff", position + 2 + length)
    return max(sizes, key=lambda size: size[0] * size[1], default=None)


def _tiff(data: bytes) -> tuple[int, int] | None:
    """Tags 256 and 257 of the first directory."""
    order, big = "<" if data[:2] == b"II" else ">", 43 in data[2:4]
    (offset,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, offset)
    first, step, value_at = (offset + 8, 20, 12) if big else (offset + 2, 12, 8)
    size = {}
    for entry in range(first, min(first + step * count, len(data)), step):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if tag in (256, 257):
            formats = {3: "H", 4: "I", 16: "Q"}
            (size[tag],) = struct.unpack_from(order + formats.get(kind, "I"), data, entry + value_at)
    return (size[256], size[257]) if len(size) == 2 else None


def _webp(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None


def _exr(data: bytes) -> tuple[int, int] | None:
    """The first part's `dataWindow`: x and y of its first and last pixel."""
    found = re.search(rb"dataWindow\0box2i\0\x10\0\0\0", data[: 1 << 16])
    if found is None:
        return None
    left, top, right, bottom = struct.unpack_from("<4i", data, found.end())
    return max(0, right - left + 1), max(0, bottom - top + 1)
