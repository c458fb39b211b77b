"""Blender in a process of its own: started, asked, watched, ended."""

from __future__ import annotations

import importlib.util
import json
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from dope.common.errors import DopeError
from pipeline.children import ChildFailed, Limits

WORKER = Path(__file__).parent / "blender/worker.py"
VARIABLE = "DOPE_BPY_PYTHON"
START_SECONDS = 120.0
"""For Python to start and to import bpy: a second on a quiet machine with a warm disk."""
_LONGEST_ANSWER = 1 << 20


def find_python(setting: str | None) -> str:
    """The interpreter that has bpy: the setting, else $DOPE_BPY_PYTHON, else this one.

    Raises:
        DopeError: it does not exist, or none is named and this one has no bpy.
    """
    named, origin = (setting, "cycles.python") if setting else (os.environ.get(VARIABLE), f"${VARIABLE}")
    if named:
        if not os.access(named, os.X_OK) or Path(named).is_dir():
            raise DopeError(f"{origin} is not an interpreter that can be run", where=named, remedy=how_to_install())
        return named
    if importlib.util.find_spec("bpy") is None:
        raise DopeError("the photoreal renderer needs Blender's Python package bpy", remedy=how_to_install())
    return sys.executable


def how_to_install() -> str:
    return (
        "Blender wants an environment of its own (Python 3.11): `python3.11 -m venv bpyenv && "
        "bpyenv/bin/pip install 'bpy==4.5.*' 'numpy<2'`, then say where it is: `--set "
        f"cycles.python=bpyenv/bin/python`, or in the variable {VARIABLE}. Or render with `--renderer fast`"
    )


class BlenderProcess:
    """A process that answers each line of JSON with a line of JSON (blender/worker.py).

    Args:
        python: interpreter with bpy.
        folder: private, for what Blender prints and leaves behind.
        limits: its memory.
        script: what it runs; None: blender/worker.py.

    Raises:
        DopeError: it did not start, or has no bpy.
    """

    def __init__(self, python: str, folder: Path, limits: Limits, script: Path | None = None) -> None:
        self._limits, self._unread, self._asked = limits, b"", 0
        self._log = folder / "blender.log"
        command = [python, "-u", str(script or WORKER), str(os.getpid()), str(int(limits.memory_gib * 2**30))]
        try:
            with self._log.open("ab") as log:  # appending, so that it can be emptied between objects
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    bufsize=0,
                    env=_environment(python, folder, limits),
                )
        except OSError as error:
            raise DopeError(f"cannot be run: {error.strerror}", where=python, remedy=how_to_install()) from None
        try:
            said = self.ask(None, time.monotonic() + START_SECONDS)
        except ChildFailed as error:
            raise DopeError(f"Blender did not start: {error.what}", where=python, remedy=how_to_install()) from None
        if "error" in said:
            self.close()
            raise DopeError(f"Blender did not start: {said['error']}", where=python, remedy=how_to_install())
        self.blender = str(said.get("blender", "unknown"))
        """Blender's version."""

    @property
    def is_alive(self) -> bool:
        return self._process.poll() is None

    def forget(self) -> None:
        """Empty the log: what is printed from now on belongs to the next object."""
        os.truncate(self._log, 0)

    def ask(self, message: dict[str, Any] | None, deadline: float) -> dict[str, Any]:
        """Send a message (None: only wait) and return the answer.

        Args:
            deadline: by `time.monotonic()`.

        Raises:
            ChildFailed: it crashed, ran out of time, or said what is no answer; it has been ended.
        """
        try:
            if message is not None:
                self._asked += 1
                self._send(json.dumps(message | {"number": self._asked}).encode() + b"\n", deadline)
            answer = json.loads(self._read_line(deadline))
            if not isinstance(answer, dict) or ("ok" in answer) == ("error" in answer):
                raise ValueError
            if answer.get("number") != self._asked:
                raise ValueError  # to something that was asked before
            return answer
        except TimeoutError:
            self.close()
            raise ChildFailed(
                f"Blender took longer than the object's {self._limits.minutes:g} minutes and was stopped{self._said()}",
                remedy="Raise --minutes and add --retry-failed, or ask for fewer samples (cycles.samples)",
            ) from None
        except (EOFError, BrokenPipeError, ConnectionResetError):
            raise ChildFailed(self._cause_of_death()) from None
        except ValueError:  # no JSON, or another
            self.close()
            raise ChildFailed(f"Blender gave an answer that makes no sense{self._said()}") from None
        except BaseException:  # Ctrl-C: what is under way would be taken for the answer to the next message
            self.close()
            raise

    def close(self) -> None:
        """End it, whatever it does."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()

    def _send(self, data: bytes, deadline: float) -> None:
        assert self._process.stdin is not None
        pipe = self._process.stdin.fileno()
        os.set_blocking(pipe, False)  # else a child that does not read holds us for ever
        while data:
            if not select.select([], [pipe], [], max(0.0, deadline - time.monotonic()))[1]:
                raise TimeoutError
            data = data[os.write(pipe, data) :]

    def _read_line(self, deadline: float) -> bytes:
        assert self._process.stdout is not None
        pipe = self._process.stdout.fileno()
        while b"\n" not in self._unread:
            if len(self._unread) > _LONGEST_ANSWER:
                raise ValueError
            if not select.select([pipe], [], [], max(0.0, deadline - time.monotonic()))[0]:
                raise TimeoutError
            data = os.read(pipe, 1 << 16)
            if not data:
                raise EOFError
            self._unread += data
        line, self._unread = self._unread.split(b"\n", 1)
        if self._unread:
            raise ValueError  # more than one answer
        return line

    def _cause_of_death(self) -> str:
        try:
            code: int | None = self._process.wait(2)
        except subprocess.TimeoutExpired:  # it has closed its stdout, and lives
            code = None
        self.close()
        if code is None:
            return f"Blender stopped answering{self._said()}"
        if code >= 0:
            return f"Blender ended with exit code {code}{self._said()}"
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = f"signal {-code}"
        lack = f" (its limit of memory is {self._limits.memory_gib:g} GiB)" if name in ("SIGKILL", "SIGABRT") else ""
        return f"Blender was ended by {name}{lack}{self._said()}"

    def _said(self) -> str:
        with self._log.open("rb") as log:
            log.seek(max(0, self._log.stat().st_size - 4096))
            tail = " | ".join(log.read().decode(errors="replace").strip().splitlines()[-3:])
        return f"; it last said: {tail[-400:]}" if tail else ""


def _environment(python: str, folder: Path, limits: Limits) -> dict[str, str]:
    """The environment without what belongs to this interpreter, and with no settings of the user's own Blender."""
    environment = dict(os.environ)
    if python != sys.executable:
        for name in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"):
            environment.pop(name, None)
    environment.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(limits.threads)))
    environment.update(BLENDER_USER_RESOURCES=str(folder), TMPDIR=str(folder), PYTHONDONTWRITEBYTECODE="1")
    return environment
