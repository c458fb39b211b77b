"""Meshes as prepared sequences: stages `frames`, `sfm` (the renderer's cameras) and `depth`, like every source.

What comes out is what `dope prep colmap` writes, so that correspond and shards need not know where it is from.
Rendering happens in `frames`: pictures, exact masks and depth come from one pass. A process renders many objects one
after the other, since one takes less time than the start of a process.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from collections.abc import Sequence as Ordered
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dope.common import files
from dope.common.errors import BadInput
from pipeline import stages
from pipeline.children import Limits, Notify, run_in_child
from pipeline.geometry import Camera
from pipeline.masks.mask_io import write_masks
from pipeline.prepare import RENDERS_A_PROCESS
from pipeline.render.cameras import paired_cameras
from pipeline.render.check import seen_by_both
from pipeline.render.config import CyclesConfig, FastConfig, RenderConfig
from pipeline.render.cycles import folders
from pipeline.render.find import RenderSource, mesh_fingerprint
from pipeline.render.scene import RENDERER_VERSIONS, Picture, Renderer, Scene
from pipeline.sequence import Frame, Sequence, SequenceInfo, write_image
from pipeline.stages import StageResult, run_stage
from pipeline.tasks import RunOptions, Task, Unwatched, Watcher, already_done, run_tasks

RENDER_STAGES = ("frames", "sfm", "depth")
GROUND_KEPT = 1.5
"""Depth is kept up to so many times the object's largest."""
POINTS_A_PAIR = 60
"""Points of the sparse model that a pair of views gives."""


@dataclass(frozen=True)
class ProceduralSource:
    """Object `number` of the series that `seed` begins."""

    number: int
    seed: int

    @property
    def category(self) -> None:
        return None

    @property
    def id(self) -> str:
        return f"procedural_{self.seed}_{self.number:06d}"

    @property
    def instance(self) -> str:
        return self.id

    @property
    def subset(self) -> None:
        return None

    @property
    def path(self) -> str:
        return f"procedural:{self.seed}:{self.number}"


ObjectSource = RenderSource | ProceduralSource


def prepare_renders(
    sources: Ordered[ObjectSource],
    work: Path,
    config: RenderConfig,
    options: RunOptions,
    watcher: Watcher | None = None,
) -> list[StageResult]:
    """Render every object: WORK/<id>/ with images, masks, depth and cameras. Rows in the order of sources and stages.

    Raises:
        BadInput: a folder of panoramas or materials that holds none.
        DopeError: the renderer is not installed, or cannot be started.
        DiskFull: the disk is full; finished stages keep their results.
    """
    given = {"renderer_version": RENDERER_VERSIONS[config.renderer], **_folders(config)}
    settled = _settled(config)
    tasks = []
    for source in sources:
        folder, plan, inputs, refusal = work / source.id, {}, None, None
        try:
            inputs = {**_fingerprint(source), **given}
            plan = _marks(settled, inputs)
            refusal = _other_input(Sequence(folder), source)
        except BadInput as error:
            refusal = str(error)
        tasks.append(Task(folder, RENDER_STAGES, plan, _render_one, (source, inputs, config), refusal))
    if any(task.refusal is None and already_done(task, options) is None for task in tasks):
        _require_renderer(config, options)
    try:
        return run_tasks(tasks, options, watcher or Unwatched(), reuse=RENDERS_A_PROCESS)
    finally:
        if config.renderer == "cycles":
            folders.sweep()  # children are ended by a signal


def _require_renderer(config: RenderConfig, options: RunOptions) -> None:
    """Start the renderer once, in a process of its own: where it is missing, that is one error, not one an object."""
    run_in_child(_start_renderer, config, options.limits, limits=options.limits)


def _start_renderer(config: RenderConfig, limits: Limits, notify: Notify) -> None:
    _renderer(config, limits).close()


