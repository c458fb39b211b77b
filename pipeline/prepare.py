"""The stages of `dope prep`, each over many sequences: what to run, in which order, in which process.

`prepare` makes prepared sequences of videos and photo folders (frames, sfm, depth); `add_masks` and `correspond_all`
widen them; `shards.write_shards` packs them. Each sequence works in a child process with limits; each returns rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from dope.common import settings
from dope.common.errors import BadInput, UsageError
from pipeline import stages
from pipeline.cameras.project import keep_project
from pipeline.cameras.sfm import SfmConfig, reconstruct
from pipeline.children import Notify
from pipeline.correspond.match import CorrespondConfig, correspond
from pipeline.depth.mvs import DepthConfig, compute_depth
from pipeline.inputs.frames import FramesConfig, before_cameras, extract_frames
from pipeline.inputs.sources import Source, masks_fingerprint, place_fingerprint, source_fingerprint
from pipeline.masks.agreement import check_across_views, forget_check, was_checked
from pipeline.masks.imported import MasksConfig, import_masks, restore_input_masks
from pipeline.sequence import Sequence
from pipeline.stages import StageResult, run_stage
from pipeline.tasks import RunOptions, Task, Unwatched, Watcher, run_tasks


@dataclass(frozen=True)
class ColmapConfig:
    """Settings of `dope prep colmap`."""

    frames: FramesConfig = field(default_factory=FramesConfig)
    """Which frames are taken, and at what size."""
    sfm: SfmConfig = field(default_factory=SfmConfig)
    """Features, matching, mapping and what counts as success."""
    depth: DepthConfig = field(default_factory=DepthConfig)
    """Depth maps."""
    masks: MasksConfig = field(default_factory=MasksConfig)
    """How masks are read that come with the input."""


COLMAP_STAGES = ("frames", "sfm", "depth")
RENDERS_A_PROCESS = 100


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
            inputs = colmap_inputs(source, config)
            plan = colmap_marks(config, inputs)
            refusal = other_input(Sequence(folder), source)
        except BadInput as error:
            refusal = str(error)
        tasks.append(Task(folder, COLMAP_STAGES, plan, prepare_one, (source, inputs, config), refusal))
    return run_tasks(tasks, options, watcher or Unwatched())


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
        folder, plan, refusal = masks.get(sequence.id), {}, None
        try:
            inputs = masks_inputs(_marks(sequence, "frames", "sfm"), folder, config)
            plan = {"masks": stages.fingerprint("masks", config, inputs)}
        except BadInput as error:
            refusal = str(error)
        tasks.append(Task(sequence.folder, ("masks",), plan, mask_one, (folder, config), refusal))
    return run_tasks(tasks, options, watcher or Unwatched())


def correspond_all(
    sequences: list[Sequence], config: CorrespondConfig, options: RunOptions, watcher: Watcher | None = None
) -> list[StageResult]:
    """Views, pairs and pixel correspondences of every sequence."""
    tasks = []
    for sequence in sequences:
        plan = {"correspond": stages.fingerprint("correspond", config, _marks(sequence, "depth", "masks"))}
        tasks.append(Task(sequence.folder, ("correspond",), plan, correspond_one, (config,)))
    short = all(map(_is_render, sequences))  # a process takes as long to start as one of them
    return run_tasks(tasks, options, watcher or Unwatched(), reuse=RENDERS_A_PROCESS if short else 1)


def _is_render(sequence: Sequence) -> bool:
    try:
        return sequence.read_info().kind == "render"
    except BadInput:
        return False


def other_input(sequence: Sequence, source: Source) -> str | None:
    """Why a source must not take the place of what WORK/<id> holds: another input, still there, has the same name."""
    try:
        before = Path(sequence.read_info().source)
    except BadInput:
        return None
    if not before.exists() or before.samefile(source.path):
        return None
    remedy = "Rename one of them, choose another --out, or delete that folder"
    return str(BadInput(f"{sequence.folder} holds the sequence of {before} already", where=source.path, remedy=remedy))


def colmap_inputs(source: Source, config: ColmapConfig) -> dict[str, Any]:
    """What the first stage reads: the source, and how its masks are read where it has any."""
    inputs = source_fingerprint(source)
    if source.masks is not None:
        values = settings.to_dict(before_cameras(source, config.masks))
        later = ("grabcut", "hull", "on_flag")  # what is done without masks, or after the cameras
        inputs["mask_settings"] = {name: value for name, value in values.items() if name not in later}
        inputs["coco_images"] = _table_fingerprint(config.masks)
    return inputs


def colmap_marks(config: ColmapConfig, inputs: Any) -> dict[str, str]:
    """The fingerprints of the stages of `dope prep colmap` on an input."""
    return marks_from_frames(config, stages.fingerprint("frames", config.frames, inputs))


def marks_from_frames(config: ColmapConfig, frames: str) -> dict[str, str]:
    """The same where the fingerprint of the first stage is known."""
    sfm = stages.fingerprint("sfm", config.sfm, frames)
    return {"frames": frames, "sfm": sfm, "depth": stages.fingerprint("depth", config.depth, sfm)}


def prepare_one(
    folder: Path, source: Source, inputs: Any, config: ColmapConfig, options: RunOptions, notify: Notify
) -> list[StageResult]:
    """Frames, cameras and depth of one source, in a child process: rows up to the first stage that is not ok."""
    sequence = Sequence(folder)
    marks = colmap_marks(config, inputs)
    again: dict[str, Any] = {"overwrite": options.overwrite, "retry_failed": options.retry_failed}
    threads = options.limits.threads

    def frames() -> dict[str, Any]:
        details = extract_frames(source, sequence, config.frames, config.masks)
        keep_project(sequence, sequence.read_frames(), None, wanted=config.sfm.keep_database)
        return details

    def restore() -> None:
        restore_input_masks(sequence, source.masks, before_cameras(source, config.masks))

    def sfm() -> dict[str, Any]:
        restore()
        if source.cameras is not None:
            from pipeline.cameras.known import reuse_cameras

            return reuse_cameras(sequence, source.cameras, replace(config.sfm, threads=threads))
        return reconstruct(sequence, replace(config.sfm, threads=threads))

    def depth() -> dict[str, Any]:
        bring_input_masks_back(sequence, restore, there=source.masks is not None)
        if source.depths is not None:
            from pipeline.depth.imported import import_depth_folder

            return import_depth_folder(sequence, source.depths, replace(config.depth, threads=threads))
        return compute_depth(sequence, replace(config.depth, threads=threads))

    steps: list[tuple[str, Any, Any, Callable[[], dict[str, Any]]]] = [
        ("frames", config.frames, inputs, frames),
        ("sfm", config.sfm, marks["frames"], sfm),
        ("depth", config.depth, marks["sfm"], depth),
    ]
    rows = []
    for stage, stage_config, stage_inputs, work in steps:
        notify(f"{stage}: started")
        rows.append(run_stage(sequence, stage, stage_config, stage_inputs, work, **again))
        if not rows[-1].ok:
            break
    return rows


def bring_input_masks_back(sequence: Sequence, restore: Callable[[], None], *, there: bool) -> None:
    """Depth sees the input's masks whole, whatever was dropped or put in their place since.

    The masks stage then has to be run again: its marker goes first, so that a run that is killed here goes on right.

    Args:
        restore: puts the input's masks back.
        there: the input has masks. Where it has none, depth reads none.
    """
    later = sequence.read_info().masks_are_later
    if (later and there) or (not later and was_checked(sequence.read_frames())):
        stages.marker_path(sequence, "masks").unlink(missing_ok=True)
        restore()


def _marks(sequence: Sequence, *names: str) -> dict[str, str | None]:
    """Fingerprints of earlier stages; None where one was not run (its absence is an input, too)."""
    return {name: m.fingerprint if (m := stages.read_marker(sequence, name)) else None for name in names}


def masks_inputs(marks: Mapping[str, str | None], masks: Path | None, config: MasksConfig) -> dict[str, Any]:
    """What the masks stage reads: the stages before it by their fingerprints, and the masks to be imported.

    Raises:
        BadInput: a file of masks cannot be read.
    """
    try:
        given = None if masks is None else masks_fingerprint(masks)
    except OSError as error:
        what, where = f"cannot be read ({error.strerror})", error.filename or masks
        raise BadInput(what, where=where, remedy="Check its permissions, and that it is still there") from error
    return {
        "frames": marks["frames"],
        "sfm": marks["sfm"],
        "files": given,
        "coco_images": _table_fingerprint(config),
    }


def _table_fingerprint(config: MasksConfig) -> str | None:
    if config.coco_images is None:
        return None
    try:
        return place_fingerprint(Path(config.coco_images))
    except OSError as error:
        raise UsageError(f"cannot be read ({error.strerror})", where=config.coco_images) from error


def mask_one(
    folder: Path, masks: Path | None, config: MasksConfig, options: RunOptions, notify: Notify
) -> list[StageResult]:
    """The masks stage of one sequence, in a child process."""
    sequence = Sequence(folder)

    def work() -> dict[str, Any]:
        forget_check(sequence)
        details = masks_of_sequence()
        if sequence.read_info().kind == "render" and details["from"] == "the input":
            return details  # they are exact
        return details | check_across_views(sequence, config.hull, config.on_flag)

    def masks_of_sequence() -> dict[str, Any]:
        given = stages.require(sequence, "frames", "dope prep colmap").details.get("masks")
        if masks is not None:
            with _masks_of(sequence, "import"):
                return {"from": str(masks), **import_masks(sequence, masks, config)}
        if given is None:
            with _masks_of(sequence, "grabcut"):
                return {"from": "GrabCut", **_grabcut(sequence, config)}
        if sequence.read_info().masks_are_later:
            remedy = "Name a folder with --from, or bring them back by preparing it again with --overwrite"
            raise BadInput("the masks that came with the input were replaced since", where=folder, remedy=remedy)
        return {"from": "the input", **given}

    notify("masks: started")
    again: dict[str, Any] = {"overwrite": options.overwrite, "retry_failed": options.retry_failed}
    inputs = masks_inputs(_marks(sequence, "frames", "sfm"), masks, config)
    return [run_stage(sequence, "masks", config, inputs, work, **again)]


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
    from pipeline.cameras.colmap import read_points
    from pipeline.masks.grabcut import grabcut_masks

    stages.require(sequence, "sfm", "dope prep colmap")
    return grabcut_masks(sequence, read_points(sequence), config)


def correspond_one(folder: Path, config: CorrespondConfig, options: RunOptions, notify: Notify) -> list[StageResult]:
    """The correspond stage of one sequence, in a child process."""
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
