"""Depth of one view from one neighbour: rectify the pair, match it with semi-global matching, bring the depth back.

The rectifying rotations come from the baseline itself, so that it may point in any direction in the image. Only the
part of the view that matters is rectified, and the second image is shifted so that the disparities of the depths in
question start near 0: a small range is what makes matching fast.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Camera, Floats

MAX_DISPARITIES = 160  # levels, a multiple of 16; wider ranges are searched in smaller images, at little loss
BLOCK = 3  # px, side of the matched block
RANGE_MARGIN = 0.15  # of the inverse-depth range, added on either side: the sparse points miss the extremes
BORDER = 8  # px around the rectified region, so that its edge pixels have a neighbourhood

Box = tuple[int, int, int, int]  # x0, y0, x1, y1 in pixels, end exclusive
Depth = NDArray[np.float32]


@dataclass(frozen=True)
class View:
    """One view at working resolution.

    Attributes:
        camera: of the (distorted) image at working resolution.
        gray: (h, w) uint8.
        points: (M, 3) points in the world that the view sees; they set the range of depths that is searched.
        region: (h, w) bool, where depth is wanted; None = everywhere.
    """

    camera: Camera
    gray: NDArray[np.uint8]
    points: Floats
    region: NDArray[np.bool_] | None = None

    @property
    def box(self) -> Box:
        """The smallest box around the region; empty (0, 0, 0, 0) for an empty region."""
        if self.region is None:
            return 0, 0, self.camera.width, self.camera.height
        rows, columns = np.flatnonzero(self.region.any(axis=1)), np.flatnonzero(self.region.any(axis=0))
        if not len(rows):
            return 0, 0, 0, 0
        return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


@dataclass(frozen=True)
class Rectification:
    """Two pinhole views with parallel axes and a horizontal baseline that a pair of views is warped to.

    Attributes:
        R_first, R_second: (3, 3) rotations from each camera to the rectified axes (x along the baseline).
        focal_px: of both.
        cx_first, cx_second, cy: principal points in array indices (a pixel's centre is a whole number).
        width, height: of both images.
        baseline: length in the world's unit.
        levels: number of disparities to search, from 0; a multiple of 16.
    """

    R_first: Floats
    R_second: Floats
    focal_px: float
    cx_first: float
    cx_second: float
    cy: float
    width: int
    height: int
    baseline: float
    levels: int

    def disparity(self, depth: Floats) -> Floats:
        """Disparity x_first - x_second in px of a point at a rectified depth."""
        return self.focal_px * self.baseline / depth + (self.cx_first - self.cx_second)

    def depth(self, disparity: Floats) -> Floats:
        """Rectified depth of a disparity in px."""
        return self.focal_px * self.baseline / (disparity - (self.cx_first - self.cx_second))

    def maps(self, camera: Camera, *, second: bool) -> tuple[Depth, Depth]:
        """Where each rectified pixel lies in the image of `camera`: x and y in array indices, (height, width) each."""
        cx = self.cx_second if second else self.cx_first
        P = np.array([[self.focal_px, 0, cx], [0, self.focal_px, self.cy], [0, 0, 1]])
        R = self.R_second if second else self.R_first
        K = camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # +0.5 is the centre of index 0
        size = (self.width, self.height)
        map_x, map_y = cv2.initUndistortRectifyMap(K, camera.distortion, R, P, size, cv2.CV_32FC1)
        return np.asarray(map_x, np.float32), np.asarray(map_y, np.float32)


def rectify(first: Camera, second: Camera, box: Box, points: Floats) -> Rectification | None:
    """Rectify a pair for the part of the first view in `box`.

    Args:
        points: (M, 3) points of the world whose depths (2nd to 98th percentile, with a margin) set the disparities.

    Returns:
        None where the pair cannot be rectified (the baseline points into the view) or no point lies in front of it.
    """
    offset = second.centre - first.centre
    baseline = float(np.linalg.norm(offset))
    if baseline < 1e-12:
        return None
    x_axis = offset / baseline
    forward = first.direction + second.direction
    forward = forward - (forward @ x_axis) * x_axis
    if np.linalg.norm(forward) < 1e-3:
        return None
    z_axis = forward / np.linalg.norm(forward)
    axes = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis])
    R_first, R_second = axes @ first.R.T, axes @ second.R.T

    depths = (points - first.centre) @ z_axis
    depths = depths[depths > 0]
    rays = _outline_rays(first, box) @ R_first.T
    if len(depths) < 2 or rays[:, 2].min() < 0.2:  # an edge of the box more than 78 degrees off axis
        return None
    xy = rays[:, :2] / rays[:, 2:]

    # the scale that keeps areas at the centre of the box: rectifying stretches what is off axis by 1/cos^3
    centre = rays.mean(axis=0)
    cosine = float(centre[2] / np.linalg.norm(centre))
    focal = float(np.sqrt(first.K[0, 0] * first.K[1, 1])) * cosine**1.5
    far_inverse, near_inverse = np.percentile(1 / depths, [2, 98])
    margin = RANGE_MARGIN * (near_inverse - far_inverse) + 0.01 * near_inverse
    far_inverse, near_inverse = max(far_inverse - margin, 0.0), near_inverse + margin
    # a range too wide to search is searched in smaller images
    focal = min(focal, (MAX_DISPARITIES - 3) / (baseline * (near_inverse - far_inverse)))
    smallest = np.floor(focal * baseline * far_inverse) - 1
    span = focal * baseline * near_inverse - smallest + 1
    levels = int(np.ceil(span / 16)) * 16

    (left, top), (right, bottom) = focal * xy.min(axis=0), focal * xy.max(axis=0)
    # SGBM gives no disparity in its first `levels` columns: they are padding, and cost nothing
    cx = levels + BORDER - left
    return Rectification(
        R_first,
        R_second,
        focal,
        cx_first=cx,
        cx_second=cx + smallest,
        cy=BORDER - top,
        width=int(np.ceil(right - left)) + levels + 2 * BORDER,
        height=int(np.ceil(bottom - top)) + 2 * BORDER,
        baseline=baseline,
        levels=levels,
    )


def stereo_depth(first: View, second: View, box: Box) -> tuple[Depth, float] | None:
    """z-depth of the first view in `box` from its disparities to the second.

    Returns:
        Depth (y1 - y0, x1 - x0) on the first view's own, distorted pixel grid, 0 = unknown, and its weight: the
        inverse variance of the relative depth, up to a common factor. None where the pair cannot be rectified.
    """
    pair = rectify(first.camera, second.camera, box, first.points)
    if pair is None:
        return None
    maps_second = pair.maps(second.camera, second=True)
    left = _remap(first.gray, *pair.maps(first.camera, second=False), cv2.INTER_LINEAR)
    right = _remap(second.gray, *maps_second, cv2.INTER_LINEAR)
    disparity = match(left, right, pair.levels)

    x0, y0, x1, y1 = box
    rays = np.asarray(cv2.transform(pixel_rays(first.camera)[y0:y1, x0:x1], pair.R_first), np.float32)
    cosine = rays[..., 2]
    u = rays[..., 0] / cosine * np.float32(pair.focal_px) + np.float32(pair.cx_first)
    v = rays[..., 1] / cosine * np.float32(pair.focal_px) + np.float32(pair.cy)
    sampled = sample_within_surfaces(disparity, u, v, tolerance=np.float32(1.5))
    known = sampled > 0
    known &= _inside(maps_second, second.camera, u - sampled, v)
    scale = np.float32(pair.focal_px * pair.baseline)
    total = sampled + np.float32(pair.cx_second - pair.cx_first)
    known &= total > 0
    depth = np.where(known, scale / np.where(known, total * cosine, 1), 0).astype(np.float32)
    return depth, (pair.focal_px * pair.baseline) ** 2


def match(left: NDArray[np.uint8], right: NDArray[np.uint8], levels: int) -> Depth:
    """Sub-pixel disparity of the left of two rectified images (h, w); 0 = unknown (Hirschmueller, PAMI 2008)."""
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=levels,
        blockSize=BLOCK,
        P1=8 * BLOCK**2,
        P2=128 * BLOCK**2,
        disp12MaxDiff=1,  # px, between matching left to right and right to left
        preFilterCap=31,
        # ambiguous matches and speckles are left to the agreement between neighbours, which costs less coverage
        uniquenessRatio=0,
        speckleWindowSize=0,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    disparity = matcher.compute(left, right).astype(np.float32) / np.float32(16)
    # the first and last level have no neighbour to interpolate with: the true match may lie beyond them
    disparity[(disparity < 0.5) | (disparity > levels - 1.5)] = 0
    return disparity


def sample_within_surfaces(values: Depth, u: Depth, v: Depth, tolerance: float | np.floating) -> Depth:
    """Bilinear samples of `values` (0 = unknown) at array indices u, v; 0 where they would mix two surfaces.

    A sample whose four neighbours are not all known, or that differs from the nearest of them by more than
    `tolerance`, is unknown.
    """
    bilinear = _remap(values, u, v, cv2.INTER_LINEAR)
    nearest = _remap(values, u, v, cv2.INTER_NEAREST)
    smooth = (nearest > 0) & (np.abs(bilinear - nearest) <= tolerance)
    return np.where(smooth, bilinear, 0).astype(np.float32, copy=False)


def _remap(values: NDArray[Any], u: Depth, v: Depth, interpolation: int) -> NDArray[Any]:
    """`values` at array indices u, v; 0 outside."""
    return np.asarray(cv2.remap(values, u, v, interpolation))


@lru_cache(maxsize=8)
def _rays_of(width: int, height: int, intrinsics: bytes, distortion: bytes) -> Depth:
    K, coefficients = np.frombuffer(intrinsics).reshape(3, 3), np.frombuffer(distortion)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    camera = Camera(width, height, K, coefficients, np.eye(3), np.zeros(3))
    xy = camera.to_normalised(np.stack([x.ravel(), y.ravel()], axis=1)).astype(np.float32)
    rays = np.concatenate([xy, np.ones((len(xy), 1), np.float32)], axis=1).reshape(height, width, 3)
    rays.flags.writeable = False
    return rays


def pixel_rays(camera: Camera) -> Depth:
    """Rays (h, w, 3) = (X/Z, Y/Z, 1) through the pixel centres, in the camera's axes; shared by equal intrinsics."""
    K, distortion = np.asarray(camera.K, np.float64), np.asarray(camera.distortion, np.float64)
    return _rays_of(camera.width, camera.height, K.tobytes(), distortion.tobytes())


def _outline_rays(camera: Camera, box: Box) -> Floats:
    """Rays (N, 3) through points along the outline of a box."""
    x0, y0, x1, y1 = box
    along = np.linspace(0, 1, 9)
    x, y = x0 + along * (x1 - x0), y0 + along * (y1 - y0)
    sides = [np.stack(np.broadcast_arrays(a, b), axis=1) for a, b in ((x, y0), (x, y1), (x0, y), (x1, y))]
    xy = camera.to_normalised(np.concatenate(sides).astype(np.float64))
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)


def _inside(maps: tuple[Depth, Depth], camera: Camera, u: Depth, v: Depth) -> NDArray[np.bool_]:
    """Whether rectified positions fall on the image and not on the black around it."""
    inside = (maps[0] >= 0) & (maps[0] <= camera.width - 1) & (maps[1] >= 0) & (maps[1] <= camera.height - 1)
    return _remap(inside.astype(np.uint8), u, v, cv2.INTER_NEAREST) > 0