def _settled(config: RenderConfig) -> RenderConfig:
    """The settings that matter: those of the other renderer, and where Blender is, change nothing."""
    if config.renderer == "fast":
        return replace(config, cycles=CyclesConfig())
    return replace(config, fast=FastConfig(), cycles=replace(config.cycles, python=None))


def _marks(config: RenderConfig, inputs: Any) -> dict[str, str]:
    frames = stages.fingerprint("frames", config, inputs)
    sfm = stages.fingerprint("sfm", None, frames)
    return {"frames": frames, "sfm": sfm, "depth": stages.fingerprint("depth", None, sfm)}


def _fingerprint(source: ObjectSource) -> dict[str, Any]:
    if isinstance(source, ProceduralSource):
        return {"id": source.id, "number": source.number, "seed": source.seed}
    return mesh_fingerprint(source)


def _folders(config: RenderConfig) -> dict[str, Any]:
    """What the folders of panoramas and materials hold. Raises `BadInput` where that is nothing."""
    from pipeline.render.grounds import find_materials
    from pipeline.render.skies import find_skies

    found: dict[str, Any] = {}
    for name, folder, find in (
        ("hdris", config.look.hdris, find_skies),
        ("materials", config.look.materials, find_materials),
    ):
        if folder is not None:
            places = find(Path(folder))
            paths = [below for path in places for below in ([path] if path.is_file() else sorted(path.iterdir()))]
            found[name] = [files.quick_fingerprint(path) for path in paths if path.is_file()]
    return found


def _other_input(sequence: Sequence, source: ObjectSource) -> str | None:
    """Why an object must not take the place of what WORK/<id> holds: another input, still there, has the same name."""
    try:
        before = sequence.read_info().source
        if before == str(source.path) or not Path(before).exists():
            return None
        if isinstance(source, RenderSource) and Path(before).samefile(source.path):
            return None
    except (BadInput, OSError, ValueError):
        return None
    what = f"{sequence.folder} holds the sequence of {before} already"
    return str(BadInput(what, where=source.path, remedy="Choose another --out, or delete that folder"))


def _render_one(
    folder: Path, source: ObjectSource, inputs: Any, config: RenderConfig, options: RunOptions, notify: Notify
) -> list[StageResult]:
    sequence, settled = Sequence(folder), _settled(config)
    marks = _marks(settled, inputs)
    work: list[tuple[str, Any, Any, Callable[[], dict[str, Any]]]] = [
        ("frames", settled, inputs, lambda: render_frames(source, sequence, config, options.limits)),
        ("sfm", None, marks["frames"], lambda: place_cameras(source, sequence, config)),
        ("depth", None, marks["sfm"], lambda: describe_depth(sequence)),
    ]
    rows = []
    for stage, its_settings, reads, run in work:
        notify(f"{stage}: started")
        again: dict[str, Any] = {"overwrite": options.overwrite, "retry_failed": options.retry_failed}
        rows.append(run_stage(sequence, stage, its_settings, reads, run, **again))
        if not rows[-1].ok:
            break
    return rows


