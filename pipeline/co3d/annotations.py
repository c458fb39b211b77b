"""What CO3D says of a frame and of a sequence: rows of frame_annotations.jgz and sequence_annotations.jgz, checked.

The fields are those of CO3D's data_types.py. A row whose sequence and frame number are known is always kept: what is
wrong with it becomes its `problem`, which is why the frame will be dropped.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.json_stream import Element, Form, read_elements

DEFAULT_INTRINSICS = "ndc_norm_image_bounds"
"""What v1 means where it does not say; v2 always says "ndc_isotropic"."""
LARGEST_SIDE = 100_000
LARGEST_ELEMENT = 16 << 20
"""Characters of one row of a file; CO3D's have about a thousand."""


@dataclass(frozen=True)
class Viewpoint:
    """A camera in PyTorch3D's convention (x left, y up, row vectors: X_cam = X R + T), intrinsics in NDC.

    Attributes:
        R: 9 numbers, row-major; T: 3; focal_length and principal_point: 2 each (x, y).
        intrinsics_format: "ndc_norm_image_bounds" or "ndc_isotropic".
    """

    R: tuple[float, ...]
    T: tuple[float, ...]
    focal_length: tuple[float, ...]
    principal_point: tuple[float, ...]
    intrinsics_format: str


@dataclass(frozen=True)
class FrameAnnotation:
    """One frame. Paths are as given: relative to CO3D's root, and not to be trusted."""

    number: int
    timestamp: float | None = None
    image: str | None = None
    height: int | None = None
    width: int | None = None
    mask: str | None = None
    depth: str | None = None
    depth_scale: float | None = None
    depth_mask: str | None = None
    viewpoint: Viewpoint | None = None
    problem: str | None = None
    """Why the frame cannot be used, or None."""


@dataclass(frozen=True)
class SequenceAnnotation:
    """One sequence. A score that is null, NaN or not there is None."""

    name: str
    viewpoint_quality: float | None = None
    point_cloud_quality: float | None = None
    point_cloud: str | None = None


def read_rows(path: Path, form: Form = "list", keys: list[str] | None = None) -> Iterator[Element]:
    """The rows of one of CO3D's files, plain or gzipped; `keys` as in `read_elements`, which says what is raised."""
    return read_elements(path, form=form, largest=LARGEST_ELEMENT, remedy="Download the file again", keys=keys)


def parse_frame(row: Any) -> tuple[str, FrameAnnotation]:
    """The sequence's name and the frame of one row. Raises ValueError where the row does not even name its frame."""
    name, number = sequence_name(row), row.get("frame_number")
    if not isinstance(number, int) or isinstance(number, bool) or abs(number) > 2**31:
        raise ValueError("has no frame_number")
    image, depth, mask = (_part(row, key) for key in ("image", "depth", "mask"))
    path, size, scale = text_of(image.get("path")), image.get("size"), _number(depth.get("scale_adjustment"))
    height = width = viewpoint = problem = None
    if path is None:
        problem = "redacted (no image path)"
    elif not (isinstance(size, list) and len(size) == 2 and all(map(_is_side, size))):
        problem = "no image size"
    else:
        height, width = size
        try:
            viewpoint = parse_viewpoint(row.get("viewpoint"))
        except ValueError as error:
            problem = str(error)
    return name, FrameAnnotation(
        number,
        timestamp=_number(row.get("frame_timestamp")),
        image=path,
        height=height,
        width=width,
        mask=text_of(mask.get("path")),
        depth=text_of(depth.get("path")),
        depth_scale=scale,
        depth_mask=text_of(depth.get("mask_path")),
        viewpoint=viewpoint,
        problem=problem,
    )


def parse_viewpoint(value: Any) -> Viewpoint:
    """A viewpoint with finite numbers of the right counts. Raises ValueError."""
    if not isinstance(value, dict):
        raise ValueError("no viewpoint")
    R = value.get("R")
    rows = R if isinstance(R, list) and all(isinstance(r, list) for r in R) else []
    given = {
        "R": ([v for r in rows for v in r], 9),
        "T": (value.get("T"), 3),
        "focal_length": (value.get("focal_length"), 2),
        "principal_point": (value.get("principal_point"), 2),
    }
    numbers: dict[str, tuple[float, ...]] = {}
    for key, (values, count) in given.items():
        parsed = [_number(v) for v in values] if isinstance(values, list) else []
        if len(parsed) != count or None in parsed:
            raise ValueError(f"viewpoint without a finite {key}")
        numbers[key] = tuple(v for v in parsed if v is not None)
    kind = value.get("intrinsics_format")
    intrinsics_format = DEFAULT_INTRINSICS if kind is None else text_of(kind)
    if intrinsics_format is None:
        raise ValueError("viewpoint with a malformed intrinsics_format")
    return Viewpoint(**numbers, intrinsics_format=intrinsics_format[:100])


def parse_sequence(row: Any) -> SequenceAnnotation:
    """One row of sequence_annotations.jgz. Raises ValueError where it does not name its sequence."""
    name = sequence_name(row)
    cloud = _part(row, "point_cloud")
    return SequenceAnnotation(
        name,
        viewpoint_quality=_number(row.get("viewpoint_quality_score")),
        point_cloud_quality=_number(cloud.get("quality_score")),
        point_cloud=text_of(cloud.get("path")),
    )


def sequence_name(row: Any) -> str:
    """The name in a row of either file. Raises ValueError."""
    name = text_of(row.get("sequence_name")) if isinstance(row, dict) else None
    if name is None:
        raise ValueError("has no sequence_name" if isinstance(row, dict) else "is not an object")
    return name


def _part(row: dict[str, Any], key: str) -> dict[str, Any]:
    """A nested object; what is null, absent or something else has nothing in it."""
    value = row.get(key)
    return value if isinstance(value, dict) else {}


def text_of(value: Any) -> str | None:
    """A non-empty text that is valid Unicode, else None."""
    if not isinstance(value, str) or not value:
        return None
    try:
        value.encode()
    except UnicodeEncodeError:  # half of a surrogate pair, which JSON can hold and no file system
        return None
    return value


def _number(value: Any) -> float | None:
    """A finite number, else None."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _is_side(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 < value <= LARGEST_SIDE
