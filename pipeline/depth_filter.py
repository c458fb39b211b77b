"""Estimates of the same depth that must agree: within one view, and between views."""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Camera, Floats, relative_pose
from pipeline.stereo import Depth, pixel_rays


@dataclass(frozen=True)
class AgreementConfig:
    """When estimates of a depth are believed."""

    tolerance: float = 0.01
    """Two depths agree where they differ by less than this share."""
    min_estimates: int = 2
    """Neighbours whose estimates must agree within a view before its depth may confirm another view's."""
    min_support: int = 3
    """Agreeing estimates within the view plus other views that confirm them (at least one) that a depth needs."""
    min_island_px: int = 60
    """Smaller islands of depth are dropped."""


def fuse(estimates: NDArray[np.float32], weights: Ordered[float], tolerance: float) -> tuple[Depth, NDArray[np.uint8]]:
    """One depth from several estimates of it.

    Args:
        estimates: (K, h, w) depths, 0 = unknown.
        weights: K inverse variances.
        tolerance: relative.

    Returns:
        Depth (h, w): the weighted mean of the estimate with most others in agreement (of several, that of the largest
        weight) and those others; and how many agree (h, w), the estimate itself included, 0 where none is known.
    """
    share = np.asarray(weights, np.float32) / np.float32(np.sum(weights))
    known = estimates > 0
    count = known.astype(np.float32)
    weight = known * share[:, None, None]
    weighted = estimates * share[:, None, None]
    for k in range(len(estimates)):
        for other in range(k + 1, len(estimates)):
            a, b = estimates[k], estimates[other]
            agree = known[k] & known[other] & (np.abs(a - b) <= np.float32(tolerance) * np.minimum(a, b))
            count[k] += agree
            count[other] += agree
            weight[k] += agree * share[other]
            weight[other] += agree * share[k]
            weighted[k] += agree * (b * share[other])
            weighted[other] += agree * (a * share[k])
    best = np.argmax(count + np.float32(0.5) * weight, axis=0)[None]
    count, weight, weighted = (np.take_along_axis(values, best, axis=0)[0] for values in (count, weight, weighted))
    return weighted / np.maximum(weight, np.float32(1e-12)), count.astype(np.uint8)


def confirmations(
    camera: Camera, depth: Depth, others: Ordered[tuple[Camera, Depth]], tolerance: float
) -> NDArray[np.uint8]:
    """How many other depth maps confirm each depth of a view.

    Each depth is projected into each other view, where that view's own depth must be the same to `tolerance`
    (relative). For neighbours 6 to 12 degrees away 1% is about a pixel of forward-backward reprojection.

    Args:
        depth: (h, w) z-depth of `camera`, 0 = unknown.
        others: cameras with their depth maps (of the cameras' sizes).

    Returns:
        (h, w) counts.
    """
    count = np.zeros(depth.shape, np.uint8)
    rows, columns = np.nonzero(depth)
    if not len(rows):
        return count
    points = pixel_rays(camera)[rows, columns] * depth[rows, columns, None]
    agreeing = np.zeros(len(rows), np.uint8)
    for other, other_depth in others:
        R, t = relative_pose(camera, other)
        local = points @ R.T.astype(np.float32) + t.astype(np.float32)
        z = local[:, 2]
        front = z > 1e-9
        xy = local[:, :2] / np.where(front, z, 1)[:, None]
        seen = sample_pixels(other_depth, other.to_pixels(xy))
        agreeing += front & (np.abs(seen - z) <= np.float32(tolerance) * z)
    count[rows, columns] = agreeing
    return count


def sample_pixels(values: NDArray[Any], pixels: Floats) -> NDArray[Any]:
    """The value (N,) of the pixel of `values` (h, w) that each position (N, 2) falls in; 0 outside the image."""
    height, width = values.shape
    inside = (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    x, y = pixels[inside].astype(np.intp).T
    sampled = np.zeros(len(pixels), values.dtype)
    sampled[inside] = values[y, x]
    return sampled


def drop_islands(depth: Depth, smallest_px: int) -> Depth:
    """The depth without connected islands of fewer than `smallest_px` known pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats((depth > 0).astype(np.uint8), connectivity=4)
    keep = stats[:, cv2.CC_STAT_AREA] >= smallest_px
    keep[0] = False
    return np.where(keep[labels], depth, np.float32(0))