def render_frames(source: ObjectSource, sequence: Sequence, config: RenderConfig, limits: Limits) -> dict[str, Any]:
    """The stage `frames`: the object loaded, posed, put in its scene and rendered; pairs that hardly show it dropped.

    Raises:
        BadInput: the mesh cannot be used, or no pair of views shows enough of it.
    """
    scene = build_scene(source, config)
    renderer = _renderer(config, limits)
    pictures = list(renderer.render(scene))
    cameras = [shot.camera for shot in scene.shots]
    rows = _frames(pictures, cameras, config)
    kept = [row for row in rows if row.dropped is None]
    if not kept:
        share = max(float(picture.mask.mean()) for picture in pictures)
        what = f"no pair of views shows it: it fills {share:.2%} of a view at most"
        remedy = "Look at the mesh: is it a thread, or seen edge-on? mesh.min_mask_share is the limit"
        raise BadInput(what, where=source.path, remedy=remedy)
    shutil.rmtree(sequence.depths, ignore_errors=True)
    with files.atomic_folder(sequence.images) as folder:
        for row in kept:
            row.image = f"images/{row.frame:06d}.jpg"
            picture = pictures[row.frame]
            write_image(folder / f"{row.frame:06d}.jpg", picture.image[..., ::-1], jpeg_quality=config.jpeg_quality)
    masks = ((row, pictures[row.frame].mask) for row in kept)
    mask_details = write_masks(sequence, rows, masks, min_share=0, nothing=BadInput("shows nothing", where=source.path))
    for row in kept:
        mask, depth = pictures[row.frame].mask, pictures[row.frame].depth
        # 16 bits are for the object and what is near it, not for the ground up to the horizon
        sequence.write_depth(row, np.where(depth <= GROUND_KEPT * depth[mask].max(), depth, 0))
    sequence.write_frames(rows)
    info = SequenceInfo(source.id, str(source.path), "render", source.category, source.instance)
    info.subset, info.paired, info.n_frames, info.masks_from = source.subset, True, len(kept), "input"
    sequence.write_info(info)
    details = {
        "frames": len(rows),
        "kept": len(kept),
        "dropped": {"shows too little of the object": len(rows) - len(kept)} if len(kept) < len(rows) else {},
        "ordered": False,
        "width": config.viewpoints.size,
        "height": config.viewpoints.size,
        "renderer": renderer.version,
        "faces": scene.model.n_faces,
        "surface": scene.surface.kind,
        "masks": mask_details,
        "warnings": [],
    }
    return details | _agreement(rows, pictures, cameras)


def build_scene(source: ObjectSource, config: RenderConfig) -> Scene:
    """The object in its pose, look, light and cameras. Raises `BadInput` where the mesh cannot be used."""
    from dope.common import seeds
    from pipeline.render.load import load_model
    from pipeline.render.pose import posed
    from pipeline.render.procedural import procedural_object
    from pipeline.render.recipe import draw_scene

    if isinstance(source, ProceduralSource):
        model, up = procedural_object(source.number, source.seed), "z"
    else:
        model, up = load_model(source.path, max_faces=config.mesh.max_faces), source.up
    rng = seeds.generator("pose", config.seed, source.id)
    model = posed(model, up=up, pose=config.mesh.pose, rng=rng)
    return draw_scene(model, paired_cameras(config.viewpoints, config.seed, source.id), config, source.id)


_renderers: dict[Any, Renderer] = {}


def _renderer(config: RenderConfig, limits: Limits) -> Renderer:
    """This process's renderer: contexts and Blender are started once. `limits` are those of Blender's process."""
    its = config.fast if config.renderer == "fast" else config.cycles
    if (its, limits) not in _renderers:
        if isinstance(its, FastConfig):
            from pipeline.render.fast import FastRenderer

            _renderers[its, limits] = FastRenderer(its)
        else:
            from pipeline.render.cycles.renderer import CyclesRenderer

            _renderers[its, limits] = CyclesRenderer(its, limits)
    return _renderers[its, limits]


def _frames(pictures: list[Picture], cameras: list[Camera], config: RenderConfig) -> list[Frame]:
    size = config.viewpoints.size
    rows = [
        Frame(number, f"{number:06d}", size, size, source_width=size, source_height=size)
        for number in range(len(cameras))
    ]
    for one, two in zip(rows[::2], rows[1::2], strict=True):
        least = min(float(pictures[row.frame].mask.mean()) for row in (one, two))
        if least < config.mesh.min_mask_share or not least:
            one.dropped = two.dropped = f"the object fills {least:.2%} of a view of this pair"
    return rows


