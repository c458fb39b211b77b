"""Masks from COCO segmentations: run-length encodings, packed or as lists, and polygons."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput


def decode_segmentation(segmentation: Any, size: tuple[int, int]) -> NDArray[np.bool_]:
    """The mask (height, width) of a COCO segmentation (https://cocodataset.org/#format-data).

    pycocotools decodes it, but only after a check here: of runs that are too few or cut off it makes pixels from
    memory that is not its own.

    Args:
        size: (height, width) of polygons' image; a run-length encoding says its own.

    Raises:
        BadInput: it is malformed (without a file's name).
    """
    from pycocotools import mask as coco

    if isinstance(segmentation, list):
        encoding = coco.merge(coco.frPyObjects(_checked_polygons(segmentation), *size))
        return np.asarray(coco.decode(encoding) > 0)
    height, width = encoded_size(segmentation)
    counts = segmentation.get("counts")
    runs = _unpacked(counts) if isinstance(counts, str) else _listed(counts)
    total = int(runs.sum(dtype=object)) if (runs > height * width).any() else int(runs.sum())  # may pass 2^63
    if (runs < 0).any() or total != height * width:
        raise BadInput(f"its runs cover {total} pixels, its size {height}x{width} has {height * width}")
    if isinstance(counts, str):
        encoding = {"size": [height, width], "counts": counts.encode("ascii")}
    else:
        encoding = coco.frPyObjects({"size": [height, width], "counts": runs.tolist()}, height, width)
    return np.asarray(coco.decode(encoding) > 0)


def encoded_size(segmentation: Any) -> tuple[int, int]:
    """(height, width) that a run-length encoding says. Raises `BadInput` where it says none."""
    size = segmentation.get("size") if isinstance(segmentation, dict) else None
    if not isinstance(size, list) or len(size) != 2 or not all(type(side) is int and side > 0 for side in size):
        raise BadInput(f"has no size [height, width] ({size!r:.40})")
    return size[0], size[1]


def _unpacked(counts: str) -> NDArray[np.int64]:
    """The runs of a packed string: base 32 with a continuation bit, differences from the run before the last."""
    try:
        values = np.frombuffer(counts.encode("ascii"), np.uint8).astype(np.int64) - 48
    except UnicodeEncodeError:
        raise BadInput("its counts hold characters that no encoding has") from None
    if ((values < 0) | (values > 63)).any():
        raise BadInput("its counts hold characters that no encoding has")
    last = (values & 32) == 0
    if not len(values) or not last[-1]:
        raise BadInput("its counts are cut off")
    starts = np.concatenate([[0], np.flatnonzero(last)[:-1] + 1])
    digit = np.arange(len(values)) - np.repeat(starts, np.diff(np.append(starts, len(values))))
    if digit.max() > 6:
        raise BadInput("its counts hold a number that is too large")
    numbers = np.add.reduceat((values & 31) << 5 * digit, starts)
    negative = (values[last] & 16) > 0
    numbers = np.where(negative, numbers - (1 << 5 * (digit[last] + 1)), numbers)
    for first in (1, 2):
        numbers[first::2] = np.cumsum(numbers[first::2])
    return numbers


def _listed(counts: Any) -> NDArray[np.int64]:
    if not isinstance(counts, list) or not all(type(count) is int and 0 <= count < 2**31 for count in counts):
        raise BadInput("its counts are neither a packed text nor a list of whole numbers")
    return np.array(counts, dtype=np.int64)


def _checked_polygons(polygons: list[Any]) -> list[list[float]]:
    for polygon in polygons:
        numbers = isinstance(polygon, list) and all(type(value) in (int, float) for value in polygon)
        if not numbers or len(polygon) < 6 or len(polygon) % 2 or not np.isfinite(polygon).all():
            raise BadInput("has a polygon that is no list of x1, y1, x2, y2, x3, y3, ...")
        if np.abs(polygon).max() > 1e6:
            raise BadInput("has a polygon that lies far outside of its image")
    if not polygons:
        raise BadInput("has no polygons")
    return polygons
