"""Do two pictures of a pair agree about the surface? Exact renderers do, to within the interpolation of depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.correspond.depth_sampling import DepthSampler
from pipeline.geometry import Camera, Floats
from pipeline.render.scene import Picture

SAME_SURFACE = 0.005
"""Relative difference of depths up to which a place is taken to be visible in both views; with twice as much, places
just behind a round object's limb would be."""


@dataclass(frozen=True)
class Seen:
    """Pixels of view 1's object that view 2 sees as well.

    Attributes:
        pixels1: (N, 2) pixel centres in view 1, pixels2: (N, 2) where they are in view 2.
        points: (N, 3) places in the world.
        miss_px: (N,) distance in view 1 between the pixel and the place that view 2's depth gives for it.
        share: of view 1's object that is seen.
    """

    pixels1: Floats
    pixels2: Floats
    points: Floats
    miss_px: Floats
    share: float


def seen_by_both(one: Picture, camera1: Camera, two: Picture, camera2: Camera) -> Seen:
    """Lift the object's pixels of view 1 by its depth, project them into view 2 and lift them back by view 2's depth.

    X = R1^T (z1 K1^-1 (x1, y1, 1) - t1); (x2, y2) = pi(K2 (R2 X + t2)); z2(x2, y2) between pixels is interpolated on
    one surface; X' is lifted from there and projected into view 1. Visible in both is what lies in the image and on the
    object there, at a depth that differs by at most `SAME_SURFACE`.
    """
    rows, columns = np.nonzero(one.mask & (one.depth > 0))
    pixels = np.stack([columns, rows], axis=1) + 0.5
    points = camera1.unproject(pixels, one.depth[rows, columns].astype(np.float64))
    there, z = camera2.project(points)
    inside = (z > 0) & (there > 0).all(1) & (there < [camera2.width, camera2.height]).all(1)
    index = np.flatnonzero(inside)
    at = there[index].astype(np.intp)
    index = index[two.mask[at[:, 1], at[:, 0]]]
    found = DepthSampler(two.depth)(*there[index].T).astype(np.float64)
    same = np.abs(found - z[index]) <= SAME_SURFACE * found
    index, found = index[same], found[same]
    back, _ = camera1.project(camera2.unproject(there[index], found))
    miss: NDArray[np.floating] = np.linalg.norm(back - pixels[index], axis=1)
    return Seen(pixels[index], there[index], points[index], miss, len(index) / max(1, len(pixels)))
