import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from dope import run_logging
from dope.run_logging import Meter, RunLog, read_metrics

VALIDATION = {"pck": 0.25, "points": 40, "mask_iou": 0.5, "pairs": 2}


def test_metrics_are_json_lines_that_any_program_reads(tmp_path: Path) -> None:
    with RunLog(tmp_path, start=0, total=4) as log:
        log.event("step", 1, 0, {"loss": 2.0, "mask": float("nan")})
        log.event("validation", 1, 0, VALIDATION)
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    no_constants = [json.loads(line, parse_constant=lambda name: pytest.fail(name)) for line in lines]
    assert no_constants[0] == {"event": "step", "step": 1, "epoch": 0, "loss": 2.0, "mask": None}
    assert read_metrics(tmp_path, "validation") == [{"event": "validation", "step": 1, "epoch": 0, **VALIDATION}]


def test_tensorboard_gets_the_scalars(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    with RunLog(tmp_path, start=0, total=4) as log:
        log.event("step", 3, 0, {"loss": 2.5})
        log.event("validation", 4, 1, VALIDATION)
    board = EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    assert [(s.step, s.value) for s in board.Scalars("step/loss")] == [(3, 2.5)]
    assert [(s.step, s.value) for s in board.Scalars("validation/pck")] == [(4, 0.25)]


def test_a_run_that_begins_anew_forgets_what_a_killed_one_said(tmp_path: Path) -> None:
    for _ in range(2):
        with RunLog(tmp_path, start=0, total=4) as log:
            log.event("validation", 0, 0, VALIDATION)
    assert len(read_metrics(tmp_path)) == 1


def test_progress_without_a_terminal_is_plain_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RunLog(tmp_path, start=0, total=3) as log:
        for step in (1, 2, 3):
            log.progress(step, 1.5, 7.0)
        log.event("validation", 3, 1, VALIDATION)
    lines = capsys.readouterr().err.splitlines()
    # the first, then not before five seconds have passed, and the last
    assert [line.split()[1] for line in lines] == ["1/3", "3/3", "3"]
    assert "loss 1.5000  7.0 pairs/s" in lines[0] and "PCK 0.250" in lines[-1]


def test_progress_in_a_terminal_is_one_live_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(run_logging, "Console", lambda stderr: Console(file=out, force_terminal=True, width=120))
    with RunLog(tmp_path, start=1, total=3) as log:
        log.event("validation", 1, 0, VALIDATION)
        log.progress(2, 1.5, 7.0)
        log.progress(3, 1.25, 7.0)
    text = out.getvalue()
    assert "3/3" in text and "loss 1.2500" in text and "PCK 0.250" in text and "\x1b[" in text


def test_speed_leaves_the_first_step_out(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([0.0, 10.0, 11.0, 12.0, 20.0])
    monkeypatch.setattr(run_logging.time, "perf_counter", lambda: next(times))
    meter = Meter(first_step=0)
    assert meter.pairs_per_second == 0.0
    for _ in range(3):
        meter.add(8, 1.0)
    assert meter.pairs_per_second == 8.0
    assert meter.seconds == 20.0
