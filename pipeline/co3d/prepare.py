"""CO3D sequences as prepared sequences: stages `frames`, `sfm` (the given cameras) and `depth`, like every source.

What comes out is what `dope prep colmap` writes, so that masks, correspond and shards need not know where it is from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from dope.common.errors import BadInput
from pipeline import stages
from pipeline.cameras.project import keep_project
from pipeline.cameras.sfm import SfmConfig
from pipeline.children import Notify
from pipeline.co3d.depth import Co3dDepths
from pipeline.co3d.frames import Co3dFramesConfig, annotated_camera, extract_frames, restore_masks
from pipeline.co3d.points import Points, cloud_points, depth_points
from pipeline.co3d.sources import Co3dSource, source_fingerprint
from pipeline.depth.mvs import DepthConfig, compute_depth
from pipeline.prepare import bring_input_masks_back
from pipeline.sequence import Sequence
from pipeline.stages import StageResult, run_stage
from pipeline.tasks import RunOptions, Task, Unwatched, Watcher, run_tasks

CO3D_STAGES = ("frames", "sfm", "depth")


@dataclass(frozen=True)
class MapsConfig:
    """Where a CO3D sequence's points and depth come from."""

    points: Literal["auto", "cloud", "depth", "matches"] = "auto"
    """Points of the object: its point cloud, its depth maps inside the masks, or matched features, which cost most;
    auto: the first of these that is there."""
    depth: Literal["given", "stereo", "either"] = "given"
    """CO3D's depth maps; our own stereo; or either: stereo for sequences without depth maps."""
    depth_masks: bool = True
    """Leave out what CO3D's depth masks say is not reliable, of the depth maps and of points from them."""


@dataclass(frozen=True)
class Co3dConfig:
    """Settings of `dope prep co3d`."""

    frames: Co3dFramesConfig = field(default_factory=Co3dFramesConfig)
    """Which frames are taken, and how they are stored."""
    maps: MapsConfig = field(default_factory=MapsConfig)
    """Where points and depth come from."""
    sfm: SfmConfig = field(default_factory=SfmConfig)
    """Features and matches, where points come from them."""
    depth: DepthConfig = field(default_factory=DepthConfig)
    """Depth maps: size, checks, stereo."""


def prepare_co3d(
    sources: list[Co3dSource], work: Path, config: Co3dConfig, options: RunOptions, watcher: Watcher | None = None
) -> list[StageResult]:
    """Frames, cameras and depth of every sequence: WORK/<id>/. Rows in the order of the sources and stages.

    Raises:
        DiskFull: the disk is full; finished stages keep their results.
    """
    tasks = []
    for source in sources:
        folder, plan, inputs, refusal = work / source.id, {}, None, None
        try:
            inputs, n_frames, present = source_fingerprint(source, config.frames.every)
            plan = {stage: stages.fingerprint(stage, *reads) for stage, reads in _reads(config, inputs).items()}
            refusal = _no_images(source, n_frames, present) or _other_input(Sequence(folder), source)
        except BadInput as error:
            refusal = str(error)
        tasks.append(Task(folder, CO3D_STAGES, plan, _prepare_one, (source, inputs, config), refusal))
    return run_tasks(tasks, options, watcher or Unwatched())


def _reads(config: Co3dConfig, inputs: Any) -> dict[str, tuple[Any, Any]]:
    """Settings and inputs of each stage, in order: what its fingerprint is made of, which the next stage reads."""
    frames = config.frames, inputs
    sfm = config.sfm, [stages.fingerprint("frames", *frames), config.maps.points, config.maps.depth_masks]
    depth = config.depth, [stages.fingerprint("sfm", *sfm), config.maps.depth]
    return {"frames": frames, "sfm": sfm, "depth": depth}


def _no_images(source: Co3dSource, n_frames: int, present: int) -> str | None:
    """A sequence that was not downloaded, or is not in the chosen sets, is refused without starting a process."""
    if present:
        return None
    if not n_frames and (numbers := source.not_annotated) and len(numbers) == len(set(source.members or ())):
        what = f"not one of the {len(numbers)} frames that the set lists name is annotated"
        return str(BadInput(what, where=source.path, remedy=f"Download {source.category.name} again"))
    what = f"not one of its {n_frames} frames' images is there" if n_frames else "no frame of the chosen sets is taken"
    remedy = f"Download the rest of {source.category.name}" if n_frames else "Take more frames with a smaller --every"
    return str(BadInput(what, where=source.path, remedy=remedy))


