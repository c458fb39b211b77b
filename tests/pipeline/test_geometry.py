"""Cameras against closed form and against OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipeline.geometry import (
    Camera,
    Similarity,
    epipolar_distance_px,
    fundamental,
    nearest_point_to_axes,
    relative_pose,
    rotation_angle_deg,
    similarity_between,
    viewing_angle_deg,
)

rng = np.random.default_rng(0)


def rotation(x: float, y: float, z: float) -> np.ndarray:
    return cv2.Rodrigues(np.array([x, y, z], dtype=np.float64))[0]


def camera(distortion=(0.0, 0.0, 0.0, 0.0), angle: float = 0.1) -> Camera:
    K = np.array([[500.0, 0, 321], [0, 510, 243], [0, 0, 1]])
    return Camera(640, 480, K, np.array(distortion), rotation(0.1, angle, -0.2), np.array([0.1, -0.2, 4.0]))


@pytest.mark.parametrize("distortion", [(0, 0, 0, 0), (-0.15, 0.04, 0.002, -0.001)])
def test_projection_is_opencvs_and_unprojection_undoes_it(distortion) -> None:
    view = camera(distortion)
    points = rng.uniform(-1, 1, (50, 3))
    pixels, depth = view.project(points)
    expected, _ = cv2.projectPoints(points, cv2.Rodrigues(view.R)[0], view.t, view.K, view.distortion)
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(depth, (points @ view.R.T + view.t)[:, 2])
    np.testing.assert_allclose(view.unproject(pixels, depth), points, atol=1e-6)


def test_pixel_centres_are_at_one_half() -> None:
    """An image twice as large shows the centre of its first 2x2 block where the small image's first pixel is."""
    view = camera()
    large = view.resized(1280, 960)
    point = view.unproject(np.array([[0.5, 0.5]]), np.array([3.0]))
    np.testing.assert_allclose(large.project(point)[0], [[1.0, 1.0]], atol=1e-9)


def test_a_similarity_moves_points_and_cameras_together() -> None:
    move = Similarity(2.5, rotation(0.3, -0.4, 1.0), np.array([1.0, 2.0, 3.0]))
    points = rng.uniform(-1, 1, (20, 3))
    before, depth = camera().project(points)
    after, depth_after = camera().transformed(move).project(move(points))
    np.testing.assert_allclose(after, before, atol=1e-9)
    np.testing.assert_allclose(depth_after, 2.5 * depth)
    found = similarity_between(points, move(points))
    np.testing.assert_allclose(found.s, move.s)
    np.testing.assert_allclose(found.A, move.A, atol=1e-9)
    np.testing.assert_allclose(found.b, move.b, atol=1e-9)


def test_epipolar_distance_is_zero_on_matches_and_counts_pixels_off_them() -> None:
    first, second = camera(), camera(angle=0.4)
    points = rng.uniform(-1, 1, (30, 3))
    x1, x2 = first.project(points)[0], second.project(points)[0]
    F = fundamental(first, second)
    np.testing.assert_allclose(epipolar_distance_px(F, x1, x2), 0, atol=1e-6)
    line = np.concatenate([x1, np.ones((30, 1))], axis=1) @ F.T
    off = x2 + 3 * line[:, :2] / np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    back = np.concatenate([off, np.ones((30, 1))], axis=1) @ F
    own = np.abs((back[:, :2] * x1).sum(1) + back[:, 2]) / np.linalg.norm(back[:, :2], axis=1)
    np.testing.assert_allclose(epipolar_distance_px(F, x1, off), (3 + own) / 2, atol=1e-6)


def test_angles() -> None:
    assert rotation_angle_deg(rotation(0, 0, np.radians(1e-5))) == pytest.approx(1e-5, rel=1e-6)
    assert rotation_angle_deg(rotation(0, np.pi, 0)) == pytest.approx(180)
    R, _ = relative_pose(camera(), camera(angle=0.4))
    np.testing.assert_allclose(R @ camera().R, camera(angle=0.4).R, atol=1e-12)
    first = Camera(1, 1, np.eye(3), np.zeros(4), np.eye(3), np.array([0, 0, 1.0]))  # centre (0, 0, -1)
    second = Camera(1, 1, np.eye(3), np.zeros(4), np.eye(3), np.array([1.0, 0, 0]))  # centre (-1, 0, 0)
    assert viewing_angle_deg(first, second, np.zeros(3)) == pytest.approx(90)


def test_the_point_that_an_orbit_looks_at() -> None:
    target, cameras = np.array([0.5, -1.0, 2.0]), []
    for angle in np.linspace(0, 4, 9):
        R = rotation(0.2, 0, 0) @ rotation(0, angle, 0)
        cameras.append(Camera(10, 10, np.eye(3), np.zeros(4), R, -R @ (target - 3 * R[2])))
    np.testing.assert_allclose(nearest_point_to_axes(cameras), target, atol=1e-9)
