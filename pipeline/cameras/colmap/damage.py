"""Is a binary model whole? Checked before COLMAP reads it: its readers run on past the end of a file, loop for minutes
over what they find there, and ask for the memory that random bytes announce.

Format: https://colmap.github.io/format.html, and src/colmap/scene/reconstruction_io for rigs and frames.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from pipeline.cameras.colmap.base import pycolmap


class _Bytes:
    """A file's bytes and a place in them; a step beyond the end raises EOFError."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise EOFError

    def number(self, kind: str) -> int:
        start = self.at
        self.skip(struct.calcsize(kind))
        return int(struct.unpack_from(f"<{kind}", self.data, start)[0])

    def skip_text(self) -> None:
        end = self.data.find(b"\0", self.at)
        self.skip(end + 1 - self.at if end >= 0 else len(self.data))


def damaged_file(folder: Path) -> Path | None:
    """The first file of a binary model whose records do not end where the file ends, or None."""
    for name, skip_record in _RECORDS.items():
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
        file = _Bytes(path.read_bytes())
        try:
            for _ in range(file.number("Q")):
                skip_record(file)
        except EOFError:
            return path
        if file.at != len(file.data):
            return path
    return None


def _camera(file: _Bytes) -> None:
    file.skip(4)
    model = file.number("i")
    file.skip(16)
    try:
        lens = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1)
    except (ValueError, IndexError) as error:  # no such model
        raise EOFError from error
    file.skip(8 * len(lens.params))


def _image(file: _Bytes) -> None:
    file.skip(4 + 7 * 8 + 4)
    file.skip_text()
    file.skip(24 * file.number("Q"))


def _point(file: _Bytes) -> None:
    file.skip(8 + 24 + 3 + 8)
    file.skip(8 * file.number("Q"))


def _rig(file: _Bytes) -> None:
    file.skip(4)
    sensors = file.number("I")
    file.skip(8 if sensors else 0)
    for _ in range(sensors - 1):
        file.skip(8)
        file.skip(56 if file.number("B") else 0)


def _frame(file: _Bytes) -> None:
    file.skip(8 + 56)
    file.skip(16 * file.number("I"))


_RECORDS: dict[str, Callable[[_Bytes], None]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}
