"""The stages of `dope prep`, each over many sequences: what to run, in which order, in which process.

`prepare` makes prepared sequences of videos and photo folders (frames, sfm, depth); `add_masks` and `correspond_all`
widen them; `shards.write_shards` packs them. Each sequence works in a child process with limits; each returns rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from dope.common.errors import BadInput, DiskFull, DopeError
from pipeline import stages
from pipeline.children import ChildFailed, Limits, Notify, run_in_child
from pipeline.correspondences import CorrespondConfig, correspond
from pipeline.engines import holding, run_items
from pipeline.frames import FramesConfig, extract_frames
from pipeline.masks import MasksConfig, import_masks
from pipeline.mvs import DepthConfig, compute_depth
from pipeline.sequence import Sequence
from pipeline.sfm import SfmConfig, reconstruct
from pipeline.sources import Source, folder_fingerprint, source_fingerprint
from pipeline.stages import StageResult, run_stage


@dataclass(frozen=True)
class ColmapConfig:
    """Settings of `dope prep colmap`."""

    frames: FramesConfig = field(default_factory=FramesConfig)
    """Which frames are taken, and at what size."""
    sfm: SfmConfig = field(default_factory=SfmConfig)
    """Features, matching, mapping and what counts as success."""
    depth: DepthConfig = field(default_factory=DepthConfig)
    """Depth maps."""


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
class _Task:
    """One sequence's work: `plan` says what is expected to be done, `run` does it in a child."""

    folder: Path
    plan: list[tuple[str, str]]
    """(stage, fingerprint) in order."""
    run: Callable[..., list[StageResult]]
    arguments: tuple[Any, ...]


def prepare(
    sources: list[Source], work: Path, config: ColmapConfig, options: RunOptions, watcher: Watcher | None = None
) -> list[StageResult]:
    """Frames, cameras and depth of every source: WORK/<id>/. Rows in the order of the sources and stages.

    Raises:
        DiskFull: the disk is full; finished stages keep their results.
    """
    tasks = []
    for source in sources:
        inputs = source_fingerprint(source)
        marks = _colmap_marks(config, inputs)
        plan = list(marks.items())
        tasks.append(_Task(work / source.id, plan, _prepare_one, (source, inputs, config)))
    return _run(tasks, options, watcher or Unwatched())


def add_masks(
    sequences: list[Sequence],
    config: MasksConfig,
    masks: dict[str, Path],
    options: RunOptions,
    watcher: Watcher | None = None,
) -> list[StageResult]:
    """Masks of every sequence: imported from `masks[id]` where given, else kept if already there, else by GrabCut."""
    tasks = []
    for sequence in sequences:
        folder = masks.get(sequence.id)
        plan = [("masks", stages.fingerprint("masks", config, _masks_inputs(sequence, folder)))]
        tasks.append(_Task(sequence.folder, plan, _masks_one, (folder, config)))
    return _run(tasks, options, watcher or Unwatched())


def correspond_all(
    sequences: list[Sequence], config: CorrespondConfig, options: RunOptions, watcher: Watcher | None = None
) -> list[StageResult]:
    """Views, pairs and pixel correspondences of every sequence."""
    tasks = []
    for sequence in sequences:
        plan = [("correspond", stages.fingerprint("correspond", config, _marks(sequence, "depth", "masks")))]
        tasks.append(_Task(sequence.folder, plan, _correspond_one, (config,)))
    return _run(tasks, options, watcher or Unwatched())


def _run(tasks: list[_Task], options: RunOptions, watcher: Watcher) -> list[StageResult]:
    def one(task: _Task) -> list[StageResult]:
        rows = _already_done(task, options)
        if rows is None:
            watcher.started(task.folder.name)
            rows = _in_child(task, options, watcher)
        watcher.finished(task.folder.name, rows)
        return rows

    results = run_items(tasks, one, workers=options.workers)
    return [row for rows in results for row in rows]


def _already_done(task: _Task, options: RunOptions) -> list[StageResult] | None:
    """The rows of a sequence whose markers say that nothing is to be done, read without starting a process."""
    if options.overwrite:
        return None
    rows = []
    for stage, mark in task.plan:
        row = stages.read_marker(Sequence(task.folder), stage)
        if row is None or row.fingerprint != mark or (options.retry_failed and row.status == "failed"):
            return None
        row.skipped = True
        rows.append(row)
        if not row.ok:
            break
    return rows


