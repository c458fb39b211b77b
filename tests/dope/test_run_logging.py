import io
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console

from dope import run_logging
from dope.common.errors import UsageError
from dope.run_logging import RunLog, describe_start, read_metrics
from dope.wandb_run import require_wandb

VALIDATION = {"pck": 0.25, "points": 40, "mask_iou": 0.5, "pairs": 2}


def metered(loss: float) -> Any:
    return SimpleNamespace(loss=loss, pairs_per_second=7.0, data_wait=0.034)


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


def test_tensorboard_gets_pictures(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    sheet = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    with RunLog(tmp_path, start=0, total=4) as log:
        log.picture("validation/pairs", 4, sheet)
    board = EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    (shown,) = board.Images("validation/pairs")
    decoded = cv2.imdecode(np.frombuffer(shown.encoded_image_string, np.uint8), cv2.IMREAD_COLOR)
    assert shown.step == 4 and (shown.width, shown.height) == (3, 2)
    np.testing.assert_array_equal(decoded[..., ::-1], sheet)


class FakeWandb:
    """What the run uses of the package; `fail` names a call that raises."""

    def __init__(self, fail: str = "") -> None:
        self.fail, self.begun, self.logged, self.ended = fail, [], [], []  # type: ignore[var-annotated]
        self.Image = lambda image: ("image", image.shape)

    def _called(self, name: str) -> None:
        if name == self.fail:
            raise ConnectionError("no way out")

    def init(self, **options: Any) -> "FakeWandb":
        self._called("init")
        self.begun.append(options)
        return self

    def define_metric(self, name: str, step_metric: str) -> None:
        assert (name, step_metric) == ("*", "step")

    def log(self, values: dict[str, Any]) -> None:
        self._called("log")
        self.logged.append(values)

    def finish(self, exit_code: int) -> None:
        self._called("finish")
        self.ended.append(exit_code)


def run_with_wandb(folder: Path, **options: Any) -> None:
    with RunLog(folder, start=0, total=4, wandb="mugs", config={"seed": 1}) as log:
        log.event("step", 1, 0, {"loss": 2.0, "file": "x"})
        log.event("checkpoint", 1, 0, {"file": "x"})
        log.event("validation", 2, 0, VALIDATION)
        log.picture("validation/pairs", 2, np.zeros((4, 5, 3), np.uint8))
        if options.get("crash"):
            raise RuntimeError


def test_wandb_gets_numbers_and_pictures_and_one_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    run_with_wandb(tmp_path)
    assert wandb.logged == [
        {"step/loss": 2.0, "step": 1},
        {**{f"validation/{name}": value for name, value in VALIDATION.items()}, "step": 2},
        {"validation/pairs": ("image", (4, 5, 3)), "step": 2},
    ]
    with pytest.raises(RuntimeError):
        run_with_wandb(tmp_path, crash=True)
    run_with_wandb(tmp_path / "..")
    assert wandb.ended == [0, 1, 0]
    first, again, other = wandb.begun
    assert (first["project"], first["name"], first["config"]) == ("mugs", tmp_path.name, {"seed": 1})
    monkeypatch.chdir(tmp_path)
    run_with_wandb(Path())
    assert wandb.begun[-1]["name"] == tmp_path.name
    assert first["resume"] == "allow" and first["id"] == again["id"] != other["id"]


@pytest.mark.parametrize("fail", ["init", "log", "finish"])
def test_wandb_that_fails_is_said_once_and_stops_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], fail: str
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", FakeWandb(fail))
    run_with_wandb(tmp_path)
    assert capsys.readouterr().err.count("WARNING: Weights & Biases failed (no way out); the training goes on") == 1
    assert len(read_metrics(tmp_path)) == 3


def test_without_the_package_its_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(UsageError, match=r"log\.wandb: .*pip install 'dope-descriptors\[wandb\]'"):
        require_wandb()


def test_a_run_that_begins_anew_forgets_what_a_killed_one_said(tmp_path: Path) -> None:
    for _ in range(2):
        with RunLog(tmp_path, start=0, total=4) as log:
            log.event("validation", 0, 0, VALIDATION)
    assert len(read_metrics(tmp_path)) == 1


def test_lines_that_a_crash_spoilt_are_left_out(tmp_path: Path) -> None:
    whole = b'{"event": "step", "step": 1}\n'
    (tmp_path / "metrics.jsonl").write_bytes(b"\0\0\0\n\xff\xfe\n12\nnull\n" + whole + b'{"event": "st')
    with RunLog(tmp_path, start=1, total=4):
        assert read_metrics(tmp_path) == [{"event": "step", "step": 1}]
    assert (tmp_path / "metrics.jsonl").read_bytes() == whole


def test_progress_without_a_terminal_is_plain_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RunLog(tmp_path, start=0, total=3) as log:
        for step in (1, 2, 3):
            log.progress(step, metered(1.5))
        log.event("validation", 3, 1, VALIDATION)
    lines = capsys.readouterr().err.splitlines()
    # the first, then not before five seconds have passed, and the last
    assert [line.split()[1] for line in lines] == ["1/3", "3/3", "3"]
    assert "1/3  7.0 pairs/s  data wait 3%  loss 1.5000" in lines[0] and lines[0].endswith("0:00:00 left")
    assert "PCK 0.250" in lines[-1]


def test_progress_in_a_terminal_is_one_live_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(run_logging, "Console", lambda stderr: Console(file=out, force_terminal=True, width=120))
    with RunLog(tmp_path, start=1, total=3) as log:
        log.event("validation", 1, 0, VALIDATION)
        log.progress(2, metered(1.5))
        log._began -= 40 * (3 - 1)  # slow steps
        log.progress(2, metered(1.5))
        assert log._progress is not None
        log._progress.refresh()
        log.say("WARNING: /data/[old]/run[/b] " + "x" * 120)
        log.progress(3, metered(1.25))
    text = out.getvalue()
    assert "0:01:20 left" in text  # one step done, one to go
    assert "WARNING: /data/[old]/run[/b] " + "x" * 120 in text  # neither markup nor broken lines
    assert "3/3" in text and "loss 1.2500" in text and "PCK 0.250" in text and "data wait 3%" in text
    assert "\x1b[" in text


def test_a_run_that_never_leaves_its_warm_up_is_told() -> None:
    facts = dict.fromkeys(("pairs", "objects", "batch_size", "steps_per_epoch", "left_out", "resumed_at"), 1)
    facts |= {
        "parameters": 1,
        "method": "dope",
        "samples": "pairs",
        "batch_of": "pairs",
        "precision": "fp32",
        "device": "cpu",
        "world": 1,
        "resumed_from": None,
        "left_out": 0,
    }
    assert "warm-up" in describe_start(facts | {"total_steps": 1000, "warmup_steps": 1000})
    assert "warm-up" not in describe_start(facts | {"total_steps": 1001, "warmup_steps": 1000})
