"""Cameras and the mathematics of two views. One convention everywhere.

OpenCV: x right, y down, z forward; X_cam = R X_world + t; pixel centres at +0.5 (the centre of the top-left pixel is
(0.5, 0.5)). Depth is z-depth: the third coordinate of X_cam, not the length of the ray. 0 = unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class Camera:
    """A calibrated, posed view.

    Attributes:
        width, height: image size in pixels.
        K: intrinsics 3x3 in pixels of that size (fx, fy, cx, cy; no skew).
        distortion: OpenCV's k1, k2, p1, p2 (zeros = pinhole).
        R: 3x3 rotation and t: 3 translation, world to camera.
    """

    width: int
    height: int
    K: Floats
    distortion: Floats
    R: Floats
    t: Floats

    @property
    def centre(self) -> Floats:
        """Position of the camera in the world, shape (3,)."""
        return -self.R.T @ self.t

    @property
    def direction(self) -> Floats:
        """Viewing direction in the world, unit, shape (3,)."""
        return self.R[2]

    @property
    def is_distorted(self) -> bool:
        return bool(np.any(self.distortion))

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """World points (N, 3) to pixels (N, 2) and z-depths (N,). Points behind the camera get negative depth."""
        local = points @ self.R.T + self.t
        depth = local[:, 2]
        xy = local[:, :2] / np.where(np.abs(depth) < 1e-12, 1e-12, depth)[:, None]
        return self.to_pixels(xy), depth

    def to_pixels(self, xy: Floats) -> Floats:
        """Undistorted normalised coordinates (N, 2), x = X/Z, to (distorted) pixels (N, 2)."""
        if self.is_distorted:
            k1, k2, p1, p2 = self.distortion
            x, y = xy[:, 0], xy[:, 1]
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * k2)
            xy = np.stack(
                [
                    x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                    y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
                ],
                axis=1,
            )
        return xy * self.K[[0, 1], [0, 1]] + self.K[:2, 2]

    def to_normalised(self, pixels: Floats) -> Floats:
        """Pixels (N, 2) to undistorted normalised coordinates (N, 2)."""
        if not len(pixels):
            return np.zeros((0, 2))
        if not self.is_distorted:
            return (pixels - self.K[:2, 2]) / self.K[[0, 1], [0, 1]]
        k1, k2, p1, p2 = self.distortion
        target = (np.asarray(pixels, dtype=np.float64) - self.K[:2, 2]) / self.K[[0, 1], [0, 1]]
        x, y = target.T
        for _ in range(50):  # the fixed point of the distortion model; OpenCV 4 and 5 name their solver differently
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * k2)
            next_x = (target[:, 0] - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial
            next_y = (target[:, 1] - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial
            change = max(np.abs(next_x - x).max(), np.abs(next_y - y).max())
            x, y = next_x, next_y
            if change < 1e-10:
                break
        return np.stack([x, y], axis=1)

    def unproject(self, pixels: Floats, depth: Floats) -> Floats:
        """Pixels (N, 2) with z-depths (N,) to world points (N, 3)."""
        xy = self.to_normalised(pixels)
        local = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) * np.asarray(depth)[:, None]
        return (local - self.t) @ self.R

    def resized(self, width: int, height: int) -> Camera:
        """The same view in an image of another size."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, width=width, height=height, K=scale @ self.K)

    def transformed(self, similarity: Similarity) -> Camera:
        """The same image of a world moved by `similarity`: X' = s A X + b. Depths scale by s."""
        R = self.R @ similarity.A.T
        return replace(self, R=R, t=similarity.s * self.t - R @ similarity.b)


@dataclass(frozen=True)
class Similarity:
    """X' = s A X + b with a rotation A (3, 3), a shift b (3,) and a scale s."""

    s: float
    A: Floats
    b: Floats

    def __call__(self, points: Floats) -> Floats:
        return self.s * points @ self.A.T + self.b


def similarity_between(source: Floats, target: Floats) -> Similarity:
    """Least-squares similarity from points (N, 3) to points (N, 3) (Umeyama, PAMI 1991)."""
    mean_s, mean_t = source.mean(0), target.mean(0)
    centred_s, centred_t = source - mean_s, target - mean_t
    U, D, Vt = np.linalg.svd(centred_t.T @ centred_s / len(source))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt)) or 1.0])
    A = (U * sign) @ Vt
    s = float((D * sign).sum() / max(centred_s.var(0).sum(), 1e-24))
    return Similarity(s, A, mean_t - s * A @ mean_s)


def relative_pose(first: Camera, second: Camera) -> tuple[Floats, Floats]:
    """R (3, 3), t (3,) with X_second = R X_first + t."""
    R = second.R @ first.R.T
    return R, second.t - R @ first.t


def rotation_angle_deg(R: Floats) -> Floats:
    """Angle of rotation matrices (..., 3, 3), degrees, accurate for small angles too."""
    R = np.asarray(R, dtype=np.float64)
    off = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    trace = np.trace(R, axis1=-2, axis2=-1)
    return np.degrees(np.arctan2(np.linalg.norm(off, axis=-1), trace - 1))


def viewing_angle_deg(first: Camera, second: Camera, target: Floats) -> float:
    """Angle at `target` (3,) between the directions to two cameras, degrees."""
    a, b = first.centre - target, second.centre - target
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def fundamental(first: Camera, second: Camera) -> Floats:
    """F (3, 3) with x2^T F x1 = 0 for undistorted pixels of the two views."""
    R, t = relative_pose(first, second)
    skew = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return np.linalg.inv(second.K).T @ skew @ R @ np.linalg.inv(first.K)


def epipolar_distance_px(F: Floats, pixels1: Floats, pixels2: Floats) -> Floats:
    """Symmetric epipolar distance (N,): the mean of the two point-to-line distances in pixels."""
    x1 = np.concatenate([pixels1, np.ones((len(pixels1), 1))], axis=1)
    x2 = np.concatenate([pixels2, np.ones((len(pixels2), 1))], axis=1)
    line2, line1 = x1 @ F.T, x2 @ F
    residual = np.abs((x2 * line2).sum(1))
    return 0.5 * (residual / np.linalg.norm(line2[:, :2], axis=1) + residual / np.linalg.norm(line1[:, :2], axis=1))


def nearest_point_to_axes(cameras: list[Camera]) -> Floats:
    """The point (3,) nearest to all optical axes in the least-squares sense: what an orbit looks at."""
    M, v = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras:
        P = np.eye(3) - np.outer(camera.direction, camera.direction)
        M += P
        v += P @ camera.centre
    return np.linalg.lstsq(M, v, rcond=None)[0]
