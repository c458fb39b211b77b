"""A prepared sequence for other tools: nerfstudio's transforms.json, or a COLMAP model in text files.

transforms.json follows https://docs.nerf.studio/quickstart/data_conventions.html: camera to world, OpenGL axes (y up, z
backward), paths relative to the file. nerfstudio reads 16-bit depth as thousandths of the unit, one scale for all
frames (`depth_unit_scale_factor`, 0.001 unless it is told otherwise); a prepared sequence has a scale a frame. So depth
is left out unless it is asked for, and then written anew in thousandths of the sequence's unit. nerfstudio also wants
a mask (or depth map) of every frame or of none: a frame that has none gets one that says that nothing is known, black.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dope.common import files
from dope.common.errors import BadInput
from pipeline.cameras import colmap
from pipeline.geometry import Camera
from pipeline.sequence import Frame, Sequence, write_image

Format = Literal["transforms", "colmap-text"]
DEPTH_STEP = 0.001
"""Unit of exported depth, as a share of the sequence's unit: nerfstudio's default."""
INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2")


def export_sequence(sequence: Sequence, format: Format, out: Path | None, *, depths: bool = False) -> dict[str, Any]:
    """Write a sequence's cameras and points for other tools.

    Args:
        out: folder for the files; None: the sequence's own. What else it holds stays as it is. A COLMAP model lies in
            its folder `sparse_text`.
        depths: with transforms: depth maps in thousandths of the unit, in `export_depths` beside the file.

    Returns:
        {"path", "frames", "points", "depths"}; depths counts those that the sequence has.

    Raises:
        BadInput: no frame has a camera.
    """
    frames = sequence.registered_frames()
    if not frames:
        raise BadInput("no frame has a camera", where=sequence.folder, remedy="Run `dope prep colmap` first")
    folder = out or sequence.folder
    if format == "colmap-text":
        folder = folder / "sparse_text"
        model = colmap.read_model(sequence.sparse)
        with files.atomic_folder(folder) as partial:
            model.write_text(partial)
        return {"path": str(folder), "frames": len(frames), "points": model.n_points, "depths": 0}
    folder.mkdir(parents=True, exist_ok=True)
    n_depths = sum(frame.depth is not None for frame in frames) if depths else 0
    written = _write_depths(sequence, frames, folder) if n_depths else {}
    masks = _mask_paths(sequence, frames, folder)
    n_points = _write_points(sequence, folder)
    values = transforms(sequence, frames, folder, masks, written, points=n_points > 0)
    text = json.dumps(values, indent=1, ensure_ascii=False) + "\n"
    files.write_bytes(folder / "transforms.json", text.encode())
    return {"path": str(folder / "transforms.json"), "frames": len(frames), "points": n_points, "depths": n_depths}


def transforms(
    sequence: Sequence,
    frames: list[Frame],
    folder: Path,
    masks: dict[int, str],
    depths: dict[int, str],
    *,
    points: bool,
) -> dict[str, Any]:
    """The values of transforms.json; intrinsics at the top where all frames share them, else in each frame.

    Args:
        frames: registered frames.
        folder: where the file lies; paths are relative to it.
        masks: paths of masks relative to `folder`, by frame number.
        depths: those of depth maps in thousandths of the unit.
        points: `points.ply` lies beside the file.
    """
    lenses = [_intrinsics(frame.camera) for frame in frames]
    shared = all(lens == lenses[0] for lens in lenses)
    above = Path(os.path.relpath(sequence.folder, folder))
    rows = []
    for frame, lens in zip(frames, lenses, strict=True):
        row: dict[str, Any] = {"file_path": (above / str(frame.image)).as_posix(), "source_name": frame.source_name}
        if frame.frame in masks:
            row["mask_path"] = masks[frame.frame]
        if frame.frame in depths:
            row["depth_file_path"] = depths[frame.frame]
        rows.append(row | ({} if shared else lens) | {"transform_matrix": _pose(frame.camera).tolist()})
    values: dict[str, Any] = {"camera_model": "OPENCV", **(lenses[0] if shared else {})}
    if points:
        values["ply_file_path"] = "points.ply"
    if depths:
        values["depth_unit_scale_factor"] = DEPTH_STEP
    return {**values, "frames": rows}


def _intrinsics(camera: Camera) -> dict[str, float]:
    K = camera.K
    values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height, *camera.distortion)
    return {key: v if isinstance(v, int) else float(v) for key, v in zip(INTRINSICS, values, strict=True)}


def _pose(camera: Camera) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Camera to world (4, 4) with OpenGL's axes."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.R.T * [1, -1, -1], camera.centre
    return pose


def _mask_paths(sequence: Sequence, frames: list[Frame], folder: Path) -> dict[int, str]:
    """The masks of all frames, relative to `folder`, or none. Those that are missing are written: nothing is object."""
    if all(frame.mask is None for frame in frames):
        return {}
    above = Path(os.path.relpath(sequence.folder, folder))
    paths = {frame.frame: (above / frame.mask).as_posix() for frame in frames if frame.mask is not None}
    without = [frame for frame in frames if frame.mask is None]
    if without:
        with files.atomic_folder(folder / "export_masks") as partial:
            for frame in without:
                name = f"{frame.frame:06d}.png"
                write_image(partial / name, np.zeros((frame.height, frame.width), np.uint8))
                paths[frame.frame] = f"export_masks/{name}"
    return paths


def _write_depths(sequence: Sequence, frames: list[Frame], folder: Path) -> dict[int, str]:
    """Depth maps in thousandths of the unit; what is further than 65.5 units away is unknown, and so is what a frame
    without a depth map shows."""
    written = {}
    with files.atomic_folder(folder / "export_depths") as partial:
        for frame in frames:
            depth = sequence.read_depth(frame)
            if depth is None:
                depth = np.zeros((frame.height, frame.width), np.float32)
            steps = np.rint(depth.astype(np.float64) / DEPTH_STEP)
            write_image(partial / f"{frame.frame:06d}.png", np.where(steps <= 65535, steps, 0).astype(np.uint16))
            written[frame.frame] = f"export_depths/{frame.frame:06d}.png"
    return written


def _write_points(sequence: Sequence, folder: Path) -> int:
    """The sparse points as points.ply; returns their number, and writes nothing where there are none."""
    model = colmap.read_model(sequence.sparse)
    if model.n_points:
        with files.atomic_path(folder / "points.ply") as partial:
            model.write_ply(partial)
    else:
        (folder / "points.ply").unlink(missing_ok=True)
    return model.n_points
