"""Small pictures for the page: frames and views as JPEG, masks as outlines, depth as colours."""

from __future__ import annotations

import base64
import math
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.sequence import Frame, Sequence, read_image

UNKNOWN = (150, 147, 145)
"""BGR of a pixel without depth: a grey that is quiet on white and on black."""
OUTLINE_SIDE = 160
"""Masks are traced at this size: finer outlines cannot be seen on a thumbnail."""
OUTLINE_DETAIL = 0.6
"""Pixels (of that size) by which an outline may be simplified."""


def encoded(image: NDArray[np.uint8], quality: int) -> str:
    """A BGR image as base64 JPEG."""
    parameters = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    ok, data = cv2.imencode(".jpg", image, parameters)
    if not ok:
        raise BadInput("a thumbnail could not be encoded")
    return base64.b64encode(data.tobytes()).decode()


def shrunk(image: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """The image with its longer side at most `side` pixels."""
    height, width = image.shape[:2]
    scale = side / max(height, width)
    if scale >= 1:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def thumbnail(path: Path, side: int, long_side: int) -> NDArray[np.uint8]:
    """An image file at most `side` pixels long; a JPEG is decoded at a fraction of its size where that will do.

    Args:
        long_side: longer side of the image in the file, pixels.
    """
    flags = cv2.IMREAD_COLOR
    for factor, reduced in (
        (8, cv2.IMREAD_REDUCED_COLOR_8),
        (4, cv2.IMREAD_REDUCED_COLOR_4),
        (2, cv2.IMREAD_REDUCED_COLOR_2),
    ):
        if long_side >= factor * side:
            flags = reduced
            break
    return shrunk(read_image(path, flags), side)


def inside(sequence: Sequence, name: str | None) -> Path:
    """The path of a file of the sequence. Raises `BadInput` where it leads out of its folder or is no file."""
    parts = PurePosixPath(name or "")
    if not name or parts.is_absolute() or ".." in parts.parts:
        raise BadInput(f"'{name}' is no file of this sequence", where=sequence.folder)
    path = sequence.folder / parts
    if not path.is_file():  # reading a pipe would wait for ever
        raise BadInput("no such file", where=path)
    return path


def mask_outline(sequence: Sequence, frame: Frame) -> str:
    """The object's mask as an SVG path in a 1000 x 1000 box stretched over the frame; empty where nothing is masked."""
    mask = read_image(inside(sequence, frame.mask), cv2.IMREAD_GRAYSCALE)
    small = shrunk(mask, OUTLINE_SIDE)
    contours, _ = cv2.findContours((small > 127).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    scale = np.array([1000 / small.shape[1], 1000 / small.shape[0]])
    paths = []
    for contour in contours:
        if cv2.contourArea(contour) >= 4:
            corners = cv2.approxPolyDP(contour, OUTLINE_DETAIL, closed=True)[:, 0]
            points = np.rint((corners + 0.5) * scale).astype(int)
            paths.append("M" + "L".join(f"{x} {y}" for x, y in points) + "Z")
    return "".join(paths)


def small_depth(sequence: Sequence, frame: Frame, side: int) -> NDArray[np.float32]:
    """A frame's z-depth (h, w) at most `side` pixels long, unblended: a mean over an edge is the depth of nothing."""
    values = read_image(inside(sequence, frame.depth), cv2.IMREAD_UNCHANGED)
    if values.ndim != 2:
        raise BadInput("is no depth map: it has colours", where=sequence.folder / str(frame.depth))
    if not math.isfinite(frame.depth_scale or 0.0):
        raise BadInput(f"its depth_scale is {frame.depth_scale}", where=sequence.folder / str(frame.depth))
    height, width = values.shape
    scale = min(1.0, side / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(values, size, interpolation=cv2.INTER_NEAREST)
    return np.asarray(small, dtype=np.float32) * np.float32(frame.depth_scale or 0.0)


def depth_range(depths: list[NDArray[np.float32]]) -> tuple[float, float]:
    """Nearest and farthest depth of the colours: the 1st and 99th percentile of what is known."""
    known = np.concatenate([depth[depth > 0] for depth in depths] or [np.zeros(0, np.float32)])
    if not len(known):
        return 0.0, 1.0
    near, far = (float(value) for value in np.quantile(known, (0.01, 0.99)))
    return near, max(far, near * 1.001 + 1e-9)


def depth_picture(depth: NDArray[np.float32], near: float, far: float) -> NDArray[np.uint8]:
    """Depth (h, w) as colours, bright = near, grey = unknown."""
    place = np.clip((far - depth) / (far - near), 0, 1)
    colours = cv2.applyColorMap(np.rint(place * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    colours[depth <= 0] = UNKNOWN
    return np.asarray(colours, dtype=np.uint8)
