from __future__ import annotations

import numpy as np
import pytest

from pipeline.cameras.normalise import find_object, points_in_masks
from pipeline.geometry import Camera

K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
CENTRE, RADIUS = np.array([4.0, -2.0, 7.0]), 0.5


def look_at(position: np.ndarray, target: np.ndarray) -> Camera:
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0.0, -1.0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return Camera(640, 480, K, np.zeros(4), R, -R @ position)


def orbit(n: int, span_deg: float) -> list[Camera]:
    angles = np.radians(np.linspace(0, span_deg, n, endpoint=False))
    offsets = 2.5 * np.stack([np.cos(angles), np.sin(angles), 0.4 + 0 * angles], axis=1)
    return [look_at(CENTRE + offset, CENTRE) for offset in offsets]


def sphere(n: int = 2000) -> np.ndarray:
    rays = np.random.default_rng(0).normal(size=(n, 3))
    return CENTRE + RADIUS * rays / np.linalg.norm(rays, axis=1, keepdims=True)


def clutter(n: int = 3000) -> np.ndarray:
    """A room's walls far around, and outliers."""
    rays = np.random.default_rng(1).normal(size=(n, 3))
    return CENTRE + rays / np.linalg.norm(rays, axis=1, keepdims=True) * np.random.default_rng(2).uniform(4, 30, (n, 1))


def disk_mask(camera: Camera) -> np.ndarray:
    pixel, depth = camera.project(CENTRE[None])
    ys, xs = np.mgrid[:480, :640] + 0.5
    reach = K[0, 0] * RADIUS / np.sqrt(depth[0] ** 2 - RADIUS**2) + 2
    return (xs - pixel[0, 0]) ** 2 + (ys - pixel[0, 1]) ** 2 < reach**2


def test_with_masks_the_sphere_is_found_among_the_clutter():
    cameras = orbit(12, 360)
    found = find_object(np.concatenate([sphere(), clutter()]), cameras, [disk_mask(camera) for camera in cameras])
    assert found.method == "masks" and found.n_points == pytest.approx(2000, abs=60)
    np.testing.assert_allclose(found.centre, CENTRE, atol=0.03)
    assert found.radius == pytest.approx(RADIUS, rel=0.06)


def test_without_masks_too():
    found = find_object(np.concatenate([sphere(), clutter()]), orbit(12, 360), [None] * 12)
    np.testing.assert_allclose(found.centre, CENTRE, atol=0.05)
    assert found.radius == pytest.approx(RADIUS, rel=0.08)


def test_views_from_one_side_only():
    cameras = orbit(8, 60)
    points = sphere()
    towards = np.mean([camera.centre for camera in cameras], axis=0) - CENTRE
    seen = points[(points - CENTRE) @ towards > 0]
    found = find_object(np.concatenate([seen, clutter()]), cameras, [None] * 8)
    assert np.linalg.norm(found.centre - CENTRE) < 0.6 * RADIUS
    assert 0.5 * RADIUS < found.radius < 1.6 * RADIUS


def test_parallel_axes_fall_back_on_the_points():
    z = np.array([0.0, 0, 1])
    cameras = [Camera(640, 480, K, np.zeros(4), np.eye(3), -(CENTRE - 2.5 * z + [0.3 * i, 0, 0])) for i in range(-3, 4)]
    found = find_object(sphere(), cameras, [None] * 7)
    assert np.linalg.norm(found.centre - CENTRE) < 0.5 * RADIUS and 0.5 * RADIUS < found.radius < 2 * RADIUS


def test_the_similarity_puts_the_centre_at_zero_and_the_radius_at_one():
    found = find_object(sphere(), orbit(12, 360), [None] * 12)
    moved = found.similarity(sphere())
    assert np.linalg.norm(moved, axis=1) == pytest.approx(1, rel=0.1)
    camera = orbit(12, 360)[0]
    before, _ = camera.project(sphere())
    after, _ = camera.transformed(found.similarity).project(moved)
    np.testing.assert_allclose(before, after, atol=1e-6)


def test_a_point_must_lie_in_nearly_all_masks_and_be_seen_twice():
    cameras = orbit(12, 360)
    masks = [disk_mask(camera) for camera in cameras]
    in_front = cameras[0].centre * 0.5 + CENTRE * 0.5  # inside one mask, outside the others
    assert points_in_masks(np.stack([CENTRE, in_front]), cameras, list(masks)).tolist() == [True, False]
    assert points_in_masks(CENTRE[None], cameras[:1], list(masks[:1])).tolist() == [False]
    assert points_in_masks(CENTRE[None], cameras, [None] * 12).tolist() == [False]
