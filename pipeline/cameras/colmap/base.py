"""What every part of the door to COLMAP needs: pycolmap imported safely, and its errors in our words."""

from __future__ import annotations

import signal
import threading

# zlib comes before pycolmap: the wheel exports deflate symbols of its own, and if they are bound first, a later
# zlib.compress, gzip write, np.savez_compressed or PNG encode aborts the process ("free(): invalid pointer").
import zlib  # noqa: F401
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import pycolmap

from dope.common.errors import DopeError

CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]
CPU = pycolmap.Device.cpu

pycolmap.logging.logtostderr = True  # else glog leaves files in the temporary folder
pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)  # whatever matters is checked in the results
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is not None:
    # importing pycolmap installs a C++ handler of SIGTERM; Python still knows the one that was there
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


class ColmapError(DopeError):
    """COLMAP refused its input or failed inside."""


@contextmanager
def explained(what: str, where: Path) -> Iterator[None]:
    """Errors of COLMAP inside become a `ColmapError` that says what could not be done, and to which file."""
    try:
        yield
    except (ValueError, RuntimeError, IndexError) as error:  # what pycolmap makes of C++ checks and exceptions
        raise ColmapError(f"{what} ({error})", where=where) from error


@contextmanager
def opened(database: Path) -> Iterator[pycolmap.Database]:
    """A database, closed again whatever happens."""
    with explained("database cannot be read", database):
        db = pycolmap.Database.open(database)
        try:
            yield db
        finally:
            db.close()
