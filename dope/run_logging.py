"""What a run says: metrics.jsonl for programs, TensorBoard for eyes, one line of progress for whoever started it."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from dope.common import files

METRICS = "metrics.jsonl"


class RunLog:
    """Writes RUN/metrics.jsonl and RUN/tensorboard and shows progress; use as a context manager, on the first rank.

    A line of metrics.jsonl has `event` (start, step, validation, checkpoint, not_finite, end), `step`, `epoch` and the
    values.

    Args:
        run: the folder.
        start: steps already done; lines of later steps, left by a run that was killed, are removed.
        total: steps of the whole run.
    """

    def __init__(self, run: Path, *, start: int, total: int) -> None:
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
                TimeRemainingColumn(),
                console=self._console,
            )
            self._task = self._progress.add_task("", total=total, completed=start)
        self._total, self._pck, self._line_due = total, "", 0.0
        self._began, self._began_at = time.perf_counter(), start

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

    def event(self, event: str, step: int, epoch: int, values: Mapping[str, Any]) -> None:
        """Append one line to metrics.jsonl, and the numbers among the values to TensorBoard."""
        line = {"event": event, "step": step, "epoch": epoch, **values}
        # JSON has no NaN
        whole = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in line.items()}
        self._file.write(json.dumps(whole) + "\n")
        self._file.flush()
        if event in ("step", "validation"):
            for name, value in values.items():
                if isinstance(value, (int, float)):
                    self._board.add_scalar(f"{event}/{name}", value, step)
        if event == "validation":
            self._pck = f"  PCK {values['pck']:.3f}  mask IoU {values['mask_iou']:.2f}"
            self.say(f"step {step:6d}{self._pck} on {values['points']} points of {values['pairs']} held-out pairs")

    def progress(self, step: int, loss: float, pairs_per_second: float) -> None:
        """Show where the run is: a live line in a terminal, else a plain line every few seconds."""
        text = f"loss {loss:.4f}  {pairs_per_second:.1f} pairs/s{self._pck}"
        if self._progress:
            self._progress.update(self._task, completed=step, description=text)
        elif time.perf_counter() >= self._line_due or step == self._total:
            self._line_due = time.perf_counter() + 5
            left = (time.perf_counter() - self._began) / max(1, step - self._began_at) * (self._total - step)
            self.say(f"step {step:6d}/{self._total}  {text}  {left:.0f} s left")

    def say(self, text: str) -> None:
        """Print a line above the progress."""
        if self._progress:
            self._progress.console.print(text, highlight=False)
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

    def progress(self, step: int, loss: float, pairs_per_second: float) -> None:
        """Nothing."""

    def say(self, text: str) -> None:
        """Nothing."""


class Meter:
    """Loss and speed of a call of `train`; speed over the last steps, without the first, which warms up."""

    def __init__(self, first_step: int, window: int = 50) -> None:
        self.first_step, self.loss = first_step, float("nan")
        self._began = time.perf_counter()
        self._marks, self._window = [(self._began, 0)], window

    def add(self, pairs: int, loss: float) -> None:
        """Note a step."""
        self.loss = loss
        self._marks = [*self._marks[-self._window :], (time.perf_counter(), self._marks[-1][1] + pairs)]

    @property
    def seconds(self) -> float:
        """Since the beginning."""
        return time.perf_counter() - self._began

    @property
    def pairs_per_second(self) -> float:
        """Of all ranks together; 0 before the first step."""
        marks = self._marks[1:] if len(self._marks) > 2 else self._marks
        return (marks[-1][1] - marks[0][1]) / max(1e-9, marks[-1][0] - marks[0][0])


def read_metrics(run: Path, event: str | None = None) -> list[dict[str, Any]]:
    """The lines of RUN/metrics.jsonl (of one kind). A last line that was cut off by a crash is left out."""
    lines = []
    path = run / METRICS
    for text in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        try:
            line = json.loads(text)
        except ValueError:
            continue
        if event is None or line["event"] == event:
            lines.append(line)
    return lines


def _forget_after(path: Path, step: int) -> None:
    kept = [json.dumps(line) + "\n" for line in read_metrics(path.parent) if line["step"] <= step]
    files.write_bytes(path, "".join(kept).encode())
