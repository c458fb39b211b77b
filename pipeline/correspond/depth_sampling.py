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
        self._smooth = smooth.ravel()
        self._depth = np.ascontiguousarray(depth, dtype=np.float32).ravel()
        # the four corners of a cell side by side: one gather instead of four
        self._corners = np.zeros((depth.size, 4), np.float32)
        self._corners.reshape(*depth.shape, 4)[:-1, :-1] = np.moveaxis(corners, 0, -1)

    def __call__(self, x: Floats, y: Floats) -> NDArray[np.float32]:
        """Depth (N,) at pixels x, y (N,) (centres at +0.5) that lie inside the image."""
        zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
        x, y = x - half, y - half
        left = np.floor(np.minimum(np.maximum(x, zero), np.float32(self.width - 2)))
        top = np.floor(np.minimum(np.maximum(y, zero), np.float32(self.height - 2)))
        # the outermost half pixel repeats the border
        a, b = (np.minimum(np.maximum(offset, zero), one) for offset in (x - left, y - top))
        cell = top.astype(np.int32) * self.width + left.astype(np.int32)
        upper_left, upper_right, lower_left, lower_right = self._corners.take(cell, axis=0).T
        upper = upper_left * (one - a) + upper_right * a
        lower = lower_left * (one - a) + lower_right * a
        inverse = upper * (one - b) + lower * b
        rough = np.flatnonzero(~self._smooth[cell])
        inverse[rough] = one
        depth = (one / inverse).astype(np.float32)
        nearest = cell[rough] + (a[rough] >= half) + (b[rough] >= half) * self.width
        depth[rough] = self._depth[nearest]
        return depth
