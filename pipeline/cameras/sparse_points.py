"""The points of a sparse reconstruction and the frames that observe them, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Floats


@dataclass(frozen=True)
class Tracks:
    """Which frame sees which point.

    Attributes:
        xyz: (N, 3) world coordinates.
        point_index, frame: (M,) int, one entry an observation: point `point_index[m]` is seen in frame `frame[m]`;
            sorted by point.
    """

    xyz: Floats
    point_index: NDArray[np.integer]
    frame: NDArray[np.integer]

    def __len__(self) -> int:
        return len(self.xyz)

    def longer_than(self, length: int) -> Tracks:
        """Only the observations of points that at least `length` frames observe."""
        lengths = np.bincount(self.point_index, minlength=len(self.xyz))
        keep = lengths[self.point_index] >= length
        return Tracks(self.xyz, self.point_index[keep], self.frame[keep])

    def seen_by(self, frame: int) -> Floats:
        """The points (M, 3) that a frame observes."""
        return self.xyz[self.point_index[self.frame == frame]]


@dataclass(frozen=True)
class SparsePoints(Tracks):
    """The triangulated points of a model.

    Attributes:
        rgb: (N, 3) uint8.
        error: (N,) mean reprojection error, pixels of the stored image.
    """

    rgb: NDArray[np.uint8]
    error: NDArray[np.float64]
