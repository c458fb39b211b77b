"""Run one stage over many items: this machine's processes, and a container's share of an array job.

Every engine has one signature: items in, one result each out, in the order of the items.
"""

from __future__ import annotations

import fcntl
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import IO, TypeVar

from dope.common import files
from dope.common.errors import BadInput, UsageError
from pipeline.children import stop_children

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Share:
    """Part `index` of `count` equal parts of a list of items: N containers share one WORK."""

    index: int = 0
    count: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.index < self.count:
            raise UsageError(
                f"shard index {self.index} is not in 0..{self.count - 1}", remedy="Check --shard-index and --num-shards"
            )

    def of(self, items: Sequence[Item]) -> list[Item]:
        """Every `count`-th item from `index` on; over all indices each item once."""
        return list(items[self.index :: self.count])


def find_share(index: int | None, count: int | None, environment: Mapping[str, str] | None = None) -> Share:
    """The share from the flags, else from the array variables of Slurm, AWS Batch or Kubernetes, else everything.

    Slurm gives SLURM_ARRAY_TASK_ID, _MIN, _STEP and _COUNT; AWS Batch AWS_BATCH_JOB_ARRAY_INDEX and _SIZE; Kubernetes
    indexed jobs JOB_COMPLETION_INDEX, and JOB_COMPLETIONS where the manifest passes it on.

    Raises:
        UsageError: an index without a count, or one that is not a number or out of range.
    """
    env = os.environ if environment is None else environment
    if index is not None or count is not None:
        if index is None or count is None:
            raise UsageError("--shard-index and --num-shards go together")
        return Share(index, count)
    if "SLURM_ARRAY_TASK_ID" in env:
        start, step = _number(env, "SLURM_ARRAY_TASK_MIN", "0"), _number(env, "SLURM_ARRAY_TASK_STEP", "1")
        index = (_number(env, "SLURM_ARRAY_TASK_ID") - start) // max(step, 1)
        return Share(index, _count(env, "SLURM_ARRAY_TASK_COUNT"))
    if "AWS_BATCH_JOB_ARRAY_INDEX" in env:
        return Share(_number(env, "AWS_BATCH_JOB_ARRAY_INDEX"), _count(env, "AWS_BATCH_JOB_ARRAY_SIZE"))
    if "JOB_COMPLETION_INDEX" in env:
        return Share(_number(env, "JOB_COMPLETION_INDEX"), _count(env, "JOB_COMPLETIONS"))
    return Share()


def _number(env: Mapping[str, str], name: str, otherwise: str = "") -> int:
    text = env.get(name, otherwise)
    try:
        return int(text)
    except ValueError:
        raise UsageError(f"'{text}' is not a number", where=name) from None


def _count(env: Mapping[str, str], name: str) -> int:
    if name not in env:
        raise UsageError(
            f"this is one task of an array, but {name} does not say of how many",
            remedy="Pass --shard-index and --num-shards",
        )
    return _number(env, name)


def run_items(items: Sequence[Item], work: Callable[[Item], Result], *, workers: int) -> list[Result]:
    """Call `work` on every item, `workers` at a time, each in a thread that waits for a child process.

    `work` turns failures of an item into its result; what it raises (a full disk, Ctrl-C) stops the whole run: no new
    item is started, and the error is raised when the running ones have ended.
    """
    if workers <= 1 or len(items) <= 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(max_workers=workers) as pool:
        futures = [pool.submit(work, item) for item in items]
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
        except KeyboardInterrupt:
            stop_children()
            raise
        finally:
            for future in futures:
                future.cancel()
    for future in futures:  # the cause first: cancelled futures would hide it
        if not future.cancelled() and (error := future.exception()):
            raise error
    return [future.result() for future in futures]


BATCH = 2000
"""Items that a process reads at a time: as dicts, rows take thirty times the memory of their places in columns."""
SPREAD_FROM = 4 * BATCH
"""From this many on several processes read, since parsing JSON keeps Python's lock; fewer are read sooner than they
start."""


def read_spread(read: Callable[[list[Item]], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result]]:
    """Call `read`, which is importable by name, on batches of many small items, on all CPUs where they are very many.

    Yields:
        How many items a batch held and what `read` made of it, in the order of the items.
    """
    batches = [list(items[i : i + BATCH]) for i in range(0, len(items), BATCH)]
    sizes, workers = map(len, batches), min(default_workers(), 8)
    if len(items) < SPREAD_FROM or workers < 2:
        yield from zip(sizes, map(read, batches), strict=True)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from zip(sizes, pool.map(read, batches), strict=True)


@contextmanager
def holding(folder: Path) -> Iterator[None]:
    """Hold a sequence's folder for this process; a second run is told who holds it. Clears what killed runs left.

    Raises:
        BadInput: another process works on the folder, or it cannot be written to.
        DiskFull: there is no room for it.
    """
    try:
        with files.explaining_full_disk(folder):
            folder.mkdir(parents=True, exist_ok=True)
            file = (folder / ".lock").open("a+")
    except OSError as error:
        remedy = "Check its permissions, or choose another WORK"
        raise BadInput(f"cannot be written to ({error.strerror})", where=folder, remedy=remedy) from error
    with file as lock:
        _take(lock, folder)
        for place in (folder, folder / "stages"):
            files.clear_leftovers(place)
        yield


def _take(lock: IO[str], what: Path, *, wait: bool = False) -> None:
    """Lock an open lock file and note who holds it. Raises `BadInput` naming the holder, unless told to wait."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        lock.seek(0)
        holder = lock.read().strip() or "another process"
        remedy = "Wait for it, or stop it, then run again"
        raise BadInput(f"is being worked on by {holder}", where=what, remedy=remedy) from None
    with suppress(OSError):  # who holds it is a courtesy; a full disk is the stage's to report
        os.ftruncate(lock.fileno(), 0)
        os.write(lock.fileno(), f"process {os.getpid()} on {os.uname().nodename}".encode())


@contextmanager
def holding_output(out: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold a folder that will be replaced as a whole, by a lock file beside it that is removed at the end.

    Clears what killed runs left of it.

    Raises:
        BadInput: another process writes it, and this one is not to wait.
    """
    path = out.with_name(f".{out.name}.lock")
    while True:
        with files.explaining_full_disk(out):
            out.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("a+")
        with file as lock:
            _take(lock, out, wait=wait)
            if not _is_at(lock, path):
                continue  # who held it before has just removed it
            try:
                files.clear_leftovers(out.parent, of=out.name)
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def _is_at(file: IO[str], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


@contextmanager
def interrupted_by_sigterm() -> Iterator[None]:
    """Make SIGTERM what Ctrl-C is: running children are ended and the command says how to go on."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def default_workers() -> int:
    """The CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
