"""All stages of every sequence in one go: each sequence's child process takes it from its input to correspondences.

No stage waits for the others' same stage, so no core idles while the slowest sequence finishes one. Markers and
fingerprints are those of the single commands: either goes on where the other stopped.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dope.common.errors import BadInput
from pipeline import stages
from pipeline.cameras.sfm import SfmConfig
from pipeline.children import Notify
from pipeline.correspond.match import CorrespondConfig, CorrespondenceConfig
from pipeline.correspond.pairs import PairsConfig
from pipeline.correspond.views import ViewsConfig
from pipeline.depth.mvs import DepthConfig
from pipeline.engines import Share
from pipeline.inputs.frames import FramesConfig
from pipeline.inputs.sources import Source
from pipeline.masks.imported import MasksConfig
from pipeline.prepare import (
    COLMAP_STAGES,
    ColmapConfig,
    colmap_inputs,
    colmap_marks,
    correspond_one,
    marks_from_frames,
    mask_one,
    masks_inputs,
    other_input,
    prepare_one,
)
from pipeline.sequence import Sequence
from pipeline.shards.plan import ShardsConfig
from pipeline.stages import StageResult
from pipeline.tasks import RunOptions, Task, Unwatched, Watcher, already_done, run_tasks

STAGES = (*COLMAP_STAGES, "masks", "correspond")


@dataclass(frozen=True)
class RunConfig:
    """Settings of `dope prep run`: the sections of all stages, so that one YAML file holds everything."""

    frames: FramesConfig = field(default_factory=FramesConfig)
    """Which frames are taken, and at what size."""
    sfm: SfmConfig = field(default_factory=SfmConfig)
    """Features, matching, mapping and what counts as success."""
    depth: DepthConfig = field(default_factory=DepthConfig)
    """Depth maps."""
    masks: MasksConfig = field(default_factory=MasksConfig)
    """What counts as a mask, and how one is made."""
    views: ViewsConfig = field(default_factory=ViewsConfig)
    """The square views."""
    pairs: PairsConfig = field(default_factory=PairsConfig)
    """Which views are paired."""
    match: CorrespondenceConfig = field(default_factory=CorrespondenceConfig)
    """Which pixels correspond."""
    shards: ShardsConfig = field(default_factory=ShardsConfig)
    """How samples are split and packed."""

    @property
    def colmap(self) -> ColmapConfig:
        return ColmapConfig(self.frames, self.sfm, self.depth, self.masks)

    @property
    def correspond(self) -> CorrespondConfig:
        return CorrespondConfig(self.views, self.pairs, self.match)


@dataclass(frozen=True)
class Item:
    """One sequence to be taken through the stages: from its source, or from where WORK holds it."""

    folder: Path
    source: Source | None
    masks: Path | None = None
    """Masks to import after reconstruction, or None."""


def items_of(sources: list[Source], held: list[Sequence], masks: dict[str, Path], work: Path) -> list[Item]:
    """The items of a run: all sources, or else what WORK holds."""
    from_source = [Item(work / source.id, source, masks.get(source.id)) for source in sources]
    return from_source + [Item(sequence.folder, None, masks.get(sequence.id)) for sequence in held]


def run_all(
    items: list[Item], config: RunConfig, options: RunOptions, watcher: Watcher | None = None
) -> list[StageResult]:
    """All stages up to correspondences of every item. Rows in the order of the items and stages.

    A sequence stops at the first stage that is not ok; that never stops the others.

    Raises:
        DiskFull: the disk is full; finished stages keep their results.
    """
    return run_tasks([_task(item, config) for item in items], options, watcher or Unwatched())


def still_to_do(items: list[Item], config: RunConfig, share: Share) -> list[str]:
    """Ids of the items that other parts of an array job have not finished, whether well or badly.

    Inputs are not read again: a sequence counts by the markers that follow from its `frames` marker, with the settings
    of this run.
    """
    waiting = []
    for place, item in enumerate(items):
        if place % share.count == share.index or already_done(_noted_task(item, config), RunOptions()) is not None:
            continue
        task = _task(item, config)
        if task.plan and not task.refusal:  # what cannot even be begun leaves no marker to wait for
            waiting.append(item.folder.name)
    return waiting


def _noted_task(item: Item, config: RunConfig) -> Task:
    """The task of an item whose input is taken to be what its `frames` marker says, if it has one."""
    if item.source is None:
        return _task(item, config)
    frames = stages.read_marker(Sequence(item.folder), "frames")
    plan = {} if frames is None else _plan(item, config, marks_from_frames(config.colmap, frames.fingerprint))
    return Task(item.folder, STAGES, plan, _run_one, ())


def _task(item: Item, config: RunConfig) -> Task:
    inputs, plan, refusal = None, {}, None
    try:
        if item.source is None:
            marks = {row.stage: row.fingerprint for row in _held(Sequence(item.folder))}
        else:
            inputs = colmap_inputs(item.source, config.colmap)
            marks = colmap_marks(config.colmap, inputs)
            refusal = other_input(Sequence(item.folder), item.source)
        plan = _plan(item, config, marks)
    except BadInput as error:
        refusal = str(error)
    return Task(item.folder, STAGES, plan, _run_one, (item, inputs, config), refusal)


def _plan(item: Item, config: RunConfig, marks: dict[str, str]) -> dict[str, str]:
    """The fingerprint of every stage, given those up to depth; a sequence whose depth failed goes no further."""
    if "depth" not in marks:
        return marks
    masks = stages.fingerprint("masks", config.masks, masks_inputs(marks, item.masks, config.masks))
    inputs = {"depth": marks["depth"], "masks": masks}
    return {**marks, "masks": masks, "correspond": stages.fingerprint("correspond", config.correspond, inputs)}


def _run_one(
    folder: Path, item: Item, inputs: Any, config: RunConfig, options: RunOptions, notify: Notify
) -> list[StageResult]:
    if item.source is None:
        rows = _held(Sequence(folder))
    else:
        rows = prepare_one(folder, item.source, inputs, config.colmap, options, notify)
    if rows[-1].ok:
        rows += mask_one(folder, item.masks, config.masks, options, notify)
    if rows[-1].ok:
        rows += correspond_one(folder, config.correspond, options, notify)
    return rows


def _held(sequence: Sequence) -> list[StageResult]:
    """The rows of a sequence that WORK holds, up to depth, as they are. Raises `BadInput` where one is missing."""
    rows = []
    for stage in COLMAP_STAGES:
        row = stages.read_marker(sequence, stage)
        if row is None:
            raise BadInput(f"stage '{stage}' has not been run", where=sequence.folder, remedy=_how_to_begin(sequence))
        row.skipped = True
        rows.append(row)
        if not row.ok:
            break
    return rows


def _how_to_begin(sequence: Sequence) -> str:
    try:
        kind = sequence.read_info().kind
    except BadInput:
        kind = ""
    return f"Run {'`dope prep co3d`' if kind == 'co3d' else 'the same command with its INPUT'} again"
