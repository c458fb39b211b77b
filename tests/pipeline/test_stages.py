"""Stages: done once, done again when something changed, and a failure is a row."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from dope.common.errors import BadInput, DiskFull
from pipeline import stages
from pipeline.sequence import Sequence
from pipeline.stages import read_marker, run_stage


@dataclass(frozen=True)
class Config:
    size: int = 1


class Work:
    def __init__(self, result=None) -> None:
        self.calls, self.result = 0, result

    def __call__(self):
        self.calls += 1
        if isinstance(self.result, Exception):
            raise self.result
        return dict(self.result or {})


@pytest.fixture
def sequence(tmp_path) -> Sequence:
    return Sequence(tmp_path / "mug")


def test_done_work_is_skipped_until_settings_or_inputs_change(sequence: Sequence) -> None:
    work = Work({"n": 1})
    assert not run_stage(sequence, "sfm", Config(), "a", work).skipped
    again = run_stage(sequence, "sfm", Config(), "a", work)
    assert again.skipped and again.details == {"n": 1} and work.calls == 1
    run_stage(sequence, "sfm", Config(2), "a", work)
    run_stage(sequence, "sfm", Config(2), "b", work)
    run_stage(sequence, "sfm", Config(2), "b", work, overwrite=True)
    assert work.calls == 4


def test_running_a_stage_again_invalidates_what_was_made_from_it(sequence: Sequence) -> None:
    for stage in ("frames", "sfm", "depth", "masks", "correspond"):
        run_stage(sequence, stage, Config(), "a", Work())
    run_stage(sequence, "depth", Config(2), "a", Work())
    left = {s for s in stages.LATER_STAGES if read_marker(sequence, s)}
    assert left == {"frames", "sfm", "depth", "masks"}


def test_failures_are_rows_with_reasons_and_are_kept(sequence: Sequence) -> None:
    row = run_stage(sequence, "sfm", Config(), "a", Work(BadInput("nothing registers", where="x")))
    assert (row.status, row.reason, row.trace) == ("failed", "x: nothing registers", None)
    bug = Work(ZeroDivisionError("oops"))
    row = run_stage(sequence, "sfm", Config(), "b", bug)
    assert row.reason == "ZeroDivisionError: oops" and "__call__" in (row.trace or "")
    assert run_stage(sequence, "sfm", Config(), "b", bug).skipped
    run_stage(sequence, "sfm", Config(), "b", bug, retry_failed=True)
    assert bug.calls == 2


def test_empty_is_neither_ok_nor_failed(sequence: Sequence) -> None:
    row = run_stage(sequence, "correspond", Config(), "a", Work({"empty": "no pair"}))
    assert (row.status, row.reason, row.ok) == ("empty", "no pair", False)
    assert run_stage(sequence, "masks", Config(), "a", Work({"empty": 0})).ok  # a count


def test_a_full_disk_is_not_a_failure_of_the_item(sequence: Sequence) -> None:
    with pytest.raises(DiskFull):
        run_stage(sequence, "sfm", Config(), "a", Work(DiskFull("full")))
    assert read_marker(sequence, "sfm") is None


def test_a_failure_on_a_full_disk_is_the_disks(sequence: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages.shutil, "disk_usage", lambda _: SimpleNamespace(free=4096))
    with pytest.raises(DiskFull, match="database or disk is full"):
        run_stage(sequence, "sfm", Config(), "a", Work(RuntimeError("database or disk is full")))
    assert read_marker(sequence, "sfm") is None  # it is run again as soon as there is room


def test_an_interrupted_stage_leaves_no_marker(sequence: Sequence) -> None:
    run_stage(sequence, "sfm", Config(), "a", Work())
    with pytest.raises(KeyboardInterrupt):
        _interrupt(sequence)
    assert read_marker(sequence, "sfm") is None


def _interrupt(sequence: Sequence) -> None:
    def work():
        raise KeyboardInterrupt

    run_stage(sequence, "sfm", Config(2), "a", work)


@pytest.mark.parametrize(
    "text", ['{"sequence": ', "[]", "{}", '{"sequence": "mug", "stage": "sfm", "status": "ok", "details": []}']
)
def test_a_damaged_marker_counts_as_none(sequence: Sequence, text: str) -> None:
    work = Work()
    run_stage(sequence, "sfm", Config(), "a", work)
    stages.marker_path(sequence, "sfm").write_text(text)
    assert read_marker(sequence, "sfm") is None
    run_stage(sequence, "sfm", Config(), "a", work)
    assert work.calls == 2


def test_require_names_the_command_to_run(sequence: Sequence) -> None:
    with pytest.raises(BadInput, match="dope prep masks"):
        stages.require(sequence, "masks", "dope prep masks")