def _agreement(rows: list[Frame], pictures: list[Picture], cameras: list[Camera]) -> dict[str, Any]:
    """How well the depths of paired views agree about the object's surface, over all pairs."""
    pairs = [(i, i + 1) for i in range(0, len(rows), 2) if rows[i].dropped is None]
    seen = [seen_by_both(pictures[i], cameras[i], pictures[j], cameras[j]) for i, j in pairs]
    miss = np.concatenate([pair.miss_px for pair in seen])
    if not len(miss):
        return {"pairs": len(pairs), "seen_by_both": 0.0}
    return {
        "pairs": len(pairs),
        "seen_by_both": round(float(np.median([pair.share for pair in seen])), 4),
        "median_miss_px": round(float(np.median(miss)), 4),
        "within_1_px": round(float((miss <= 1).mean()), 4),
    }


def place_cameras(source: ObjectSource, sequence: Sequence, config: RenderConfig) -> dict[str, Any]:
    """The stage `sfm`: the cameras that were rendered with, and a sparse model with points on the object."""
    from pipeline.cameras import colmap

    cameras = paired_cameras(config.viewpoints, config.seed, source.id)
    frames = sequence.read_frames()
    kept = [frame for frame in frames if frame.image is not None]
    for frame in kept:
        frame.set_camera(cameras[frame.frame])
    model = colmap.model_of_cameras({f.frame: cameras[f.frame] for f in kept}, [f.frame for f in kept])
    xyz, rgb, seen = _points(sequence, kept)
    colmap.add_points(model, xyz, rgb, seen)
    with files.atomic_folder(sequence.sparse) as partial:
        model.write(partial)
    sequence.write_frames(frames)
    info = sequence.read_info()
    report = {"rung": "given", "cameras_from": "the renderer", "n_frames": len(kept), "n_registered": len(kept)}
    report |= {"registered_share": 1.0, "n_points": model.n_points}
    info.attempts, info.n_registered, info.registered_share = [{**report, "verdict": "given"}], len(kept), 1.0
    info.unit, info.input_scale = "twice the object's largest coordinate", 1.0
    sequence.write_info(info)
    return {**report, "n_attempts": 1, "warnings": []}


def _points(sequence: Sequence, kept: list[Frame]) -> tuple[Any, Any, list[tuple[int, Any, Any]]]:
    """Points that both views of a pair see, their colours, and for each frame which it sees, and where."""
    xyz, rgb, seen, count = [], [], [], 0
    for one, two in zip(kept[::2], kept[1::2], strict=True):
        pictures = [_stored(sequence, frame) for frame in (one, two)]
        found = seen_by_both(pictures[0], one.camera, pictures[1], two.camera)
        some = np.linspace(0, len(found.points) - 1, min(POINTS_A_PAIR, len(found.points))).astype(int)
        numbers = count + np.arange(len(some))
        at = found.pixels1[some].astype(int)
        xyz.append(found.points[some])
        rgb.append(pictures[0].image[at[:, 1], at[:, 0]])
        seen += [(one.frame, numbers, found.pixels1[some]), (two.frame, numbers, found.pixels2[some])]
        count += len(some)
    return np.concatenate(xyz), np.concatenate(rgb), seen


def _stored(sequence: Sequence, frame: Frame) -> Picture:
    mask, depth = sequence.read_mask(frame), sequence.read_depth(frame)
    assert mask is not None and depth is not None
    return Picture(sequence.read_image(frame)[..., ::-1], mask, depth)


def describe_depth(sequence: Sequence) -> dict[str, Any]:
    """The stage `depth`: what of the object has depth; it was written along with the pictures."""
    known, covered = [], []
    for frame in sequence.registered_frames():
        picture = _stored(sequence, frame)
        known.append(float((picture.depth > 0).mean()))
        covered.append(float((picture.depth[picture.mask] > 0).mean()))
    return {
        "method": "rendered",
        "frames_with_depth": len(known),
        "coverage": round(float(np.mean(known)), 4),
        "mask_coverage": round(float(np.mean(covered)), 4),
        "warnings": [],
    }
