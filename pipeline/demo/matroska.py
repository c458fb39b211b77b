"""Matroska and WebM files without their random identifiers, so that equal pictures give equal bytes.

The writer draws a segment UID and track UIDs at random (RFC 9559, 5.1.2.1 and 5.1.4.1.2); no player
needs them to differ.
"""

from __future__ import annotations

import re
import zlib
from pathlib import Path

_SEGMENT = b"\x18\x53\x80\x67"
_HEADERS = (b"\x15\x49\xa9\x66", b"\x16\x54\xae\x6b", b"\x12\x54\xc3\x67")  # Info, Tracks, Tags
_UIDS = re.compile(rb"(?s)(\x73\xa4\x90).{16}|([\x73\x63]\xc5\x88).{8}")  # SegmentUID; TrackUID and TagTrackUID
_CRC32 = b"\xbf\x84"


def make_reproducible(path: Path) -> None:
    """Overwrite the UIDs of a finished one-track file in place with ones, and mend the headers' checksums."""
    data = bytearray(path.read_bytes())
    at = data.index(_SEGMENT) + len(_SEGMENT)
    _, at = _size(data, at)
    while at < len(data):
        name = bytes(data[at : at + _length(data[at])])
        size, start = _size(data, at + len(name))
        if name in _HEADERS:
            body = _UIDS.sub(_ones, bytes(data[start : start + size]))
            if body.startswith(_CRC32):
                body = _CRC32 + zlib.crc32(body[6:]).to_bytes(4, "little") + body[6:]
            data[start : start + size] = body
        at = start + size
    path.write_bytes(data)


def _ones(match: re.Match[bytes]) -> bytes:
    name = match[1] or match[2]
    return name + (len(match[0]) - len(name)) * b"\x01"


def _length(first: int) -> int:
    """Bytes of an EBML number: one more than the leading zeros of its first byte."""
    return 9 - first.bit_length()


def _size(data: bytearray, at: int) -> tuple[int, int]:
    """The data size written at `at`, and where the data starts."""
    length = _length(data[at])
    number = int.from_bytes(data[at : at + length], "big") & ((1 << 7 * length) - 1)
    return number, at + length
