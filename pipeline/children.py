"""Run native work in a child process with limits on time and memory, so that a crash costs one sequence only.

COLMAP's C++ code can abort, OpenCV's decoders can crash on damaged files, and either can eat all memory: the parent
survives, and says what happened with the last lines that the child printed.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import resource
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from dope.common.errors import BadInput, DopeError

Notify = Callable[[str], None]
"""Called by the work with a few words on what it does now."""
SMALLER = "use fewer or smaller pictures (videos: --count, --long-side; renders: --size)"


@dataclass(frozen=True)
class Limits:
    """What one sequence may use."""

    minutes: float = 60.0
    """Wall-clock limit of one sequence."""
    memory_gib: float = 8.0
    """Limit of the child's private memory."""
    threads: int = 1
    """Native threads of one sequence. 1 makes reconstructions repeat to the bit; parallelism is over sequences."""


class ChildFailed(BadInput):
    """The child died or ran out of its limits."""


class ChildStopped(ChildFailed):
    """The child was ended from here (Ctrl-C) before it was done; that says nothing of its item."""


class StopSign:
    """A flag that wakes everybody who waits for it: once shown, `wait([..., sign.fileno()])` returns at once."""

    def __init__(self) -> None:
        self._seen, self._shown = os.pipe()
        self.is_shown = False

    def fileno(self) -> int:
        return self._seen

    def show(self) -> None:
        if not self.is_shown:
            self.is_shown = True
            os.write(self._shown, b"!")


_stop_sign = StopSign()
_environment = threading.Lock()


def stop_children() -> None:
    """End all running children: their callers get `ChildStopped`. For Ctrl-C; there is no way back."""
    _stop_sign.show()


def run_in_child(work: Callable[..., Any], *args: Any, limits: Limits, notify: Notify | None = None) -> Any:
    """Call `work(*args, notify)` in a fresh process and return its result; see `Child.call`."""
    child = Child(limits)
    try:
        return child.call(work, *args, notify=notify)
    finally:
        child.close()


class Child:
    """A process that does one piece of work after the other, for work that is short beside the start of a process.

    Args:
        limits: wall-clock minutes of each piece; memory and threads of the process.
    """

    def __init__(self, limits: Limits) -> None:
        context = multiprocessing.get_context("spawn")
        self._limits = limits
        self._log = tempfile.NamedTemporaryFile(prefix="dope-child-", suffix=".log")  # noqa: SIM115
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_child_main, args=(other, self._log.name, limits), daemon=False)
        self.calls = 0
        """How many pieces of work it was given."""
        with _thread_counts_in_environment(limits.threads):
            self._process.start()
        other.close()

    def call(self, work: Callable[..., Any], *args: Any, notify: Notify | None = None) -> Any:
        """Call `work(*args, notify)` there and return its result.

        Args:
            work: a function importable by name; its last argument is `notify(text)`.
            notify: called in this process with what the child reports.

        Raises:
            ChildFailed: the child was killed, crashed, ran out of time or memory; the message says which. It is of no
                more use.
            ChildStopped: `stop_children` was called. The same.
            Exception: whatever `work` raised.
        """
        self.calls += 1
        self._log.truncate(0)
        deadline = time.monotonic() + self._limits.minutes * 60
        with suppress(OSError):  # it has died since: what it said last is told below
            self._pipe.send((work, args))
        while True:
            ready = wait([self._pipe, _stop_sign.fileno()], timeout=max(0.0, deadline - time.monotonic()))
            if _stop_sign.is_shown:
                raise ChildStopped("was stopped before it was done", remedy="Run the same command again to go on")
            if self._pipe not in ready:
                raise ChildFailed(
                    f"took longer than {self._limits.minutes:g} minutes and was stopped",
                    remedy=f"Raise --minutes and add --retry-failed, or {SMALLER}",
                )
            try:
                kind, value = self._pipe.recv()
            except (EOFError, OSError):  # OSError: it was killed in the midst of a message
                self._process.join()
                raise ChildFailed(_cause_of_death(self._process.exitcode, self._limits, Path(self._log.name))) from None
            if kind == "note":
                if notify:
                    notify(value)
            elif kind == "error":
                raise value
            else:
                return value

    def close(self) -> None:
        """End the process, whatever it does."""
        if self._process.is_alive():
            self._process.kill()
        self._process.join()
        self._pipe.close()
        self._log.close()


