"""CO3D's own depth maps: 16-bit PNGs whose bits are half floats, times `scale_adjustment`, where a depth mask allows.

z-depth in the unit of the cameras. What is not a positive finite number is unknown.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from dope.common.errors import BadInput
from pipeline.co3d.annotations import FrameAnnotation
from pipeline.co3d.frames import read_inside, require_shape
from pipeline.co3d.sources import Co3dSource
from pipeline.co3d.tree import Category
from pipeline.depth.stereo import Depth
from pipeline.inputs.photos import decode
from pipeline.sequence import Frame


class Co3dDepths:
    """The depth maps of a sequence's frames, for `pipeline.depth.imported`."""

    unit: Literal["cameras", "unknown", "auto"] = "cameras"

    def __init__(self, source: Co3dSource, every: int, *, masked: bool = True) -> None:
        self.category = source.category
        self.annotations = source.frames(every)
        self.masked = masked

    def read(self, frame: Frame) -> Depth | None:
        """z-depth (h, w) float32 of a frame, 0 = unknown; None where CO3D has none for it. Raises BadInput."""
        return read_depth(self.category, self.annotations[frame.frame], masked=self.masked)


def read_depth(category: Category, annotation: FrameAnnotation, *, masked: bool = True) -> Depth | None:
    """z-depth (h, w) float32 in the cameras' unit, 0 = unknown; None where the annotation names no depth.

    Raises:
        BadInput: the file is absent, leads outside, is damaged or is no 16-bit PNG; a scale that is not positive; a
            depth mask of another size.
    """
    if annotation.depth is None:
        return None
    if annotation.depth_scale is None or annotation.depth_scale <= 0:
        raise BadInput(f"depth has no usable scale_adjustment ({annotation.depth_scale})")
    bits = _decode(category, annotation.depth, "depth")
    if bits.dtype != np.uint16 or bits.ndim != 2:
        raise BadInput(f"depth is no 16-bit PNG of one channel ({annotation.depth})")
    with np.errstate(over="ignore"):
        depth = np.ascontiguousarray(bits).view(np.float16).astype(np.float32) * np.float32(annotation.depth_scale)
    depth[~(np.isfinite(depth) & (depth > 0))] = 0
    require_shape((depth.shape[1], depth.shape[0]), (annotation.width or 0, annotation.height or 0), "depth")
    if masked and annotation.depth_mask is not None:
        mask = _decode(category, annotation.depth_mask, "depth mask")
        if mask.shape[:2] != depth.shape:
            raise BadInput(f"depth mask has not the size of the depth map ({annotation.depth_mask})")
        depth[(mask if mask.ndim == 2 else mask.max(axis=2)) == 0] = 0
    return depth


def _decode(category: Category, given: str, what: str) -> np.ndarray:
    data = read_inside(category, given, what)
    try:
        return decode(data, cv2.IMREAD_UNCHANGED)
    except BadInput as error:
        raise BadInput(f"{what} {error.what} ({given})") from error
