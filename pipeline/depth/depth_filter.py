"""Estimates of the same depth that must agree: within one view, and between views."""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.depth.stereo import Depth, pixel_rays
from pipeline.geometry import Camera, Floats, relative_pose


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
    min_contradictions: int = 2
    """Views that must look through a depth of PatchMatch or another tool before it is removed; they must be more than
    those that confirm it."""
    see_through: float = 0.03
    """A view looks through a point where all that it sees there lies farther behind it than this share."""


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
    """How many other depth maps (h, w) confirm each depth of a view, see `cross_check`."""
    return cross_check(camera, depth, others, tolerance).confirming


@dataclass(frozen=True)
class CrossCheck:
    """How many other views confirm each depth (h, w) of a view, and how many speak against it by looking through it."""

    confirming: NDArray[np.uint8]
    against: NDArray[np.uint8]


def cross_check(
    camera: Camera,
    depth: Depth,
    others: Ordered[tuple[Camera, Depth]],
    tolerance: float,
    see_through: float | None = None,
) -> CrossCheck:
    """What other depth maps say of each depth of a view.

    Each depth is projected into each other view. That view confirms it where its own depth is the same to `tolerance`
    (relative); for neighbours 6 to 12 degrees away 1% is about a pixel of forward-backward reprojection. It looks
    through it where all of the 3x3 pixels around the place lie farther behind than the share `see_through`: a
    pixel beside an edge says nothing. Where it sees something nearer, or nothing that is known, it says nothing either.

    Args:
        depth: (h, w) z-depth of `camera`, 0 = unknown.
        others: cameras with their depth maps (of the cameras' sizes).
        see_through: None: only confirmations are counted.
    """
    confirming, against = np.zeros(depth.shape, np.uint8), np.zeros(depth.shape, np.uint8)
    if not depth.any():
        return CrossCheck(confirming, against)
    x0, y0, width, height = cv2.boundingRect((depth > 0).astype(np.uint8))
    box = slice(y0, y0 + height), slice(x0, x0 + width)
    points = pixel_rays(camera)[box] * depth[box][..., None]
    for other, other_depth in others:
        u, v, z = _project_indices(points, camera, other)
        seen = cv2.remap(other_depth, u, v, cv2.INTER_NEAREST)
        confirming[box] += np.abs(seen - z) <= np.float32(tolerance) * z
        if see_through is not None:
            # the border counts as unknown
            nearest = cv2.erode(other_depth, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
            behind = cv2.remap(nearest, u, v, cv2.INTER_NEAREST) > np.float32(1 + see_through) * z
            against[box] += behind & (z > 0)
    known = depth > 0
    return CrossCheck(confirming * known, against * known)


def _project_indices(points: Depth, camera: Camera, other: Camera) -> tuple[Depth, Depth, Depth]:
    """Points (h, w, 3) in one camera's axes to array indices u, v and z-depths (h, w) of another.

    This is `Camera.project` in float32 and plane by plane, ten times faster.
    """
    R, t = relative_pose(camera, other)
    matrix = np.concatenate([R, t[:, None]], axis=1).astype(np.float32)
    x, y, z = (np.asarray(plane, np.float32) for plane in cv2.split(cv2.transform(points, matrix)))
    front = np.maximum(z, np.float32(1e-9))
    # what lies outside the image stays just outside: farther out, distortion may fold back into it
    rays = pixel_rays(other)
    outline = np.concatenate([rays[0], rays[-1], rays[:, 0], rays[:, -1]])[:, :2]
    beyond = 2 / other.K[[0, 1], [0, 1]]
    (left, top), (right, bottom) = outline.min(axis=0) - beyond, outline.max(axis=0) + beyond
    x = np.clip(x / front, np.float32(left), np.float32(right))
    y = np.clip(y / front, np.float32(top), np.float32(bottom))
    if other.is_distorted:
        k1, k2, p1, p2 = (np.float32(value) for value in other.distortion)
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        radial = 1 + r2 * (k1 + r2 * k2)
        x = x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx)
        y = y * radial + p1 * (r2 + 2 * yy) + 2 * p2 * xy
    K = other.K
    u = x * np.float32(K[0, 0]) + np.float32(K[0, 2] - 0.5)
    v = y * np.float32(K[1, 1]) + np.float32(K[1, 2] - 0.5)
    return u, v, z


def drop_contradicted(
    cameras: Ordered[Camera],
    depths: Ordered[Depth | None],
    witnesses_of: Ordered[Ordered[int]],
    config: AgreementConfig,
) -> tuple[list[Depth | None], dict[str, float | None]]:
    """Depth maps without what several other views look through; what no other view sees stays.

    Args:
        witnesses_of: for each view, the indices of the views that are asked.

    Returns:
        The depth maps, and `confirmed_share` and `contradicted_share` of the pixels that had depth.
    """
    kept: list[Depth | None] = []
    total = confirmed = removed = 0
    for camera, depth, nearby in zip(cameras, depths, witnesses_of, strict=True):
        if depth is None:
            kept.append(None)
            continue
        others = [(cameras[j], other) for j in nearby if (other := depths[j]) is not None]
        found = cross_check(camera, depth, others, config.tolerance, config.see_through)
        wrong = (found.against >= config.min_contradictions) & (found.confirming < found.against)
        total, removed = total + int((depth > 0).sum()), removed + int(wrong.sum())
        confirmed += int((found.confirming > 0).sum())
        kept.append(np.where(wrong, np.float32(0), depth))
    counts = {"confirmed_share": confirmed, "contradicted_share": removed}
    return kept, {name: round(count / total, 5) if total else None for name, count in counts.items()}


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
