"""What `dope prep` shows: a live line for each running sequence, then a table of what happened."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

if TYPE_CHECKING:
    from pipeline.stages import StageResult

LOG_WIDTH = 1000
STYLES = {"ok": "green", "empty": "yellow", "failed": "red"}


class Display:
    """A watcher of `pipeline.prepare` that draws progress; plain lines where there is no terminal."""

    def __init__(self, total: int, title: str) -> None:
        self.console = Console(stderr=True, highlight=False)
        self.live = self.console.is_terminal
        self.progress = Progress(
            TextColumn("{task.description}"), BarColumn(24), MofNCompleteColumn(), TimeElapsedColumn(),
            TextColumn("[dim]{task.fields[note]}"), console=self.console, transient=True,
        )  # fmt: skip
        self.main = self.progress.add_task(title, total=total, note="")
        self.tasks: dict[str, TaskID] = {}
        self.total, self.count, self.start = total, 0, time.monotonic()
        self.lock = threading.Lock()

    @contextmanager
    def showing(self) -> Iterator[Display]:
        if not self.live:
            yield self
            return
        with self.progress:
            yield self

    def started(self, sequence: str) -> None:
        with self.lock:
            self.tasks[sequence] = self.progress.add_task(f"  {escape(sequence)}", total=None, note="starting")

    def note(self, sequence: str, text: str) -> None:
        with self.lock:
            if sequence in self.tasks:
                self.progress.update(self.tasks[sequence], note=escape(text))

    def finished(self, sequence: str, rows: list[StageResult]) -> None:
        with self.lock:
            if sequence in self.tasks:
                self.progress.remove_task(self.tasks.pop(sequence))
            self.count += 1
            self.progress.update(self.main, completed=self.count)
            skipped = all(row.skipped for row in rows)
            if not self.live and not skipped:
                seconds = time.monotonic() - self.start
                stages = ", ".join(f"{row.stage} {row.status}" for row in rows)
                self.console.print(
                    f"[{self.count}/{self.total}, {seconds:.0f} s] {escape(sequence)}: {stages}", soft_wrap=True
                )


def describe(row: StageResult) -> str:
    """A row's outcome in a few words: the reason of a failure, else the stage's main figures."""
    if row.status != "ok":
        return row.reason or ""
    wanted = {
        "frames": "{kept} of {frames} frames kept",
        "sfm": "{n_registered} of {n_frames} frames registered, {n_points} points, {mean_error_px:.2f} px, by {rung}",
        "depth": "{coverage:.0%} of the pixels, {sparse_within_2_percent:.0%} within 2% of the points",
        "masks": "{masks} masks from {from}, {missing} missing, {empty} empty, {flagged} flagged",
        "correspond": "{pairs} pairs of {views} views, {median_correspondences:.0f} points a pair",
    }
    if row.stage == "sfm" and "mean_error_px" not in row.details:  # given cameras and given points: nothing was matched
        wanted["sfm"] = "{n_registered} of {n_frames} frames with cameras, {n_points} points, {rung}"
    try:
        text = wanted[row.stage].format(**row.details)
    except (KeyError, ValueError, TypeError):  # a stage that reports other figures is still a row
        text = ", ".join(f"{k} {v}" for k, v in row.details.items() if isinstance(v, (int, float, str)))
    warnings = row.details.get("warnings") or []
    return "; ".join([text, *map(str, warnings)])


def show_rows(rows: list[StageResult], *, as_json: bool) -> None:
    """Print the rows: a table, failures last where they are seen, or JSON lines."""
    if as_json:
        from pipeline.tasks import rows_as_json

        for values in rows_as_json(rows):
            sys.stdout.write(json.dumps(values, ensure_ascii=False) + "\n")
        return
    from pipeline.report.status_text import printable

    # in a log a row is one line, whatever its length: paths stay whole and can be searched for
    console = Console(highlight=False, width=None if sys.stdout.isatty() else LOG_WIDTH)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("sequence", "stage", "status", "seconds"):
        table.add_column(column, no_wrap=column != "sequence", justify="right" if column == "seconds" else "left")
    table.add_column("what")
    for row in sorted(rows, key=lambda row: row.status == "failed"):
        status = f"[{STYLES[row.status]}]{row.status}[/]" + (" [dim](done before)[/]" if row.skipped else "")
        seconds = "" if row.skipped else f"{row.seconds:.1f}"
        table.add_row(escape(row.sequence), row.stage, status, seconds, escape(printable(describe(row))))
    console.print(table)
    if any(row.skipped and row.status == "failed" for row in rows):
        console.print("What failed before was not tried again; --retry-failed does that.")


def exit_code(rows: list[StageResult]) -> int:
    """0 all ok; 1 some items failed or came out empty, and the table says which and why."""
    return 0 if all(row.ok for row in rows) else 1


def show_shards(out: Path, details: dict[str, Any], *, as_json: bool) -> None:
    """Print what `write_shards` returned; sequences that were left out come last, with their reasons."""
    if as_json:
        sys.stdout.write(json.dumps({"out": str(out), **details}, ensure_ascii=False) + "\n")
        return
    console = Console(highlight=False)
    done = " (done before)" if details.get("skipped") else ""
    pairs, views = details["pairs"], details["views"]
    console.print(
        f"[bold]{escape(str(out))}[/]: {pairs['train']} training pairs, {pairs['val']} held-out pairs, "
        f"{sum(views.values())} views of {details['sequences']} sequences{done}",
        soft_wrap=True,
    )
    if details.get("waiting_for"):
        console.print(f"  {details['waiting_for']} tars are still to be written by the other parts of this array job")
    if details["without_val_pairs"]:
        names = ", ".join(details["without_val_pairs"])
        console.print(f"  nothing could be held out of {escape(names)}", soft_wrap=True)
    if "verified" in details:
        console.print(f"  verified: {details['verified']['bytes']:,} bytes in {details['verified']['shards']} tars")
    for sequence, reason in details["left_out"].items():
        console.print(f"  [yellow]left out[/] {escape(sequence)}: {escape(reason)}", soft_wrap=True)
