"""Which frames are worth reconstructing: sharpness, texture, near-duplicates, and whether names follow the views."""

from __future__ import annotations

from collections.abc import Sequence as Row
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

GREY_PX = 512
"""Sharpness is measured at this long side, so that it does not depend on the camera's resolution."""
THUMBNAIL_PX = 64
"""Views are compared at this long side: sensor noise and compression average out, motion of the object does not."""


@dataclass(frozen=True)
class QualityConfig:
    """What makes a frame not worth keeping."""

    blur_relative: float = 0.3
    """A frame is blurred below this share of its neighbours' median sharpness."""
    blur_relative_photos: float = 0.15
    """The same for photos, where it is lower: each was taken on purpose, and neighbours may show other things."""
    blur_absolute: float = 1.0
    """... or below this sharpness (variance of the Laplacian, 8-bit grey, long side 512 px)."""
    neighbours: int = 4
    """Frames on either side that a frame's sharpness is compared to."""
    min_contrast: float = 3.0
    """Standard deviation of the grey levels (0-255) below which a frame shows nothing."""
    duplicate: float = 4.0
    """Near-duplicate: no part of the picture differs from a kept frame by more than so many grey levels (0-255)."""


@dataclass(frozen=True)
class Look:
    """What is remembered of a frame: `sharpness`, `contrast`, and a grey `thumbnail` (h, w) float32 of about 64 px."""

    sharpness: float
    contrast: float
    thumbnail: NDArray[np.float32]


def shrink(image: NDArray[np.uint8], long_side: int) -> NDArray[np.uint8]:
    """Resize by area so that the long side is `long_side` px; a smaller image is returned as it is."""
    height, width = image.shape[:2]
    scale = long_side / max(height, width)
    if scale >= 1:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def look_at(image: NDArray[np.uint8]) -> Look:
    """Measure a BGR image (height, width, 3). Sharpness is the variance of the Laplacian."""
    grey = np.asarray(cv2.cvtColor(shrink(image, GREY_PX), cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    sharpness = float(cv2.Laplacian(grey, cv2.CV_32F).var())
    thumbnail = np.asarray(shrink(grey, THUMBNAIL_PX), dtype=np.float32)
    thumbnail = np.asarray(cv2.GaussianBlur(thumbnail, (0, 0), 1.0), dtype=np.float32)
    return Look(round(sharpness, 4), round(float(thumbnail.std()), 4), thumbnail)


def difference(a: Look, b: Look) -> float:
    """The largest change of a part (1/16 of the long side) of the picture in grey levels, 0 for the same picture.

    A change of exposure over the whole picture is taken out first: flicker is not motion. An object that turns in
    front of a still background counts, since the largest and not the mean change is taken.
    """
    if a.thumbnail.shape != b.thumbnail.shape:
        return 255.0
    x, y = a.thumbnail, b.thumbnail
    dx, dy = x - x.mean(), y - y.mean()
    gain = float((dx * dy).sum() / max(float((dx * dx).sum()), 1e-6))
    # beyond a few per cent it is no longer flicker, and a free gain would explain real differences away
    residual = np.abs(np.clip(gain, 0.9, 1.1) * dx - dy).astype(np.float32)
    return float(cv2.blur(residual, (4, 4)).max())


def reasons_to_drop(
    looks: Row[Look], numbers: Row[int], config: QualityConfig, *, compare: Literal["last", "all"] = "last"
) -> list[str | None]:
    """Why each frame should be left out, or None.

    Args:
        looks: frames in order.
        numbers: what the frames are called in the reasons.
        compare: near-duplicates of the last kept frame only (video), or of any kept frame (photos).
    """
    sharpness = np.array([look.sharpness for look in looks])
    reasons: list[str | None] = []
    kept: list[int] = []
    for i, look in enumerate(looks):
        reason = None
        around = sharpness[max(0, i - config.neighbours) : i + config.neighbours + 1]
        share = look.sharpness / max(float(np.median(around)), 1e-9)
        if look.contrast < config.min_contrast:
            reason = f"no texture (grey levels vary by {look.contrast:.1f} of 255)"
        elif look.sharpness < config.blur_absolute:
            reason = f"blurred (sharpness {look.sharpness:.2g})"
        elif share < config.blur_relative:
            reason = f"blurred (sharpness {share:.2f} of neighbours' median)"
        else:
            for k in kept[-1:] if compare == "last" else kept:
                if difference(looks[k], look) < config.duplicate:
                    reason = f"near-duplicate of frame {numbers[k]}"
                    break
        if reason is None:
            kept.append(i)
        reasons.append(reason)
    return reasons


def neighbours_are_alike(looks: Row[Look], threshold: float = 0.75) -> bool:
    """True where neighbouring frames look more alike than others: the names follow the camera's way.

    The share of (neighbouring, other) pairs of pairs in which the neighbours correlate better (an area under the ROC
    curve: 0.5 for shuffled names) must reach `threshold`. Too strict only costs time in matching, too loose costs
    matches, hence well above chance. Fewer than 6 frames are not ordered.
    """
    shapes = {look.thumbnail.shape for look in looks}
    if len(looks) < 6 or len(shapes) != 1:
        return False
    views = np.stack([look.thumbnail.ravel() for look in looks]).astype(np.float64)
    views -= views.mean(0)  # what all views share (a still background) says nothing of their order
    views /= np.maximum(np.linalg.norm(views, axis=1, keepdims=True), 1e-9)
    alike = views @ views.T
    others = np.sort(alike[np.triu_indices(len(views), 3)])
    below = np.searchsorted(others, np.diag(alike, 1))
    return bool(below.mean() / len(others) >= threshold)
