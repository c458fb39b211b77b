"""The ranks of `dope train --nproc`: started together, stopped together, and started again where one of them died.

The same as torchrun on one machine, with the same environment for the ranks, but: a rank that is asked to stop has all
the time that its step and its checkpoint need (torchrun kills it after 30 s); what is wrong is said once; an error that
would only come again starts nothing again.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from dope.common import files
from dope.common.errors import DopeError, UsageError, WorkerDied
from dope.stop_signals import EXIT_STOPPED, heeded_signals

LAUNCHER, ERRORS = "DOPE_LAUNCHER", "DOPE_RANK_ERRORS"
"""Environment of the ranks: the launcher's process, and the folder where they leave it their errors."""
LOOK_EVERY_S = 0.1
GRACE_S = 30.0
"""After one rank has died, the others have so long to end before they are killed: they may wait for it on a GPU."""
INTERRUPTED = 130
WELL = (0, EXIT_STOPPED)
SET_PARENT_DEATH_SIGNAL = 1  # of prctl(2)


def is_rank() -> bool:
    """Whether `launch` started this process."""
    return LAUNCHER in os.environ


def launch(nproc: int, max_restarts: int, command: Sequence[str] | None = None) -> int:
    """Run `command`, by default the very one that this process is, as `nproc` ranks.

    Args:
        max_restarts: times that all are started again after one died.

    Returns:
        The exit code: 0, 75 where the ranks were asked to stop, 130 after a second Ctrl-C.

    Raises:
        UsageError: this process is a rank of others already.
        DopeError: that of the ranks, or one of them died once more than `max_restarts` allows.
    """
    from torch.distributed import TCPStore

    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        remedy = "Leave it out, or unset RANK and WORLD_SIZE"
        raise UsageError(
            "torchrun, or whatever set WORLD_SIZE, has started processes already", where="--nproc", remedy=remedy
        )
    # by its file: a module would be looked for in the folder that the user is in, first of all
    command = command or [sys.executable, *sys.argv]
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)  # at a port that nobody else has
    with tempfile.TemporaryDirectory() as folder, _Asked() as asked:
        common = {
            "WORLD_SIZE": str(nproc), "LOCAL_WORLD_SIZE": str(nproc), "GROUP_RANK": "0", "MASTER_ADDR": "127.0.0.1",
            "MASTER_PORT": str(store.port), "TORCHELASTIC_USE_AGENT_STORE": "True",
            "TORCHELASTIC_RUN_ID": uuid.uuid4().hex, LAUNCHER: str(os.getpid()), ERRORS: folder,
            "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1"),
        }  # fmt: skip
        for start in range(max_restarts + 1):
            environment = {**os.environ, **common, "TORCHELASTIC_RESTART_COUNT": str(start)}
            first_death, codes = _run(nproc, command, environment, asked)
            error = _error_in(Path(folder))
            if error is not None and (asked.count or start == max_restarts or not isinstance(error, WorkerDied)):
                raise error
            if asked.count:
                if EXIT_STOPPED not in codes:
                    print("stopped, without a new checkpoint", file=sys.stderr)
                return INTERRUPTED if asked.insistent else EXIT_STOPPED
            if all(code in WELL for code in codes):
                return max(codes)
            if start < max_restarts:
                said = f"{error or first_death}; starting all processes again ({start + 1} of {max_restarts})"
                print(said, file=sys.stderr, flush=True)
        remedy = "See what was said above; with --max-restarts, all are started again from the newest checkpoint"
        raise DopeError(first_death, remedy=remedy)


@contextmanager
def as_rank() -> Iterator[None]:
    """What a rank does, its errors handed to the launcher. Nothing special where there is none."""
    if not is_rank():
        yield
        return
    if sys.platform == "linux":  # none may train on after its launcher was killed
        ctypes.CDLL(None).prctl(SET_PARENT_DEATH_SIGNAL, signal.SIGTERM)
        if os.getppid() != int(os.environ[LAUNCHER]):
            raise SystemExit(1)
    try:
        yield
    except DopeError as error:
        files.write_bytes(Path(os.environ[ERRORS]) / os.environ["RANK"], pickle.dumps(error))
        raise SystemExit(1) from None


class _Asked:
    """Counts `STOP_SIGNALS`, which the ranks get from the launcher alone.

    Attributes:
        count: how many came.
        insistent: whether Ctrl-C came twice.
    """

    def __init__(self) -> None:
        self.count, self._interrupts = 0, 0

    @property
    def insistent(self) -> bool:
        return self._interrupts > 1

    def __enter__(self) -> _Asked:
        self._before = {number: signal.signal(number, self._note) for number in heeded_signals()}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self._interrupts += number == signal.SIGINT


def _run(nproc: int, command: Sequence[str], environment: Mapping[str, str], asked: _Asked) -> tuple[str, list[int]]:
    """Start the ranks and wait for the end of all: how the first of them died, if one did, and all exit codes."""
    ranks = [
        subprocess.Popen(
            command,
            env={**environment, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            start_new_session=True,  # else Ctrl-C of a terminal would reach them twice
        )
        for rank in range(nproc)
    ]
    try:
        told, first_death, deadline = False, "", float("inf")
        while None in (codes := [process.poll() for process in ranks]):
            dead = [rank for rank, code in enumerate(codes) if code is not None and code not in WELL]
            if dead and not first_death:
                first_death, deadline = f"rank {dead[0]} {_ended(codes[dead[0]])}", time.monotonic() + GRACE_S
            if not told and (asked.count or dead):
                told = True
                for process in ranks:
                    process.terminate()
            if asked.insistent or time.monotonic() > deadline:
                break
            time.sleep(LOOK_EVERY_S)
    finally:
        for process in ranks:
            process.kill()  # nothing where it has ended
    ended = [process.wait() for process in ranks]
    dead = [rank for rank, code in enumerate(ended) if code not in WELL]
    return first_death or (f"rank {dead[0]} {_ended(ended[dead[0]])}" if dead else ""), ended


def _ended(code: int | None) -> str:
    if code is not None and code < 0:
        return f"was killed by {signal.Signals(-code).name}"
    return f"ended with {code}"


def _error_in(folder: Path) -> DopeError | None:
    """The first rank's error that there is, taken away for the next start."""
    errors = []
    for path in sorted(folder.iterdir(), key=lambda path: int(path.name)):
        errors.append(pickle.loads(path.read_bytes()))
        path.unlink()
    return errors[0] if errors else None
