"""Bytes, words and numbers of mesh files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.geometry import Floats

WRITE_AGAIN = "Export or download it again"
ROOM = 1 << 28
BYTES_A_FACE = 512


def read(path: Path, max_faces: int) -> bytes:
    """All of a file, unless it is far larger than `max_faces` faces and their pictures need."""
    try:
        size, most = path.stat().st_size, ROOM + BYTES_A_FACE * max_faces
        if size > most:
            raise BadInput(f"is huge ({size >> 20} MiB, at most {most >> 20})", where=path, remedy=simplify(max_faces))
        if not size:
            raise BadInput("is an empty file", where=path, remedy=WRITE_AGAIN)
        return path.read_bytes()
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error


def simplify(max_faces: int) -> str:
    """The remedy for a mesh of more than `max_faces` faces."""
    return f"Simplify it, or allow more with --set mesh.max_faces (now {max_faces})"


def require_faces(count: int, max_faces: int, path: Path) -> None:
    """Refuse a mesh of more faces than allowed, or of none."""
    if count > max_faces:
        raise BadInput(f"has {count!s:.20} faces, more than {max_faces}", where=path, remedy=simplify(max_faces))
    if count <= 0:
        raise BadInput("has no faces", where=path, remedy="Only surfaces can be rendered, no points or lines")


def require_indices(indices: NDArray[np.int64], count: int, path: Path) -> None:
    """Refuse indices that are not from 0 to `count` - 1."""
    if len(indices) and not 0 <= int(indices.min()) <= int(indices.max()) < count:
        wrong = indices[(indices < 0) | (indices >= count)][0]
        raise BadInput(f"a face refers to vertex {wrong}, there are {count}", where=path, remedy=WRITE_AGAIN)


def floats(words: Iterable[bytes], path: Path) -> Floats:
    """Numbers in text. Words are not given to NumPy as they are: its array of them is as wide as the longest."""
    try:
        return np.fromiter(map(float, words), np.float64)
    except ValueError as error:
        raise damaged(path, str(error)) from None


def integers(words: Iterable[bytes], path: Path) -> NDArray[np.int64]:
    """Whole numbers in text."""
    try:
        return np.fromiter(map(int, words), np.int64)
    except (ValueError, OverflowError) as error:
        raise damaged(path, str(error)) from None


def damaged(path: Path, why: str) -> BadInput:
    """The error of a file that is not what its format says."""
    return BadInput(f"is cut off or damaged ({why[:120]})", where=path, remedy=WRITE_AGAIN)


def colours_01(values: Floats) -> Floats:
    """(N, 3) colours in [0, 1] of what may count from 0 to 255."""
    values = np.nan_to_num(values[:, :3])
    return np.clip(values / 255 if len(values) and values.max() > 1 else values, 0, 1)
