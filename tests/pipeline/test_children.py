"""A child process that crashes, hangs or eats memory costs its own item and says why."""

from __future__ import annotations

import os
import signal
import time

import pytest

from dope.common.errors import BadInput
from pipeline.children import ChildFailed, Limits, run_in_child


def double(x: int, notify) -> int:
    notify("working")
    return 2 * x


def crash(notify) -> None:
    os.write(2, b"the native library says: out of luck\n")
    os.kill(os.getpid(), signal.SIGABRT)


def leave(notify) -> None:
    os._exit(3)


def sleep(notify) -> None:
    time.sleep(60)


def eat(notify) -> int:
    return len(bytearray(2 << 30))


def refuse(notify) -> None:
    raise BadInput("is not a video", where="a.mp4", remedy="Convert it")


class Odd(Exception):
    def __init__(self, a: int, b: int) -> None:
        super().__init__(f"odd {a} {b}")


def odd(notify) -> None:
    raise Odd(1, 2)


def test_results_and_notes_come_back() -> None:
    notes: list[str] = []
    assert run_in_child(double, 21, limits=Limits(), notify=notes.append) == 42
    assert notes == ["working"]


@pytest.mark.parametrize(
    ("work", "limits", "message"),
    [
        (crash, Limits(), "SIGABRT.*out of luck"),
        (leave, Limits(), "exit code 3"),
        (sleep, Limits(minutes=0.02), "longer than 0.02 minutes"),
        (eat, Limits(memory_gib=1), "more than 1 GiB"),
    ],
)
def test_a_dead_child_is_an_error_with_its_cause(work, limits: Limits, message: str) -> None:
    with pytest.raises(ChildFailed, match=message):
        run_in_child(work, limits=limits)


def test_errors_of_the_work_come_back_as_they_are() -> None:
    with pytest.raises(BadInput, match=r"a\.mp4: is not a video\. Convert it"):
        run_in_child(refuse, limits=Limits())
    with pytest.raises(RuntimeError, match="odd 1 2"):
        run_in_child(odd, limits=Limits())
