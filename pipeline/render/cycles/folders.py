"""Private folders in memory for what two processes hand each other; none outlives its owner for long."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

_PREFIX = "dope-cycles-"
_ROOM = 1 << 30
_MEMORY = Path("/dev/shm")


class PrivateFolder:
    """A folder of this process alone, on /dev/shm where that has a GiB of room, else with other temporary files.

    A process that is killed cannot clean up: each new folder removes those whose owner, which holds a lock on a file
    in it, is no more.
    """

    def __init__(self, where: Path | None = None) -> None:
        where = where or _roomy()
        sweep(where)
        # under another name until it is locked, so that nobody takes it for abandoned
        new = Path(tempfile.mkdtemp(prefix=f".{_PREFIX}", dir=where))
        self._lock = os.open(new / "lock", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        self.path = where / new.name.removeprefix(".")
        new.rename(self.path)

    def close(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


def _roomy() -> Path:
    with suppress(OSError):
        if os.access(_MEMORY, os.W_OK) and shutil.disk_usage(_MEMORY).free > _ROOM:
            return _MEMORY
    return _temporary()


def _temporary() -> Path:
    return Path(tempfile.gettempdir())


def sweep(*places: Path) -> None:
    """Remove the folders that processes left which are no more; by default wherever they may lie."""
    for folder in (path for where in places or (_MEMORY, _temporary()) for path in where.glob(f"{_PREFIX}*")):
        with suppress(OSError):
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            lock = os.open(folder / "lock", os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)