def _in_child(task: _Task, options: RunOptions, watcher: Watcher) -> list[StageResult]:
    current = [task.plan[0][0]]

    def note(text: str) -> None:
        stage, _, rest = text.partition(": ")
        if stage in stages.LATER_STAGES:
            current[0] = stage
        watcher.note(task.folder.name, text if rest else stage)

    try:
        with holding(task.folder):
            try:
                rows: list[StageResult] = run_in_child(
                    task.run, task.folder, *task.arguments, options, limits=options.limits, notify=note
                )
            except ChildFailed as error:  # the child could not write its own marker
                mark = dict(task.plan)[current[0]]
                rows = [_failed(task.folder, current[0], str(error), mark)]
                stages.write_marker(Sequence(task.folder), rows[0])
            return rows
    except DiskFull:
        raise
    except DopeError as error:
        return [_failed(task.folder, current[0], str(error))]


def _failed(folder: Path, stage: str, reason: str, mark: str = "") -> StageResult:
    return StageResult(folder.name, stage, "failed", reason=reason, fingerprint=mark)


def _colmap_marks(config: ColmapConfig, inputs: Any) -> dict[str, str]:
    frames = stages.fingerprint("frames", config.frames, inputs)
    sfm = stages.fingerprint("sfm", config.sfm, frames)
    return {"frames": frames, "sfm": sfm, "depth": stages.fingerprint("depth", config.depth, sfm)}


def _prepare_one(
    folder: Path, source: Source, inputs: Any, config: ColmapConfig, options: RunOptions, notify: Notify
) -> list[StageResult]:
    sequence = Sequence(folder)
    marks = _colmap_marks(config, inputs)
    again: dict[str, Any] = {"overwrite": options.overwrite, "retry_failed": options.retry_failed}
    threads = options.limits.threads
    steps: list[tuple[str, Any, Any, Callable[[], dict[str, Any]]]] = [
        ("frames", config.frames, inputs, lambda: extract_frames(source, sequence, config.frames)),
        ("sfm", config.sfm, marks["frames"], lambda: reconstruct(sequence, replace(config.sfm, threads=threads))),
        ("depth", config.depth, marks["sfm"], lambda: compute_depth(sequence, replace(config.depth, threads=threads))),
    ]
    rows = []
    for stage, stage_config, stage_inputs, work in steps:
        notify(f"{stage}: started")
        rows.append(run_stage(sequence, stage, stage_config, stage_inputs, work, **again))
        if not rows[-1].ok:
            break
    return rows


def _marks(sequence: Sequence, *names: str) -> dict[str, str | None]:
    """Fingerprints of earlier stages; None where one was not run (its absence is an input, too)."""
    return {name: m.fingerprint if (m := stages.read_marker(sequence, name)) else None for name in names}


def _masks_inputs(sequence: Sequence, folder: Path | None) -> dict[str, Any]:
    files = None if folder is None else folder_fingerprint(folder)
    return {**_marks(sequence, "frames", "sfm"), "files": files}


def _masks_one(
    folder: Path, masks: Path | None, config: MasksConfig, options: RunOptions, notify: Notify
) -> list[StageResult]:
    sequence = Sequence(folder)

    def work() -> dict[str, Any]:
        if masks is not None:
            return {"from": str(masks), **import_masks(sequence, masks, config)}
        if any(frame.mask for frame in sequence.read_frames()):
            done = stages.require(sequence, "frames", "dope prep colmap")
            return {"from": "given to `dope prep colmap`", **done.details.get("masks", {})}
        return {"from": "GrabCut", **_grabcut(sequence, config)}

    notify("masks: started")
    again: dict[str, Any] = {"overwrite": options.overwrite, "retry_failed": options.retry_failed}
    return [run_stage(sequence, "masks", config, _masks_inputs(sequence, masks), work, **again)]


def _grabcut(sequence: Sequence, config: MasksConfig) -> dict[str, Any]:
    from pipeline.colmap import read_points
    from pipeline.grabcut import grabcut_masks

    stages.require(sequence, "sfm", "dope prep colmap")
    return grabcut_masks(sequence, read_points(sequence), config)


def _correspond_one(folder: Path, config: CorrespondConfig, options: RunOptions, notify: Notify) -> list[StageResult]:
    sequence = Sequence(folder)

    def work() -> dict[str, Any]:
        stages.require(sequence, "depth", "dope prep colmap")
        if stages.read_marker(sequence, "masks") is None and not any(f.mask for f in sequence.read_frames()):
            raise BadInput("has no masks", where=folder, remedy="Run `dope prep masks` first")
        return correspond(sequence, config)

    notify("correspond: started")
    again: dict[str, Any] = {"overwrite": options.overwrite, "retry_failed": options.retry_failed}
    return [run_stage(sequence, "correspond", config, _marks(sequence, "depth", "masks"), work, **again)]


def rows_as_json(rows: list[StageResult]) -> list[dict[str, Any]]:
    """Rows as plain values, for `--json` and for files."""
    return [asdict(row) for row in rows]
