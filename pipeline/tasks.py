"""One sequence's work and how it is run: what is done already, the rest in a child process with limits, rows of all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from dope.common.errors import DiskFull, DopeError
from pipeline import stages
from pipeline.children import ChildFailed, Children, ChildStopped, Limits, Notify, run_in_child
from pipeline.engines import holding, run_items
from pipeline.refused import refused
from pipeline.sequence import Sequence
from pipeline.stages import StageResult


@dataclass(frozen=True)
class RunOptions:
    """How a stage is run; nothing here changes what comes out."""

    workers: int = 1
    limits: Limits = field(default_factory=Limits)
    overwrite: bool = False
    retry_failed: bool = False


class Watcher(Protocol):
    """What a run tells of itself, from several threads."""

    def started(self, sequence: str) -> None: ...

    def note(self, sequence: str, text: str) -> None: ...

    def finished(self, sequence: str, rows: list[StageResult]) -> None: ...


class Unwatched:
    """A watcher that says nothing."""

    def started(self, sequence: str) -> None:
        pass

    def note(self, sequence: str, text: str) -> None:
        pass

    def finished(self, sequence: str, rows: list[StageResult]) -> None:
        pass


@dataclass(frozen=True)
class Task:
    """One sequence's work: `plan` says what is expected to be done, `run` does it in a child."""

    folder: Path
    stages: tuple[str, ...]
    """In order."""
    plan: dict[str, str]
    """Fingerprint of each stage; empty where the input cannot even be read."""
    run: Callable[..., list[StageResult]]
    arguments: tuple[Any, ...]
    refusal: str | None = None
    """Why nothing may be run."""


def run_tasks(tasks: list[Task], options: RunOptions, watcher: Watcher, *, reuse: int = 1) -> list[StageResult]:
    """Do what is not done of every task; rows in the order of the tasks.

    Args:
        reuse: how many tasks a child process does one after the other; 1: each has its own.
    """

    def one(task: Task) -> list[StageResult]:
        rows = already_done(task, options)
        if rows is None and task.refusal is not None:
            rows = [refused(task.folder.name, task.stages[0], task.refusal)]
        if rows is None:
            watcher.started(task.folder.name)
            rows = _in_child(task, options, watcher, call)
        watcher.finished(task.folder.name, rows)
        return rows

    def in_its_own(*args: Any, notify: Notify) -> list[StageResult]:
        rows: list[StageResult] = run_in_child(*args, limits=options.limits, notify=notify)
        return rows

    with Children(options.limits, reuse=reuse) as children:
        call = children.call if reuse > 1 else in_its_own
        results = run_items(tasks, one, workers=options.workers)
    return [row for rows in results for row in rows]


def already_done(task: Task, options: RunOptions) -> list[StageResult] | None:
    """The rows of a sequence whose markers say that nothing is to be done, read without starting a process."""
    if options.overwrite or not task.plan:
        return None
    rows = []
    for stage, mark in task.plan.items():
        row = stages.read_marker(Sequence(task.folder), stage)
        if row is None or row.fingerprint != mark or (options.retry_failed and not row.ok):
            return None
        row.skipped = True
        rows.append(row)
        if not row.ok:
            break
    return rows


def _in_child(
    task: Task, options: RunOptions, watcher: Watcher, call: Callable[..., list[StageResult]]
) -> list[StageResult]:
    started: list[str] = []

    def note(text: str) -> None:
        stage, _, rest = text.partition(": ")
        if stage in stages.LATER_STAGES:
            started.append(stage)
        watcher.note(task.folder.name, text if rest else stage)

    try:
        with holding(task.folder):
            try:
                rows = call(task.run, task.folder, *task.arguments, options, notify=note)
            except ChildStopped:
                raise
            except ChildFailed as error:  # the child could not write its own marker
                if not started:  # not even its modules could be loaded: no stage is to blame
                    raise
                sequence, stage = Sequence(task.folder), started[-1]
                stages.blame_full_disk(sequence, stage, str(error))
                rows = [_failed(task.folder, stage, str(error), task.plan[stage])]
                stages.write_marker(sequence, rows[0])
            return rows
    except DiskFull:
        raise
    except DopeError as error:
        return [_failed(task.folder, started[-1] if started else task.stages[0], str(error))]


def _failed(folder: Path, stage: str, reason: str, mark: str = "") -> StageResult:
    return StageResult(folder.name, stage, "failed", reason=reason, fingerprint=mark)


def rows_as_json(rows: list[StageResult]) -> list[dict[str, Any]]:
    """Rows as plain values, for `--json` and for files."""
    return [asdict(row) for row in rows]
