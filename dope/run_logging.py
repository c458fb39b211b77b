"""What a run says: metrics.jsonl for programs, TensorBoard for eyes, one line of progress for whoever started it.

Weights & Biases gets what TensorBoard gets, where `log.wandb` names a project.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from dope.common import files
from dope.figures.drawing import Image, as_png
from dope.meter import Meter
from dope.wandb_run import WandbRun

METRICS = "metrics.jsonl"


class RunLog:
    """Writes RUN/metrics.jsonl and RUN/tensorboard and shows progress; use as a context manager, on the first rank.

    A line of metrics.jsonl has `event` (start, damaged_checkpoint, step, validation, checkpoint, not_finite, end),
    `step`, `epoch` and the values.

    Args:
        run: the folder.
        start: steps already done; lines of later steps, left by a run that was killed, are removed.
        total: steps of the whole run.
        wandb: project of Weights & Biases, or empty.
        config: the resolved settings, which W&B shows beside the run.
    """

    def __init__(
        self, run: Path, *, start: int, total: int, wandb: str = "", config: Mapping[str, Any] | None = None
    ) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._path = run / METRICS
        _forget_after(self._path, start if start else -1)
        self._file = self._path.open("a", encoding="utf-8")
        self._board = SummaryWriter(str(run / "tensorboard"), purge_step=start + 1 if start else 0)
        self._console = Console(stderr=True)
        self._progress: Progress | None = None
        if self._console.is_terminal:
            self._progress = Progress(
                BarColumn(24),
                TextColumn("{task.completed}/{task.total}"),
                TextColumn("{task.description}"),
                TimeElapsedColumn(),
                TextColumn("{task.fields[left]}"),
                console=self._console,
            )
            self._task = self._progress.add_task("", total=total, completed=start, left="")
        self._total, self._score, self._line_due = total, "", 0.0
        self._began, self._began_at = time.perf_counter(), start
        self._wandb = WandbRun(wandb, run, config or {}, self.say) if wandb else None

    def __enter__(self) -> RunLog:
        if self._progress:
            self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._progress:
            self._progress.stop()
        self._file.close()
        self._board.close()
        if self._wandb:
            self._wandb.close(failed=error is not None)

    def event(self, event: str, step: int, epoch: int, values: Mapping[str, Any]) -> None:
        """Append one line to metrics.jsonl; numbers of steps and validations go to TensorBoard and W&B as well."""
        line = {"event": event, "step": step, "epoch": epoch, **values}
        # JSON has no NaN
        whole = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in line.items()}
        self._file.write(json.dumps(whole) + "\n")
        self._file.flush()
        if event in ("step", "validation"):
            for name, value in values.items():
                if isinstance(value, (int, float)):
                    self._board.add_scalar(f"{event}/{name}", value, step)
            if self._wandb:
                self._wandb.numbers(event, step, values)
        if event == "validation":
            self._score = describe_validation(values)
            points = f" on {values['points']} points" if "points" in values else ""
            self.say(f"step {step:6d}{self._score}{points} of {values['pairs']} held-out samples")

    def picture(self, name: str, step: int, image: Image) -> None:
        """Show an image (H, W, 3) uint8 RGB in TensorBoard and W&B."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        # not add_image, which needs Pillow
        height, width = image.shape[:2]
        shown = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=as_png(image))
        self._board._get_file_writer().add_summary(Summary(value=[Summary.Value(tag=name, image=shown)]), step)
        if self._wandb:
            self._wandb.picture(name, step, image)

    def progress(self, step: int, meter: Meter) -> None:
        """Show where the run is: a live line in a terminal, else a plain line every few seconds."""
        speed = f"{meter.pairs_per_second:.1f} pairs/s  data wait {meter.data_wait:.0%}"
        # not Rich's own estimate, which knows nothing where a step takes more than half a minute
        seconds = (time.perf_counter() - self._began) / max(1, step - self._began_at) * (self._total - step)
        text, left = f"{speed}  loss {meter.loss:.4f}{self._score}", f"{timedelta(seconds=round(seconds))} left"
        if self._progress:
            self._progress.update(self._task, completed=step, description=text, left=left)
        elif time.perf_counter() >= self._line_due or step == self._total:
            self._line_due = time.perf_counter() + 5
            self.say(f"step {step:6d}/{self._total}  {text}  {left}")

    def say(self, text: str) -> None:
        """Print a line above the progress."""
        if self._progress:
            self._progress.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            print(text, file=sys.stderr, flush=True)


class SilentLog:
    """The log of the ranks that do not talk."""

    def __enter__(self) -> SilentLog:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def event(self, event: str, step: int, epoch: int, values: Mapping[str, Any]) -> None:
        """Nothing."""

    def picture(self, name: str, step: int, image: Image) -> None:
        """Nothing."""

    def progress(self, step: int, meter: Meter) -> None:
        """Nothing."""

    def say(self, text: str) -> None:
        """Nothing."""


def describe_validation(values: Mapping[str, Any]) -> str:
    """The held-out scores of a method, in a few words."""
    names = {"pck": "PCK {:.3f}", "mask_iou": "mask IoU {:.2f}", "retrieval": "retrieval {:.3f}"}
    names["accuracy"] = "accuracy {:.3f}"
    return "".join(f"  {text.format(values[name])}" for name, text in names.items() if name in values)


def describe_start(facts: dict[str, Any]) -> str:
    """The first lines that a run says."""
    kind, unit = facts["samples"], facts["batch_of"]
    ranks = "" if facts["world"] == 1 else f" on {facts['world']} ranks"
    lines = [
        f"training {facts['method']} on {facts['pairs']:,} {kind} of {facts['objects']:,} objects: "
        f"{facts['batch_size']} {unit} a step, "
        f"{facts['steps_per_epoch']:,} steps an epoch, {facts['total_steps']:,} in all",
        f"{facts['parameters'] / 1e6:.1f} M parameters, {facts['precision']}, {facts['device']}{ranks}",
    ]
    if facts["warmup_steps"] >= facts["total_steps"]:
        lines.append(
            f"WARNING: the run ends before its {facts['warmup_steps']:,} steps of warm-up do: the learning rate never "
            "reaches optimiser.lr. Lower schedule.warmup_steps, or raise schedule.epochs or data.pairs_per_object"
        )
    if facts["left_out"]:
        why = "have too few correspondences (data.min_correspondences)" if kind == "pairs" else "have no category"
        lines.append(f"{facts['left_out']:,} {kind} {why}: left out")
    if facts["resumed_from"]:
        lines.append(f"going on at step {facts['resumed_at']:,} from {facts['resumed_from']}")
    return "\n".join(lines)


def read_metrics(run: Path, event: str | None = None) -> list[dict[str, Any]]:
    """The lines of RUN/metrics.jsonl (of one kind). What a crash cut off or left of other things is left out."""
    lines = []
    path = run / METRICS
    for text in path.read_bytes().splitlines() if path.is_file() else []:
        try:
            line = json.loads(text)
        except ValueError:  # bytes that are no UTF-8 as well
            continue
        if isinstance(line, dict) and {"event", "step"} <= line.keys() and event in (None, line["event"]):
            lines.append(line)
    return lines


def _forget_after(path: Path, step: int) -> None:
    kept = [json.dumps(line) + "\n" for line in read_metrics(path.parent) if line["step"] <= step]
    files.write_bytes(path, "".join(kept).encode())
