"""Depth maps made by other tools brought into a prepared sequence: matched by name, scaled, cross-checked.

A depth map shows what the source image shows, as it is (with its lens distortion), at any size of the same shape.
COLMAP's dense arrays belong to undistorted images, see `FolderDepths`.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from dope.common.errors import BadInput
from pipeline.cameras.sparse_points import Tracks
from pipeline.depth.depth_filter import drop_contradicted, sample_pixels
from pipeline.depth.depth_folder import FolderDepths, has_shape_of
from pipeline.depth.import_scale import ImportConfig, Scale, find_scale
from pipeline.depth.mvs import (
    DepthConfig,
    clear_depths,
    describe,
    load_view,
    looked_at,
    object_centre,
    opencv_threads,
    store_depths,
)
from pipeline.depth.neighbours import choose_neighbours
from pipeline.depth.resample import reduced
from pipeline.depth.stereo import Depth, View
from pipeline.geometry import Floats
from pipeline.sequence import Frame, Sequence


class DepthSource(Protocol):
    """Where imported depth comes from."""

    @property
    def unit(self) -> Literal["cameras", "unknown", "auto"]:
        """cameras: depth is in the unit of the given cameras; unknown: its scale is fitted; auto: found out."""

    def read(self, frame: Frame) -> Depth | None:
        """z-depth (h, w) float32 of a frame's whole source image, of any size of that shape, in the source's unit.

        What is not a positive finite number is unknown; None: the frame has none. Raises `BadInput`.
        """


def import_depth_folder(sequence: Sequence, folder: Path, config: DepthConfig) -> dict[str, Any]:
    """Import a folder of depth maps, see `FolderDepths` and `import_depths`."""
    return import_depths(sequence, FolderDepths(sequence, folder, config), config)


def import_depths(sequence: Sequence, source: DepthSource, config: DepthConfig) -> dict[str, Any]:
    """Replace the depth maps of a sequence that has cameras by those of `source`.

    Depth is brought to `config.long_side` at most, scaled to the sequence's unit, and cross-checked: a pixel is removed
    only where several other views look through it (`AgreementConfig`); what no other view sees stays.

    Returns:
        Details of the stage: those of `compute_depth`, and how the scale was found, frames whose depth is missing or
        bad (with reasons), and the shares of depth that other views confirm and contradict.

    Raises:
        BadInput: no frame has usable depth, or no scale fits. The depth maps that were there before stay then.
    """
    from pipeline.cameras import colmap

    started = time.process_time()
    frames = sequence.read_frames()
    registered = [frame for frame in frames if frame.registered and frame.image]
    if not registered:
        raise BadInput("no registered frame, depth needs cameras", where=sequence.folder, remedy="Run the sfm stage")
    tracks = colmap.read_points(sequence).longer_than(config.min_track)
    with opencv_threads(config.threads):
        raw, missing, bad = _read_all(registered, source, config.long_side)
        views = _views(sequence, registered, raw, tracks, config)
        scale = _scale(sequence, source, registered, views, raw, tracks, config.imported)
        depths = [
            None if depth is None or not np.isfinite(factor) else depth * np.float32(factor)
            for depth, factor in zip(raw, scale.factors, strict=True)
        ]
        shares: dict[str, float | None] = {}
        if config.imported.check:
            cameras, targets = [view.camera for view in views], looked_at(views, object_centre(sequence, views))
            witnesses_of = choose_neighbours(cameras, targets, config.witnesses)
            depths, shares = drop_contradicted(cameras, depths, witnesses_of, config.agreement)
    clear_depths(sequence, frames)
    stored = store_depths(sequence, registered, views, depths)
    sequence.write_frames(frames)
    details = describe(registered, views, depths, stored, tracks)
    details["method"] = "imported"
    known = scale.factors[np.isfinite(scale.factors)]
    details["scale"], details["scale_from"] = float(np.median(known)), scale.method
    details["scale_points"] = scale.n_points
    details["scale_spread"] = None if scale.spread is None else round(scale.spread, 5)
    details["missing"] = len(missing)
    details |= {"missing_frames": missing} if missing else {}
    details |= {"bad_frames": bad} if bad else {}
    unscaled = [
        f.frame for f, d, s in zip(registered, raw, scale.factors, strict=True) if d is not None and np.isnan(s)
    ]
    details |= {"unscaled_frames": unscaled} if unscaled else {}
    details |= shares
    details["cpu_seconds_per_frame"] = round((time.process_time() - started) / len(registered), 3)
    return details


def _read_all(
    frames: list[Frame], source: DepthSource, long_side: int
) -> tuple[list[Depth | None], list[int], dict[int, str]]:
    """Depth of every frame in the source's unit; the frames without; and reasons for those that cannot be used."""
    depths: list[Depth | None] = []
    missing: list[int] = []
    bad: dict[int, BadInput] = {}
    for frame in frames:
        depth = None
        try:
            given = source.read(frame)
            if given is None:
                missing.append(frame.frame)
            else:
                depth = reduced(np.asarray(given, np.float32), long_side)
                if not has_shape_of(depth, frame):
                    raise BadInput(f"depth of frame {frame.frame} has not the shape of its image: {given.shape}")
                if not depth.any():
                    depth = None
                    raise BadInput(f"depth of frame {frame.frame} is unknown everywhere")
        except BadInput as error:
            bad[frame.frame] = error
        depths.append(depth)
    if all(depth is None for depth in depths):
        if bad:
            first = next(iter(bad.values()))
            raise BadInput(
                f"no depth map of {len(bad)} can be used: {first.what}", where=first.where, remedy=first.remedy
            )
        raise BadInput("no registered frame has a depth map")
    return depths, missing, {frame: str(error) for frame, error in bad.items()}


def _views(
    sequence: Sequence, frames: list[Frame], depths: list[Depth | None], tracks: Tracks, config: DepthConfig
) -> list[View]:
    """The frames as views of their depth maps' sizes."""
    masked = not sequence.read_info().masks_are_later
    views = []
    for frame, depth in zip(frames, depths, strict=True):
        size = None if depth is None else (depth.shape[1], depth.shape[0])
        views.append(load_view(sequence, frame, tracks, config, masked=masked, size=size))
    return views


def _scale(
    sequence: Sequence,
    source: DepthSource,
    frames: list[Frame],
    views: list[View],
    depths: list[Depth | None],
    tracks: Tracks,
    config: ImportConfig,
) -> Scale:
    ratios: list[Floats] = []
    for frame, view, depth in zip(frames, views, depths, strict=True):
        pixels, z = view.camera.project(tracks.seen_by(frame.frame))
        seen = np.zeros(len(z), np.float32) if depth is None else sample_pixels(depth, pixels)
        both = (seen > 0) & (z > 0)
        ratios.append(z[both] / seen[both])
    unit = config.unit if config.unit != "auto" else source.unit
    said = [config.scale] if config.scale is not None else [1.0]
    if config.scale is None and getattr(source, "whole_numbers", False):
        said = [0.001, 1.0]  # millimetres
        if unit == "cameras":
            raise BadInput(
                "whole numbers say nothing of their unit", remedy="Set depth.imported.scale, e.g. 0.001 (mm)"
            )
    per_unit = sequence.read_info().input_scale or 1.0
    return find_scale(ratios, [factor * per_unit for factor in said], unit, config)
