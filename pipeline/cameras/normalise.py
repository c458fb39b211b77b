"""The object's frame: the origin in its middle and its radius as the unit of length. Orientation stays free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Camera, Floats, Similarity, nearest_point_to_axes

MASK_HITS = 0.9  # a point of the object lies in its mask in (nearly) all views that contain it
MIN_POINTS = 30  # fewer points say nothing of a size


@dataclass(frozen=True)
class ObjectFrame:
    """Where the object is, and how that was found.

    Attributes:
        centre: (3,) middle of the object in the world's coordinates.
        radius: distance from the centre that holds nearly all of the object's points.
        n_points: number of sparse points taken as the object's.
        method: "masks", "optical axes" or "points".
    """

    centre: Floats
    radius: float
    n_points: int
    method: str

    @property
    def similarity(self) -> Similarity:
        """World to normalised world: the centre goes to 0, the radius to 1."""
        return Similarity(1 / self.radius, np.eye(3), -self.centre / self.radius)


def find_object(points: Floats, cameras: list[Camera], masks: list[NDArray[np.bool_] | None]) -> ObjectFrame:
    """Centre and radius of what the cameras look at.

    With masks, the object's points are those that lie inside the masks of (nearly) all views that contain them.
    Without, the object is taken to be near the point nearest to all optical axes, and within half the cameras'
    distance from it. Works for views from one side only: what the cameras do not see has no say.

    Args:
        points: (N, 3) sparse points, N > 0.
        cameras: the registered views.
        masks: a mask of each view's image, or None where it has none.
    """
    if any(mask is not None for mask in masks):
        inside = points[points_in_masks(points, cameras, masks)]
        if len(inside) >= MIN_POINTS:
            centre, radius = _middle_and_radius(inside)
            return ObjectFrame(centre, radius, len(inside), "masks")
    centre, method = _looked_at(points, cameras)
    distance = float(np.median([np.linalg.norm(camera.centre - centre) for camera in cameras]))
    near, target = points, centre
    for share in (0.7, 0.5, 0.5):
        candidates = points[np.linalg.norm(points - centre, axis=1) < share * distance]
        if len(candidates) < MIN_POINTS:
            break
        near = candidates
        # the axes may miss the object, and its seen surface lies to one side of its middle: halfway between them
        centre = (target + np.median(near, axis=0)) / 2
    radius = _radius(near, centre)
    radius = float(np.clip(radius, 0.05 * distance, 0.6 * distance)) if distance > 0 else radius
    return ObjectFrame(centre, radius, len(near), method)


def points_in_masks(
    points: Floats, cameras: list[Camera], masks: list[NDArray[np.bool_] | None], max_views: int = 40
) -> NDArray[np.bool_]:
    """Which points (N,) lie inside the masks of at least nine in ten of the views that contain them (two or more)."""
    hits, seen = np.zeros(len(points)), np.zeros(len(points))
    views = [(camera, mask) for camera, mask in zip(cameras, masks, strict=True) if mask is not None]
    for camera, mask in views[:: max(1, -(-len(views) // max_views))]:
        pixels, depth = camera.project(points)
        column, row = np.floor(pixels).astype(np.int64).T
        in_view = (depth > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        seen += in_view
        hits[in_view] += mask[row[in_view], column[in_view]]
    return (seen >= 2) & (hits >= MASK_HITS * seen)


def _middle_and_radius(points: Floats) -> tuple[Floats, float]:
    """Middle of the box that holds 96% of the points along each axis, and the distance that holds 95% of them."""
    low, high = np.percentile(points, [2, 98], axis=0)
    centre = (low + high) / 2
    return centre, _radius(points, centre)


def _radius(points: Floats, centre: Floats) -> float:
    return max(float(np.percentile(np.linalg.norm(points - centre, axis=1), 95)), 1e-9)


def _looked_at(points: Floats, cameras: list[Camera]) -> tuple[Floats, str]:
    """The point that the optical axes pass closest to, or the middle of the points where the axes do not meet."""
    target = nearest_point_to_axes(cameras)
    towards = np.stack([target - camera.centre for camera in cameras])
    distance = np.linalg.norm(towards, axis=1)
    cosine = (towards * np.stack([camera.direction for camera in cameras])).sum(1) / np.maximum(distance, 1e-12)
    depths = np.concatenate([camera.project(points)[1] for camera in cameras[:: max(1, len(cameras) // 20)]])
    depths = depths[depths > 0]
    # parallel axes meet anywhere: believe the meeting point only among the points, and in front of the cameras
    plausible = len(depths) and np.median(distance) < 2 * np.median(depths) and np.median(cosine) > np.cos(np.pi / 4)
    return (target, "optical axes") if plausible else (np.median(points, axis=0), "points")
