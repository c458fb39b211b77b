"""The stages of `dope prep`, each over many sequences: what to run, in which order, in which process.

`prepare` makes prepared sequences of videos and photo folders (frames, sfm, depth); `add_masks` and `correspond_all`
widen them; `shards.write_shards` packs them. Each sequence works in a child process with limits; each returns rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol

from dope.common.errors import BadInput, DiskFull, DopeError
from pipeline import stages
from pipeline.children import ChildFailed, ChildStopped, Limits, Notify, run_in_child
from pipeline.correspondences import CorrespondConfig, correspond
from pipeline.engines import holding, run_items
from pipeline.frames import FramesConfig, extract_frames
from pipeline.masks import MasksConfig, import_masks, restore_input_masks
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


COLMAP_STAGES = ("frames", "sfm", "depth")


@dataclass(frozen=True)
class _Task:
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


def prepare(
    sources: list[Source], work: Path, config: ColmapConfig, options: RunOptions, watcher: Watcher | None = None
) -> list[StageResult]:
    """Frames, cameras and depth of every source: WORK/<id>/. Rows in the order of the sources and stages.

    Raises:
        DiskFull: the disk is full; finished stages keep their results.
    """
    tasks = []
    for source in sources:
        folder, plan, inputs, refusal = work / source.id, {}, None, None
        try:
            inputs = source_fingerprint(source)
            plan = _colmap_marks(config, inputs)
            refusal = _other_input(Sequence(folder), source)
        except BadInput as error:
            refusal = str(error)
        tasks.append(_Task(folder, COLMAP_STAGES, plan, _prepare_one, (source, inputs, config), refusal))
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
        plan = {"masks": stages.fingerprint("masks", config, _masks_inputs(sequence, folder))}
        tasks.append(_Task(sequence.folder, ("masks",), plan, _masks_one, (folder, config)))
    return _run(tasks, options, watcher or Unwatched())


def correspond_all(
    sequences: list[Sequence], config: CorrespondConfig, options: RunOptions, watcher: Watcher | None = None
) -> list[StageResult]:
    """Views, pairs and pixel correspondences of every sequence."""
    tasks = []
    for sequence in sequences:
        plan = {"correspond": stages.fingerprint("correspond", config, _marks(sequence, "depth", "masks"))}
        tasks.append(_Task(sequence.folder, ("correspond",), plan, _correspond_one, (config,)))
    return _run(tasks, options, watcher or Unwatched())


def _run(tasks: list[_Task], options: RunOptions, watcher: Watcher) -> list[StageResult]:
    def one(task: _Task) -> list[StageResult]:
        rows = _already_done(task, options)
        if rows is None and task.refusal is not None:
            rows = [_failed(task.folder, task.stages[0], task.refusal)]
        if rows is None:
            watcher.started(task.folder.name)
            rows = _in_child(task, options, watcher)
        watcher.finished(task.folder.name, rows)
        return rows

    results = run_items(tasks, one, workers=options.workers)
    return [row for rows in results for row in rows]


def _already_done(task: _Task, options: RunOptions) -> list[StageResult] | None:
    """The rows of a sequence whose markers say that nothing is to be done, read without starting a process."""
    if options.overwrite or not task.plan:
        return None
    rows = []
    for stage, mark in task.plan.items():
        row = stages.read_marker(Sequence(task.folder), stage)
        if row is None or row.fingerprint != mark or (options.retry_failed and row.status == "failed"):
            return None
        row.skipped = True
        rows.append(row)
        if not row.ok:
            break
    return rows


def _in_child(task: _Task, options: RunOptions, watcher: Watcher) -> list[StageResult]:
    started: list[str] = []

    def note(text: str) -> None:
        stage, _, rest = text.partition(": ")
        if stage in stages.LATER_STAGES:
            started.append(stage)
        watcher.note(task.folder.name, text if rest else stage)

    try:
        with holding(task.folder):
            try:
                rows: list[StageResult] = run_in_child(
                    task.run, task.folder, *task.arguments, options, limits=options.limits, notify=note
                )
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


def _other_input(sequence: Sequence, source: Source) -> str | None:
    """Why a source must not take the place of what WORK/<id> holds: another input, still there, has the same name."""
    try:
        before = Path(sequence.read_info().source)
    except (BadInput, TypeError):
        return None
    if not before.exists() or before.samefile(source.path):
        return None
    remedy = "Rename one of them, choose another --out, or delete that folder"
    return str(BadInput(f"{sequence.folder} holds the sequence of {before} already", where=source.path, remedy=remedy))


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

    def sfm() -> dict[str, Any]:
        restore_input_masks(sequence, source.masks, MasksConfig())
        return reconstruct(sequence, replace(config.sfm, threads=threads))

    steps: list[tuple[str, Any, Any, Callable[[], dict[str, Any]]]] = [
        ("frames", config.frames, inputs, lambda: extract_frames(source, sequence, config.frames)),
        ("sfm", config.sfm, marks["frames"], sfm),
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
        given = stages.require(sequence, "frames", "dope prep colmap").details.get("masks")
        if masks is not None:
            with _masks_of(sequence, "import"):
                return {"from": str(masks), **import_masks(sequence, masks, config)}
        if given is None:
            with _masks_of(sequence, "grabcut"):
                return {"from": "GrabCut", **_grabcut(sequence, config)}
        if sequence.read_info().masks_are_later:
            remedy = "Name a folder with --from, or bring them back with `dope prep colmap --overwrite`"
            raise BadInput("the masks given to `dope prep colmap` were replaced since", where=folder, remedy=remedy)
        return {"from": "given to `dope prep colmap`", **given}

    notify("masks: started")
    again: dict[str, Any] = {"overwrite": options.overwrite, "retry_failed": options.retry_failed}
    return [run_stage(sequence, "masks", config, _masks_inputs(sequence, masks), work, **again)]


@contextmanager
def _masks_of(sequence: Sequence, whose: Literal["import", "grabcut"]) -> Iterator[None]:
    """Note whose the masks are before they are written: nobody's masks are ever taken for the input's."""
    info = sequence.read_info()
    before, info.masks_from = info.masks_from, whose
    sequence.write_info(info)
    try:
        yield
    except BadInput:  # then none was written
        info.masks_from = before
        sequence.write_info(info)
        raise


def _grabcut(sequence: Sequence, config: MasksConfig) -> dict[str, Any]:
    from pipeline.colmap import read_points
    from pipeline.grabcut import grabcut_masks

    stages.require(sequence, "sfm", "dope prep colmap")
    return grabcut_masks(sequence, read_points(sequence), config)


def _correspond_one(folder: Path, config: CorrespondConfig, options: RunOptions, notify: Notify) -> list[StageResult]:
    sequence = Sequence(folder)

    def work() -> dict[str, Any]:
        stages.require(sequence, "depth", "dope prep colmap")
        came_with_input = not sequence.read_info().masks_are_later and any(f.mask for f in sequence.read_frames())
        if not came_with_input or stages.read_marker(sequence, "masks") is not None:
            stages.require(sequence, "masks", "dope prep masks")
        return correspond(sequence, config)

    notify("correspond: started")
    again: dict[str, Any] = {"overwrite": options.overwrite, "retry_failed": options.retry_failed}
    return [run_stage(sequence, "correspond", config, _marks(sequence, "depth", "masks"), work, **again)]


def rows_as_json(rows: list[StageResult]) -> list[dict[str, Any]]:
    """Rows as plain values, for `--json` and for files."""
    return [asdict(row) for row in rows]
