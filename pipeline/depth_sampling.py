"""Depth between pixels, without inventing surfaces between an object and what is behind it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


class DepthSampler:
    """z-depth at any place of a depth map.

    Inside a 2x2 block of known depths that lie within `jump` of each other (relative), inverse depth is interpolated
    bilinearly, which is exact on planes; elsewhere the nearest pixel's depth is taken as it is, 0 = unknown.

    Args:
        depth: (h, w), at least 2 x 2, z-depth, 0 = unknown.
        jump: largest relative difference within one surface.
    """

    def __init__(self, depth: NDArray[np.float32], jump: float = 0.03) -> None:
        self.height, self.width = depth.shape
        known = depth > 0
        inverse = np.divide(1.0, depth, out=np.zeros(depth.shape, np.float32), where=known)
        corners = np.stack([inverse[:-1, :-1], inverse[:-1, 1:], inverse[1:, :-1], inverse[1:, 1:]])
        lowest = corners.min(axis=0)
        smooth = np.zeros(depth.shape, dtype=bool)
        smooth[:-1, :-1] = (lowest > 0) & (corners.max(axis=0) <= lowest * (1 + jump))
        self._inverse, self._smooth = inverse.ravel(), smooth.ravel()
        self._depth = np.ascontiguousarray(depth, dtype=np.float32).ravel()

    def __call__(self, x: Floats, y: Floats) -> NDArray[np.float32]:
        """Depth (N,) at pixels x, y (N,) (centres at +0.5) that lie inside the image."""
        x, y = x - np.float32(0.5), y - np.float32(0.5)
        left = np.floor(np.clip(x, 0, self.width - 2))
        top = np.floor(np.clip(y, 0, self.height - 2))
        a, b = np.clip(x - left, 0, 1), np.clip(y - top, 0, 1)  # the outermost half pixel repeats the border
        corner = top.astype(np.int32) * self.width + left.astype(np.int32)
        inverse = self._inverse
        upper = inverse[corner] * (1 - a) + inverse[corner + 1] * a
        lower = inverse[corner + self.width] * (1 - a) + inverse[corner + self.width + 1] * a
        blend = upper * (1 - b) + lower * b
        nearest = corner + (a >= 0.5) + (b >= 0.5) * self.width
        smooth = self._smooth[corner]
        return np.where(smooth, 1 / np.where(smooth, blend, 1), self._depth[nearest]).astype(np.float32)
