"""Agreement of depths against naive loops over pixels and against scenes in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.depth.depth_filter import confirmations, cross_check, drop_islands, fuse, sample_pixels
from pipeline.geometry import Camera

RNG = np.random.default_rng(0)


def fuse_one(values: list[float], weights: list[float], tolerance: float) -> tuple[float, int]:
    """The estimate with most others within the tolerance; of several, that whose group weighs most."""
    best = (0.0, 0.0, 0.0)
    for a in values:
        group = [(b, w) for b, w in zip(values, weights, strict=True) if b > 0 and abs(a - b) <= tolerance * min(a, b)]
        if a > 0:
            weight = sum(w for _, w in group)
            best = max(best, (len(group), weight, sum(b * w for b, w in group) / weight))
    return best[2], int(best[0])


def test_fused_depth_is_the_weighted_mean_of_the_largest_group() -> None:
    estimates = RNG.uniform(1, 1.06, (4, 9, 11)).astype(np.float32)
    estimates[RNG.uniform(size=estimates.shape) < 0.3] = 0
    estimates[:, 0, 0] = 0
    weights = [1.0, 2.5, 0.7, 1.8]
    depth, count = fuse(estimates, weights, 0.01)
    assert depth[0, 0] == 0 and count[0, 0] == 0
    for row, column in np.ndindex(9, 11):
        expected, agreeing = fuse_one(list(map(float, estimates[:, row, column])), weights, 0.01)
        assert count[row, column] == agreeing
        assert depth[row, column] == pytest.approx(expected, rel=1e-5)


def test_one_wild_estimate_does_not_move_the_fused_depth() -> None:
    estimates = np.array([2.0, 2.004, 9.0], np.float32).reshape(3, 1, 1)
    depth, count = fuse(estimates, [1.0, 1.0, 50.0], 0.01)
    assert count.item() == 2 and depth.item() == pytest.approx(2.002)


def plane_depth(camera: Camera, offset: float) -> np.ndarray:
    """z-depth (h, w) of the plane Z = offset of the world."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    xy = camera.to_normalised(np.stack([x.ravel(), y.ravel()], axis=1))
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ camera.R
    depth = (offset - camera.centre[2]) / rays[:, 2]
    return depth.reshape(camera.height, camera.width).astype(np.float32)


def camera_beside(shift: float, angle_deg: float) -> Camera:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    K = np.array([[100.0, 0, 42], [0, 98.0, 29], [0, 0, 1]])
    return Camera(80, 60, K, np.array([0.05, -0.04, 0.001, 0.002]), R, -R @ np.array([shift, 0, 0]))


def test_true_depths_are_confirmed_wherever_they_are_seen_and_wrong_ones_nowhere() -> None:
    camera, others = camera_beside(0, 0), [camera_beside(0.9, 7), camera_beside(-0.4, -16)]
    depth = plane_depth(camera, 4.0)
    maps = [(other, plane_depth(other, 4.0)) for other in others]
    counts = confirmations(camera, depth, maps, 0.01)

    x, y = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    points = camera.unproject(np.stack([x.ravel(), y.ravel()], axis=1), depth.ravel())
    expected = np.zeros(80 * 60, int)
    for other in others:
        pixels, _ = other.project(points)
        expected += ((pixels >= 0) & (pixels < [80, 60])).all(axis=1)
    # float32 rounding may decide for the other pixel within a hair of the border
    assert (counts.ravel() == expected).mean() > 0.999 and expected.min() == 0 and expected.max() == 2

    assert not confirmations(camera, depth * np.float32(1.02), maps, 0.01).any()
    assert confirmations(camera, depth * np.float32(1.02), maps, 0.03).any()


def test_occluded_and_unknown_depths_are_not_confirmed() -> None:
    camera, other = camera_beside(0, 0), camera_beside(0.5, 7)
    depth = plane_depth(camera, 4.0)
    nearer = plane_depth(other, 3.0)  # something stands before the plane there
    assert not confirmations(camera, depth, [(other, nearer)], 0.01).any()
    assert not confirmations(camera, depth, [(other, np.zeros_like(nearer))], 0.01).any()
    assert not confirmations(camera, np.zeros_like(depth), [(other, plane_depth(other, 4.0))], 0.01).any()
    behind = Camera(80, 60, other.K, other.distortion, np.diag([-1.0, 1, -1]), np.zeros(3))  # looks the other way
    assert not confirmations(camera, depth, [(behind, np.full_like(depth, -4.0))], 0.01).any()


def test_only_views_that_see_farther_all_around_a_place_speak_against_it() -> None:
    camera, other = camera_beside(0, 0), camera_beside(0.5, 7)
    depth, true, nearer = plane_depth(camera, 3.0), plane_depth(other, 4.0), plane_depth(other, 2.0)
    seen = confirmations(camera, depth, [(other, plane_depth(other, 3.0))], 0.01) > 0
    assert 0.5 < seen.mean() < 1
    against = cross_check(camera, depth, [(other, true)], 0.01, see_through=0.03).against
    assert not against[~seen].any()  # outside the other image
    inner = np.zeros_like(seen)
    inner[8:-8, 20:-20] = True
    assert (against[inner] == 1).all()
    assert not cross_check(camera, depth, [(other, true)], 0.01).against.any()
    assert not cross_check(camera, depth, [(other, nearer)], 0.01, see_through=0.03).against.any()
    assert not cross_check(camera, depth, [(other, true)], 0.01, see_through=0.4).against.any()
    # a wire before the plane: beside it there is no certainty, wherever it is one pixel thick
    wire = true.copy()
    wire[:, ::3] = plane_depth(other, 3.0)[:, ::3]
    assert not cross_check(camera, depth, [(other, wire)], 0.01, see_through=0.03).against.any()
    holes = true.copy()
    holes[::3] = 0
    assert not cross_check(camera, depth, [(other, holes)], 0.01, see_through=0.03).against.any()
    backwards = Camera(80, 60, other.K, other.distortion, np.diag([-1.0, 1, -1]), np.zeros(3))
    assert not cross_check(camera, depth, [(backwards, np.full_like(depth, 9.0))], 0.01, see_through=0.03).against.any()


def test_samples_are_those_of_the_pixel_that_holds_the_position() -> None:
    values = np.arange(1, 13).reshape(3, 4)
    pixels = np.array([[0.0, 0.0], [0.99, 0.5], [1.0, 0.5], [3.99, 2.99], [4.0, 1.0], [-0.1, 1.0], [1.0, 3.0]])
    assert sample_pixels(values, pixels).tolist() == [1, 1, 2, 12, 0, 0, 0]
    assert sample_pixels(values, np.full((2, 2), np.nan)).tolist() == [0, 0]


def test_small_islands_are_dropped() -> None:
    depth = np.zeros((20, 20), np.float32)
    depth[1:4, 1:4] = 2.0  # 9 pixels
    depth[8:12, 8:12] = 3.0  # 16 pixels
    depth[12, 12] = 5.0  # touches only diagonally
    kept = drop_islands(depth, 10)
    assert np.count_nonzero(kept) == 16 and (kept[8:12, 8:12] == 3.0).all()
    assert np.array_equal(drop_islands(depth, 1), depth)
    assert not drop_islands(np.zeros((5, 5), np.float32), 1).any()
    assert drop_islands(np.ones((5, 5), np.float32), 26).sum() == 0
