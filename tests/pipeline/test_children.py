"""A child process that crashes, hangs or eats memory costs its own item and says why."""

from __future__ import annotations

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from dope.common.errors import BadInput
from pipeline import children
from pipeline.children import ChildFailed, Children, ChildStopped, Limits, run_in_child
from pipeline.sequence import Sequence
from pipeline.stages import read_marker, run_stage


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


def eat_in_a_stage(folder: Path, notify) -> None:
    run_stage(Sequence(folder), "sfm", None, None, lambda: {"n": eat(notify)})


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


def test_lack_of_memory_within_a_stage_names_the_limit_and_leaves_no_marker(tmp_path: Path) -> None:
    with pytest.raises(ChildFailed, match=r"more than 1 GiB of memory\. Raise --memory-gib and add --retry-failed"):
        run_in_child(eat_in_a_stage, tmp_path, limits=Limits(memory_gib=1))
    assert read_marker(Sequence(tmp_path), "sfm") is None


def test_what_is_stopped_from_here_is_told_from_what_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(children, "_stop_sign", children.StopSign())
    with ThreadPoolExecutor() as pool:
        running = pool.submit(run_in_child, sleep, limits=Limits())
        time.sleep(0.2)
        children.stop_children()
        with pytest.raises(ChildStopped, match="Run the same command again"):
            running.result(timeout=20)


def test_children_that_start_at_once_see_their_own_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)

    def seen(threads: int) -> set[str | None]:
        found = set()
        for _ in range(40):
            with children._thread_counts_in_environment(threads):
                time.sleep(1e-4)
                found.add(os.environ.get("OMP_NUM_THREADS"))
        return found

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(seen, range(8))) == [{str(threads)} for threads in range(8)]
    assert "OMP_NUM_THREADS" not in os.environ


def test_errors_of_the_work_come_back_as_they_are() -> None:
    with pytest.raises(BadInput, match=r"a\.mp4: is not a video\. Convert it"):
        run_in_child(refuse, limits=Limits())
    with pytest.raises(RuntimeError, match="odd 1 2"):
        run_in_child(odd, limits=Limits())


def my_number(notify) -> int:
    return os.getpid()


def test_children_are_used_again_and_replaced_when_they_fail_or_have_done_their_share() -> None:
    with Children(Limits(), reuse=3) as pool:
        first = [pool.call(my_number) for _ in range(3)]
        assert len(set(first)) == 1 and pool.call(my_number) != first[0]
        second = pool.call(my_number)
        with pytest.raises(BadInput, match="is not a video"):
            pool.call(refuse)  # an answer like any other: the process is well
        third = pool.call(my_number)
        assert third != second  # it was its third piece of work
        with pytest.raises(ChildFailed, match=r"SIGABRT.*out of luck"):
            pool.call(crash)
        assert pool.call(my_number) not in (first[0], second, third)


def test_what_an_earlier_item_said_is_not_told_of_a_later_one() -> None:
    with Children(Limits(), reuse=9) as pool:
        pool.call(say)
        with pytest.raises(ChildFailed) as failed:
            pool.call(leave)
    assert "hello" not in str(failed.value)


def say(notify) -> None:
    os.write(1, b"hello\n")
