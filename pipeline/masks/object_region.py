"""Where the object is, from sparse points: which of them are on it, what it stands on, and its ball's silhouette.

All in the frame of a normalised sequence: the object lies around the origin, its radius is about 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dope.common.seeds import generator
from pipeline.geometry import Camera, Floats


@dataclass(frozen=True)
class Plane:
    """What the object stands on: height(X) = normal . X + offset is positive on the cameras' side."""

    normal: Floats
    offset: float

    def height(self, points: Floats) -> Floats:
        """Signed distance of points (N, 3)."""
        return points @ self.normal + self.offset


def support_plane(points: Floats, cameras: list[Camera], *, tolerance: float = 0.03, trials: int = 400) -> Plane | None:
    """The table or floor under the object, or None where the points (N, 3) show none.

    RANSAC (Fischler and Bolles, 1981) over planes that have the cameras on one side. It counts only if it holds
    a tenth of the points near the object, goes on beyond the object, and has next to nothing beneath it: a flat side
    of the object itself fails the last two.
    """
    radius = np.linalg.norm(points, axis=1)
    near = points[radius < 3]
    if len(near) < 30:
        return None
    rng = generator("support plane")
    if len(near) > 4000:
        near = near[np.sort(rng.choice(len(near), 4000, replace=False))]
    near_radius = np.linalg.norm(near, axis=1)
    outer, inner = near_radius > 1, near_radius < 1
    centres = np.stack([camera.centre for camera in cameras])
    best, best_score = None, 0.0
    for triple in rng.integers(0, len(near), (trials, 3)):
        a, b, c = near[triple]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-6:
            continue
        normal = normal / length
        side = np.sign(np.median((centres - a) @ normal)) or 1.0
        plane = Plane(normal * side, float(-side * (normal @ a)))
        if (plane.height(centres) < 0).mean() > 0.05:
            continue
        height = plane.height(near)
        on_it = np.abs(height) < tolerance
        beyond = int((on_it & outer).sum())
        score = min(float(on_it.sum()), 3.0 * beyond)
        if score <= best_score:
            continue
        beneath = float((height[inner] < -2 * tolerance).mean()) if inner.any() else 1.0
        if on_it.mean() > 0.1 and beyond > 0.2 * on_it.sum() and beneath < 0.1:
            best, best_score = plane, score
    return best


def points_on_object(
    points: Floats, plane: Plane | None, *, radius: float, tolerance: float = 0.04
) -> NDArray[np.bool_]:
    """Which points (N, 3) lie within `radius` of the origin and above the support."""
    on_object = np.linalg.norm(points, axis=1) < radius
    if plane is not None:
        on_object &= plane.height(points) > tolerance
    return np.asarray(on_object)


def ball_silhouette(camera: Camera, radius: float) -> NDArray[np.bool_]:
    """The pixels (height, width) whose ray passes within `radius` of the origin, in front of the camera."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    xy = camera.to_normalised(np.stack([columns.ravel(), rows.ravel()], axis=1))
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ camera.R
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    along = -rays @ camera.centre
    distance2 = camera.centre @ camera.centre - along**2
    inside = (distance2 < radius**2) & (along > 0)
    if camera.centre @ camera.centre < radius**2:
        inside[:] = True
    return inside.reshape(camera.height, camera.width)


def pixels_of(points: Floats, camera: Camera) -> NDArray[np.int64]:
    """(row, column) of the points (N, 3) that lie in the image, shape (M, 2)."""
    pixels, depth = camera.project(points)
    inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
    return np.floor(pixels[inside]).astype(np.int64)[:, ::-1]
