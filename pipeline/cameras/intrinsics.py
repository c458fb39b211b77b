"""What is known of the lens before reconstruction: from the command line, from EXIF, or nothing."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING

from dope.common.errors import BadInput, UsageError
from pipeline.cameras.colmap import CameraModel, Lens
from pipeline.inputs.exif import focal_from_35mm
from pipeline.sequence import Frame

if TYPE_CHECKING:
    from pipeline.cameras.config import SfmConfig

INTRINSICS = "fx,fy,cx,cy[,k1,k2,p1,p2]"
DISTORTION_TERMS: dict[CameraModel, int] = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 0,
    "SIMPLE_RADIAL": 1,
    "RADIAL": 2,
    "OPENCV": 4,
}
ONE_FOCAL: frozenset[CameraModel] = frozenset({"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"})


def parse_intrinsics(text: str) -> list[float]:
    """Numbers of `fx,fy,cx,cy[,k1,k2,p1,p2]`. Raises `UsageError` where they are no numbers."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(f"'{text}' is not {INTRINSICS}", where="--intrinsics") from None


def check_intrinsics(values: Sequence[float], model: CameraModel) -> None:
    """Raise `UsageError` for intrinsics that no camera has, or that the camera model cannot hold."""
    where, n = "intrinsics", len(values)
    if n not in (4, 5, 6, 8):
        raise UsageError(f"{n} numbers instead of {INTRINSICS} (4, 5, 6 or 8)", where=where)
    if not all(map(math.isfinite, values)):
        raise UsageError("a value is not finite", where=where)
    if min(values[:2]) <= 0 or min(values[2:4]) < 0:
        raise UsageError(
            "focal lengths must be above 0, and the principal point is in pixels from the image's corner", where=where
        )
    if max(values[:2]) < 10:
        raise UsageError(
            f"a focal length of {max(values[:2]):g} pixels is none",
            where=where,
            remedy="Give pixels of the source image, not multiples of its size; in millimetres, use focal_mm",
        )
    if model in ONE_FOCAL and values[0] != values[1]:
        raise UsageError(f"{model} has one focal length, not fx and fy", where=where, remedy="Use PINHOLE or OPENCV")
    if any(values[4 + DISTORTION_TERMS[model] :]):
        raise UsageError(f"{model} has no room for these distortion terms", where=where, remedy="Use OPENCV")


def starting_lenses(frames: list[Frame], config: SfmConfig) -> list[Lens]:
    """The cameras to start from: one for all frames of a size and EXIF focal length, or one a frame.

    Raises:
        BadInput: known intrinsics do not fit the images.
    """
    groups: dict[tuple[int, int, float | None], list[Frame]] = defaultdict(list)
    for frame in frames:
        groups[frame.width, frame.height, frame.focal_px_prior if config.exif_focal else None].append(frame)
    _join_unknown(groups)
    found = []
    for (width, height, exif), members in groups.items():
        focal, params = _known(config, width, height, exif), _params(config, members)
        split = [members] if config.share_camera else [[frame] for frame in members]
        for part in split:
            names = tuple(PurePath(str(frame.image)).name for frame in part)
            found.append(Lens(names, width, height, config.lens_model, focal, params))
    return found


def _join_unknown(groups: dict[tuple[int, int, float | None], list[Frame]]) -> None:
    """Frames without EXIF belong to the camera that took most frames of their size."""
    for key in [key for key in groups if key[2] is None]:
        same = Counter({other: len(groups[other]) for other in groups if other[:2] == key[:2] and other != key})
        if same:
            usual = same.most_common(1)[0][0]
            groups[usual] = sorted(groups[usual] + groups.pop(key), key=lambda frame: frame.frame)


def _known(config: SfmConfig, width: int, height: int, exif: float | None) -> float | None:
    if config.focal_factor is not None:
        return config.focal_factor * max(width, height)
    if config.focal_mm is not None:
        focal = focal_from_35mm(config.focal_mm, width, height)
        if focal is None:
            raise BadInput(f"no lens has {config.focal_mm:g} mm on 35 mm film", where="sfm.focal_mm")
        return focal
    return exif


def _params(config: SfmConfig, frames: list[Frame]) -> tuple[float, ...] | None:
    """Known intrinsics in COLMAP's order, scaled from the source image to the stored one."""
    if config.intrinsics is None:
        return None
    first = frames[0]
    source = (first.source_width or first.width, first.source_height or first.height)
    fx, fy, cx, cy, *distortion = config.intrinsics
    if cx > source[0] or cy > source[1]:
        raise BadInput(
            f"the principal point ({cx:g}, {cy:g}) lies outside the image of {source[0]}x{source[1]} pixels",
            where="sfm.intrinsics",
            remedy="They must be those of the source images as they are, upright, before any resizing",
        )
    x, y = first.width / source[0], first.height / source[1]
    focal = (fx * (x + y) / 2,) if config.lens_model in ONE_FOCAL else (fx * x, fy * y)
    terms = DISTORTION_TERMS[config.lens_model]
    return (*focal, cx * x, cy * y, *(distortion + [0.0] * 4)[:terms])
