"""Estimated cameras against reference cameras: rotations and positions, after the best similarity."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np

from dope.common import files
from dope.common.errors import BadInput
from pipeline.geometry import Camera, Floats, rotation_angle_deg, similarity_between
from pipeline.sequence import Frame

CAMERAS_REMEDY = "Write it again with the tool that it comes from"
"""What to do about a file of cameras that is damaged: it is the user's own."""


@dataclass(frozen=True)
class CameraErrors:
    """How far registered cameras are from the reference; NaN where too few frames are shared to say."""

    n_reference: int
    n_registered: int
    """Frames of the reference that have a camera."""
    relative_rotation_median_deg: float
    """Between each shared frame and the next one; needs no alignment."""
    relative_rotation_max_deg: float
    rotation_median_deg: float
    """After aligning the worlds by the camera centres (similarity)."""
    rotation_max_deg: float
    translation_median_percent: float
    """Distance of the aligned centres, in percent of the extent of the reference's centres."""
    translation_max_percent: float


def read_reference(path: Path) -> dict[str, Camera]:
    """Cameras of a `cameras.json`, by image name without suffix.

    The file: OpenCV convention; `frames` with name, width, height, fx, fy, cx, cy, dist (k1, k2, p1, p2), w2c_R, w2c_t.

    Raises:
        BadInput: not such a file; a frame lacks a field, or has one of a wrong shape.
    """
    cameras = {}
    content = files.read_json(path, remedy=CAMERAS_REMEDY)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise BadInput("has no list of `frames`", where=path)
    for number, row in enumerate(content["frames"]):
        try:
            K = np.array([[row["fx"], 0, row["cx"]], [0, row["fy"], row["cy"]], [0, 0, 1]], dtype=np.float64)
            distortion = np.zeros(4)
            distortion[: len(row["dist"])] = row["dist"]
            R = np.array(row["w2c_R"], dtype=np.float64).reshape(3, 3)
            t = np.array(row["w2c_t"], dtype=np.float64).reshape(3)
            cameras[str(row["name"])] = Camera(int(row["width"]), int(row["height"]), K, distortion, R, t)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise BadInput(f"frame {number} is not a camera ({type(error).__name__}: {error})", where=path) from error
    return cameras


def compare_cameras(frames: list[Frame], reference: dict[str, Camera]) -> CameraErrors:
    """Errors of the registered frames; frames and reference meet by `source_name` without its suffix.

    Args:
        frames: in the order in which neighbours are neighbouring views.
        reference: `read_reference`, or cameras of any other source, by name.
    """
    pairs = [
        (frame.camera, reference[name])
        for frame in frames
        if frame.registered and (name := PurePath(frame.source_name).stem) in reference
    ]
    nan = float("nan")
    if len(pairs) < 2:
        return CameraErrors(len(reference), len(pairs), nan, nan, nan, nan, nan, nan)
    R, R_true = (np.stack([pair[side].R for pair in pairs]) for side in (0, 1))
    relative = rotation_angle_deg(_steps(R) @ _steps(R_true).transpose(0, 2, 1))
    rotation = translation = np.array([nan])
    if len(pairs) >= 3:
        centres, centres_true = (np.stack([pair[side].centre for pair in pairs]) for side in (0, 1))
        align = similarity_between(centres, centres_true)
        rotation = rotation_angle_deg(R @ align.A.T @ R_true.transpose(0, 2, 1))
        extent = np.linalg.norm(np.ptp(centres_true, axis=0))
        translation = 100 * np.linalg.norm(align(centres) - centres_true, axis=1) / max(float(extent), 1e-12)
    values = [f(x) for x in (relative, rotation, translation) for f in (np.median, np.max)]
    return CameraErrors(len(reference), len(pairs), *(float(value) for value in values))


def _steps(R: Floats) -> Floats:
    """Rotations from each camera to the next, (N - 1, 3, 3)."""
    return R[1:] @ R[:-1].transpose(0, 2, 1)
