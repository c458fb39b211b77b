"""Descriptors of many views: in memory up to a bound, beyond it in a file that is read by memory mapping.

The file has no name: it is deleted before anything is written to it, so that the system frees its space when the
process ends, however it ends.
"""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import DiskFull, UsageError
from dope.lowshot.encoding import ViewCells

GIB = 2**30


class Place(NamedTuple):
    """Where an array lies in a `SpillFile`, and what it is."""

    start: int
    shape: tuple[int, ...]
    dtype: np.dtype[Any]


class SpillFile:
    """An anonymous file of arrays of 4-byte numbers, appended one after another and read back as memory maps.

    Args:
        folder: on whose disk it lies; None: the system's temporary folder.

    Raises:
        UsageError: the folder is absent or cannot be written to.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = Path(tempfile.gettempdir()) if folder is None else folder
        try:
            self._file: IO[bytes] = tempfile.TemporaryFile(dir=self.folder)  # noqa: SIM115 - lives as long as this object
        except OSError as error:
            what = f"cannot be written to ({error.strerror})"
            raise UsageError(what, where=f"--cache {self.folder}", remedy="Name a folder that is there") from error
        self._end = 0

    @property
    def free(self) -> int:
        """Bytes that the disk has left."""
        return shutil.disk_usage(self.folder).free

    def append(self, array: NDArray[Any]) -> Place:
        """Write an array; returns what `read` needs. Raises `DiskFull`."""
        place = Place(self._end, array.shape, array.dtype)
        with self._explaining():
            self._file.seek(self._end)
            self._file.write(np.ascontiguousarray(array).tobytes())
            self._file.flush()
        self._end += array.nbytes
        return place

    def reserve(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """An array on the disk that can be written to. Raises `DiskFull` now, since a full disk would kill later."""
        dtype = np.dtype(np.float32)
        size = int(np.prod(shape)) * dtype.itemsize
        with self._explaining():
            os.posix_fallocate(self._file.fileno(), self._end, max(1, size))
        array = np.memmap(self._file, dtype, "r+", self._end, shape)
        self._end += size
        return array

    def read(self, place: Place) -> NDArray[Any]:
        """An array that was appended, into memory."""
        if 0 in place.shape:
            return np.empty(place.shape, place.dtype)
        return np.array(np.memmap(self._file, place.dtype, "r", place.start, place.shape))

    def close(self) -> None:
        self._file.close()

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise
            raise DiskFull(
                f"no space left for descriptors beyond --memory ({self._end / GIB:.1f} GiB were written)",
                where=self.folder,
                remedy="Give --cache a folder on a disk with more space, or raise --memory",
            ) from error


class CellStore:
    """Cells of views, each put in once and taken out once.

    Args:
        spill: where those go that memory has no room for; None: they are refused, and have to be encoded again.
    """

    def __init__(self, spill: SpillFile | None) -> None:
        self._file, self._held = spill, 0
        self._accepts = spill is not None
        self._kept: dict[int, ViewCells] = {}
        self._spilled: dict[int, tuple[Callable[..., ViewCells], list[Place]]] = {}
        self.spill_seconds = 0.0

    @property
    def spilled(self) -> int:
        """Views in the file."""
        return len(self._spilled)

    def put(self, view: int, cells: ViewCells, room: float) -> bool:
        """Keep a view's cells, in memory while all of them take `room` bytes at most; False where there is no place.

        Raises:
            DiskFull: no space left in the file.
        """
        if self._held + cells.nbytes <= room:
            self._held += cells.nbytes
            self._kept[view] = cells
            return True
        if self._file is None or not self._accepts:
            return False
        started = time.perf_counter()
        rebuild, arrays = cells.packed()
        self._spilled[view] = rebuild, [self._file.append(array) for array in arrays]
        self.spill_seconds += time.perf_counter() - started
        return True

    def stop_spilling(self) -> None:
        """From now on refuse views that memory has no room for."""
        self._accepts = False

    def take_all(self) -> Iterator[tuple[int, ViewCells]]:
        """All views, those in memory first; each is forgotten once it was given."""
        while self._kept:
            view = next(iter(self._kept))
            yield view, self._kept.pop(view)
        while self._spilled:
            view = next(iter(self._spilled))
            rebuild, places = self._spilled.pop(view)
            assert self._file is not None
            yield view, rebuild(*map(self._file.read, places))