class Children:
    """As many child processes as there are callers at a time, each ended after `reuse` pieces of work or a failure."""

    def __init__(self, limits: Limits, *, reuse: int) -> None:
        self._limits, self._reuse = limits, reuse
        self._idle: SimpleQueue[Child] = SimpleQueue()

    def __enter__(self) -> Children:
        return self

    def __exit__(self, *_: object) -> None:
        while not self._idle.empty():
            self._idle.get().close()

    def call(self, work: Callable[..., Any], *args: Any, notify: Notify | None = None) -> Any:
        """`Child.call` in one of them."""
        try:
            child = self._idle.get_nowait()
        except Empty:
            child = Child(self._limits)
        usable = True
        try:
            return child.call(work, *args, notify=notify)
        except (ChildFailed, KeyboardInterrupt):
            usable = False
            raise
        finally:
            if usable and child.calls < self._reuse:
                self._idle.put(child)
            else:
                child.close()


def _cause_of_death(exitcode: int | None, limits: Limits, log: Path) -> str:
    tail = " | ".join(log.read_text(errors="replace").strip().splitlines()[-3:])
    said = f"; it last said: {tail[-400:]}" if tail else ""
    if exitcode is not None and exitcode < 0:
        name = signal.Signals(-exitcode).name
        if name == "SIGKILL":
            said += f" (often a lack of memory; its own limit is {limits.memory_gib:g} GiB, --memory-gib)"
            said += ". Use fewer --workers or smaller pictures, and add --retry-failed"
        return f"the process was ended by {name}{said}"
    return f"the process ended with exit code {exitcode}{said}"


@contextmanager
def _thread_counts_in_environment(threads: int) -> Iterator[None]:
    """Set the thread counts that native libraries read at import, for the child's start only.

    One child at a time: the environment is the whole process's, and children start from several threads.
    """
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    with _environment:
        before = {name: os.environ.get(name) for name in names}
        os.environ.update(dict.fromkeys(names, str(threads)))
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _child_main(pipe: Connection, log: str, limits: Limits) -> None:
    file = os.open(log, os.O_WRONLY | os.O_APPEND)
    for stream in (1, 2):  # native code writes here; the parent's terminal belongs to the progress display
        os.dup2(file, stream)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    _die_with_parent()
    limit = int(limits.memory_gib * 2**30)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    while True:
        try:
            work, args = pipe.recv()
        except EOFError:
            break
        except BaseException as error:  # its modules cannot be loaded
            pipe.send(("error", _portable(error, limits)))
            continue
        try:
            import cv2

            cv2.setNumThreads(limits.threads)
            result: tuple[str, Any] = ("result", work(*args, lambda text: pipe.send(("note", text))))
        except BaseException as error:
            result = ("error", _portable(error, limits))
        sys.stdout.flush()
        pipe.send(result)
    os._exit(0)  # native libraries' exit handlers have crashed after good work


def _die_with_parent() -> None:
    """Linux: be killed when the parent is, so that no orphan goes on writing."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
        parent = multiprocessing.parent_process()
        if parent is not None and os.getppid() != parent.pid:
            os._exit(1)  # it was killed before this was asked for


def _out_of_memory(limits: Limits) -> ChildFailed:
    return ChildFailed(
        f"needed more than {limits.memory_gib:g} GiB of memory",
        remedy=f"Raise --memory-gib and add --retry-failed, or {SMALLER}",
    )


def is_lack_of_memory(error: BaseException) -> bool:
    """Whether an error of Python, C++ or OpenCV says that memory ran out."""
    if isinstance(error, DopeError):  # says what it has to say
        return False
    names = ("bad_alloc", "OutOfMemory", "Insufficient memory")
    return isinstance(error, MemoryError) or any(name in str(error) for name in names)


def _portable(error: BaseException, limits: Limits) -> BaseException:
    """The error itself if it can be sent, else its text; lack of memory by any name becomes one message."""
    if is_lack_of_memory(error):
        return _out_of_memory(limits)
    try:
        pickle.loads(pickle.dumps(error))
        return error
    except Exception:  # an exception class with its own constructor: its text must do
        return RuntimeError("".join(traceback.format_exception_only(error)).strip())
