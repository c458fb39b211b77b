"""One training at a time in a RUN folder."""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dope.common.errors import DopeError

LOCK = ".lock"
logger = logging.getLogger(__name__)


@contextmanager
def only_one(run: Path) -> Iterator[None]:
    """Hold RUN/.lock, so that no second process trains into `run`, on this machine or on another that shares it.

    The lock goes with the process however that ends. It is one of POSIX: the loader's forked workers, which live a
    little longer than a trainer that is killed, do not inherit it.

    Raises:
        DopeError: another process holds it.
    """
    run.mkdir(parents=True, exist_ok=True)
    with (run / LOCK).open("a+", encoding="utf-8") as file:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN):
                file.seek(0)
                raise DopeError(
                    f"another process trains into it ({file.read().strip() or 'no more is known of it'})",
                    where=run,
                    remedy="Wait for it, stop it, or give another --out",
                ) from error
            logger.warning("%s: this file system has no locks; let no second process train into it", run)
        else:
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()
        yield
