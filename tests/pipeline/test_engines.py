"""Shares of an array job, and many items at once."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from dope.common.errors import BadInput, DiskFull, UsageError
from pipeline.engines import Share, find_share, holding, run_items


def test_shares_are_a_partition() -> None:
    items = list(range(10))
    shares = [Share(i, 3).of(items) for i in range(3)]
    assert sorted(item for share in shares for item in share) == items
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, Share(0, 1)),
        ({"SLURM_ARRAY_TASK_ID": "7", "SLURM_ARRAY_TASK_COUNT": "4", "SLURM_ARRAY_TASK_MIN": "1",
          "SLURM_ARRAY_TASK_STEP": "2"}, Share(3, 4)),
        ({"AWS_BATCH_JOB_ARRAY_INDEX": "2", "AWS_BATCH_JOB_ARRAY_SIZE": "5"}, Share(2, 5)),
        ({"JOB_COMPLETION_INDEX": "0", "JOB_COMPLETIONS": "2"}, Share(0, 2)),
    ],
)  # fmt: skip
def test_array_variables(environment: dict[str, str], expected: Share) -> None:
    assert find_share(None, None, environment) == expected


def test_flags_win_over_the_environment() -> None:
    assert find_share(1, 2, {"JOB_COMPLETION_INDEX": "0"}) == Share(1, 2)


@pytest.mark.parametrize(
    ("index", "count", "environment", "message"),
    [
        (2, 2, {}, "not in 0..1"),
        (0, None, {}, "go together"),
        (None, None, {"JOB_COMPLETION_INDEX": "0"}, "JOB_COMPLETIONS"),
        (None, None, {"SLURM_ARRAY_TASK_ID": "1", "SLURM_ARRAY_TASK_MIN": "x"}, "not a number"),
        (None, None, {"AWS_BATCH_JOB_ARRAY_INDEX": "x", "AWS_BATCH_JOB_ARRAY_SIZE": "2"}, "not a number"),
    ],
)
def test_wrong_shares_are_usage_errors(index, count, environment, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        find_share(index, count, environment)


def test_results_keep_the_order_of_the_items() -> None:
    barrier = threading.Barrier(2, timeout=10)  # both run at once, or this breaks

    def work(x: int) -> int:
        if x < 2:
            barrier.wait()
        return x * x

    assert run_items(range(5), work, workers=2) == [0, 1, 4, 9, 16]


def test_a_full_disk_stops_the_run() -> None:
    started = []

    def work(x: int) -> int:
        started.append(x)
        if x == 0:
            raise DiskFull("full")
        return x

    with pytest.raises(DiskFull):
        run_items(range(100), work, workers=2)
    assert len(started) < 100


def test_a_second_run_is_told_who_holds_the_folder(tmp_path) -> None:
    code = (
        "import sys; from pathlib import Path; from pipeline.engines import holding\n"
        "with holding(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout is not None and other.stdout.readline() == "held\n"
    with pytest.raises(BadInput, match=f"process {other.pid} on"), holding(tmp_path):
        pass
    other.communicate("")
    half = tmp_path / ".sfm.99.partial"
    half.mkdir()
    with holding(tmp_path):
        assert not half.exists()  # nobody else can be writing it


def test_a_folder_that_cannot_be_made_is_named(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(BadInput, match=r"file/mug: cannot be written to.*choose another WORK"),
        holding(tmp_path / "file/mug"),
    ):
        pass