def _other_input(sequence: Sequence, source: Co3dSource) -> str | None:
    """Why a sequence must not take the place of what WORK/<id> holds: another input, still there, has the same name."""
    try:
        before = Path(sequence.read_info().source)
        if not before.exists() or before.samefile(source.path):
            return None
    except (BadInput, OSError, ValueError):
        return None
    remedy = "Choose another --out, or delete that folder"
    return str(BadInput(f"{sequence.folder} holds the sequence of {before} already", where=source.path, remedy=remedy))


def _prepare_one(
    folder: Path, source: Co3dSource, inputs: Any, config: Co3dConfig, options: RunOptions, notify: Notify
) -> list[StageResult]:
    sequence, threads = Sequence(folder), options.limits.threads
    depths = Co3dDepths(source, config.frames.every, masked=config.maps.depth_masks)

    def frames() -> dict[str, Any]:
        details = extract_frames(source, sequence, config.frames)
        keep_project(sequence, sequence.read_frames(), None, wanted=config.sfm.keep_database)
        return details

    def sfm() -> dict[str, Any]:
        restore_masks(source, sequence, config.frames)
        return _place_cameras(source, sequence, depths, config, threads)

    def depth() -> dict[str, Any]:
        there = any(annotation.mask for annotation in depths.annotations)
        bring_input_masks_back(sequence, lambda: restore_masks(source, sequence, config.frames), there=there)
        return _depth(sequence, depths, config, threads)

    work: dict[str, Callable[[], dict[str, Any]]] = {"frames": frames, "sfm": sfm, "depth": depth}
    again: dict[str, Any] = {"overwrite": options.overwrite, "retry_failed": options.retry_failed}
    rows = []
    for stage, (settings, read) in _reads(config, inputs).items():
        notify(f"{stage}: started")
        rows.append(run_stage(sequence, stage, settings, read, work[stage], **again))
        if not rows[-1].ok:
            break
    return rows


def _place_cameras(
    source: Co3dSource, sequence: Sequence, depths: Co3dDepths, config: Co3dConfig, threads: int
) -> dict[str, Any]:
    """The whole `sfm` stage: the annotated cameras, and points of the object."""
    from pipeline.cameras.known import KnownCameras, place_cameras

    points, how, warnings = _points(source, sequence, depths, config.maps.points)
    cameras = {
        frame.source_name: annotated_camera(depths.annotations[frame.frame])
        for frame in sequence.read_frames()
        if frame.image is not None
    }
    xyz, rgb = (None, None) if points is None else (points.xyz, points.rgb)
    known = KnownCameras(cameras, xyz, rgb, str(source.path))
    whose: Literal["triangulate", "given"] = "triangulate" if points is None else "given"
    details = place_cameras(sequence, known, replace(config.sfm, threads=threads, known_points=whose))
    return {**details, "points_from": how, "warnings": [*details.get("warnings", []), *warnings]}


def _points(
    source: Co3dSource, sequence: Sequence, depths: Co3dDepths, wanted: str
) -> tuple[Points | None, str, list[str]]:
    """Points of the object, where they are from, and why not from what comes first. Raises BadInput."""
    warnings: list[str] = []
    ways: dict[str, Callable[[], Points | None]] = {
        "cloud": lambda: cloud_points(source),
        "depth": lambda: depth_points(sequence, depths),
    }
    for how, find in ways.items():
        if wanted not in ("auto", how):
            continue
        what = f"no {how} is annotated"
        try:
            points = find()
            if points is not None:
                return points, how, warnings
        except BadInput as error:
            what = error.what
            warnings.append(what)
        if wanted == how:
            raise BadInput(what, where=source.path, remedy="Use --points auto")
    return None, "matches", warnings


def _depth(sequence: Sequence, depths: Co3dDepths, config: Co3dConfig, threads: int) -> dict[str, Any]:
    from pipeline.depth.imported import import_depths

    own = replace(config.depth, threads=threads)
    if config.maps.depth == "stereo":
        return compute_depth(sequence, own)
    kept = [frame.frame for frame in sequence.read_frames() if frame.image is not None]
    if not any(depths.annotations[number].depth for number in kept):
        if config.maps.depth == "either":
            return compute_depth(sequence, own)
        remedy = "Use --depth either (or stereo) to compute it"
        raise BadInput("CO3D has no depth for its frames", where=sequence.folder, remedy=remedy)
    return import_depths(sequence, depths, own)
