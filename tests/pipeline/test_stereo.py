"""Rectification against projections in closed form; matching and depth against rendered scenes whose depth is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from synthetic import Scene, look_at, pixel_centres

from pipeline.depth.stereo import (
    MAX_DISPARITIES,
    View,
    match,
    pixel_rays,
    rectify,
    sample_within_surfaces,
    stereo_depth,
)
from pipeline.geometry import Camera

DISTORTION = (0.06, -0.09, 0.002, -0.001)
SIZE = (200, 160)


def camera_at(azimuth_deg: float, elevation_deg: float, *, roll_deg: float = 0.0, distance: float = 4.0) -> Camera:
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    ray = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    R, t = look_at(ray * distance, np.array([0.05, 0.1, -0.05]), roll_deg=roll_deg)
    K = np.array([[240.0, 0, 103.3], [0, 243.0, 77.6], [0, 0, 1]])
    return Camera(*SIZE, K, np.array(DISTORTION), R, t)


PAIRS = {
    "to the right": (camera_at(0, 20), camera_at(9, 20)),
    "to the left": (camera_at(0, 20), camera_at(-9, 22)),
    "upwards": (camera_at(0, 20), camera_at(0, 29)),
    "downwards, rolled": (camera_at(0, 20, roll_deg=35), camera_at(1, 12, roll_deg=-20)),
    "upside down": (camera_at(0, 20, roll_deg=180), camera_at(8, 20)),
    "farther away": (camera_at(0, 20), camera_at(8, 20, distance=4.6)),
}


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.8, 0.8, (300, 3))


@pytest.mark.parametrize("name", PAIRS)
def test_rectified_points_lie_on_one_row_at_the_disparity_of_their_depth(name: str, points: np.ndarray) -> None:
    first, second = PAIRS[name]
    pair = rectify(first, second, (0, 0, *SIZE), points)
    assert pair is not None
    ends = []
    for camera, R, cx in ((first, pair.R_first, pair.cx_first), (second, pair.R_second, pair.cx_second)):
        assert np.allclose(R @ R.T, np.eye(3)) and np.linalg.det(R) > 0
        local = (points @ camera.R.T + camera.t) @ R.T
        ends.append((pair.focal_px * local[:, 0] / local[:, 2] + cx, pair.focal_px * local[:, 1] / local[:, 2]))
        depth = local[:, 2]
    (x1, y1), (x2, y2) = ends
    assert np.allclose(y1, y2, atol=1e-9)
    assert np.allclose(pair.disparity(depth), x1 - x2) and np.allclose(pair.depth(x1 - x2), depth)
    middle = np.abs(x1 - x2 - np.median(x1 - x2)) <= np.percentile(np.abs(x1 - x2 - np.median(x1 - x2)), 90)
    assert (x1 - x2)[middle].min() > 0.5 and (x1 - x2)[middle].max() < pair.levels - 1.5
    assert pair.levels % 16 == 0 and pair.levels <= MAX_DISPARITIES


@pytest.mark.parametrize("name", PAIRS)
def test_maps_lead_to_the_pixel_that_the_distorted_camera_sees(name: str, points: np.ndarray) -> None:
    first, second = PAIRS[name]
    pair = rectify(first, second, (0, 0, *SIZE), points)
    assert pair is not None
    for camera, R, cx, is_second in (
        (first, pair.R_first, pair.cx_first, False),
        (second, pair.R_second, pair.cx_second, True),
    ):
        map_x, map_y = pair.maps(camera, second=is_second)
        local = (points @ camera.R.T + camera.t) @ R.T
        u = (pair.focal_px * local[:, 0] / local[:, 2] + cx).astype(np.float32)
        v = (pair.focal_px * local[:, 1] / local[:, 2] + pair.cy).astype(np.float32)
        inside = (u > 0) & (v > 0) & (u < pair.width - 1) & (v < pair.height - 1)
        assert inside.mean() > 0.9
        found = [cv2.remap(m, u, v, cv2.INTER_LINEAR).ravel() + 0.5 for m in (map_x, map_y)]
        expected, _ = camera.project(points)
        assert np.abs(np.stack(found, axis=1) - expected)[inside].max() < 0.05


def test_the_searched_disparities_are_bounded_even_for_extreme_ranges(points: np.ndarray) -> None:
    first, second = PAIRS["to the right"]
    deep = np.concatenate([points, first.centre + (points - first.centre) * 0.12, points * 30])
    pair = rectify(first, second, (0, 0, *SIZE), deep)
    assert pair is not None and pair.levels <= MAX_DISPARITIES
    assert pair.focal_px < first.K[0, 0]  # searched in smaller images


def test_pairs_without_a_sideways_baseline_are_refused(points: np.ndarray) -> None:
    first = camera_at(0, 20)
    ahead = replace(first, t=first.t - np.array([0, 0, 0.5]))
    assert rectify(first, first, (0, 0, *SIZE), points) is None
    assert rectify(first, ahead, (0, 0, *SIZE), points) is None
    behind = first.centre - 2 * (points - first.centre)
    assert rectify(first, camera_at(9, 20), (0, 0, *SIZE), behind) is None


def test_matching_finds_fractions_of_a_pixel() -> None:
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (120, 800)), (0, 0), 2.5)
    texture = (texture - texture.min()) / np.ptp(texture) * 255
    x, y = np.meshgrid(np.arange(260, dtype=np.float32), np.arange(120, dtype=np.float32))
    shift = np.where(y < 60, 7.25, 21.75).astype(np.float32)
    left, right = (
        cv2.remap(texture, 2 * x + 100, y, cv2.INTER_CUBIC).astype(np.uint8),
        cv2.remap(texture, 2 * (x + shift) + 100, y, cv2.INTER_CUBIC).astype(np.uint8),
    )
    disparity = match(left, right, 48)
    assert (disparity[:, :48] == 0).all()
    inner = disparity[:, 56:-8]
    error = np.abs(inner - shift[:, 56:-8])[inner > 0]
    assert (inner > 0).mean() > 0.9
    assert np.median(error) < 0.25 and (error < 0.5).mean() > 0.97


def test_samples_never_mix_surfaces_or_the_unknown() -> None:
    rng = np.random.default_rng(1)
    values = np.where(np.arange(20)[None] < 10, 5.0, 9.0) + rng.uniform(0, 0.2, (16, 20))
    values[rng.uniform(size=values.shape) < 0.15] = 0
    values = values.astype(np.float32)
    # quarters: fractions that the interpolation weights represent exactly
    u, v = rng.integers(0, 19 * 4 - 3, (2, 400)).astype(np.float32) / 4
    v = np.minimum(v, 14.75).astype(np.float32)
    u, v = u[None] + np.float32(0.125), v[None] + np.float32(0.125)
    sampled = sample_within_surfaces(values, u, v, 1.0)[0]
    for value, x, y in zip(sampled, u[0], v[0], strict=True):
        x0, y0, fx, fy = int(x), int(y), x % 1, y % 1
        corners = values[y0 : y0 + 2, x0 : x0 + 2]
        if (corners > 0).all() and np.ptp(corners) < 1:
            weights = np.outer([1 - fy, fy], [1 - fx, fx])
            assert value == pytest.approx((corners * weights).sum(), abs=1e-3)
        elif value > 0:  # a corner of next to no weight may be on the other side
            nearest = values[round(y), round(x)]
            assert abs(value - nearest) <= 1.0


def test_rays_go_through_the_pixel_centres() -> None:
    camera = camera_at(0, 20)
    rays = pixel_rays(camera)
    assert rays.shape == (SIZE[1], SIZE[0], 3) and np.all(rays[..., 2] == 1)
    assert np.allclose(camera.to_pixels(rays[..., :2].reshape(-1, 2)), pixel_centres(*SIZE), atol=1e-3)


@pytest.mark.parametrize("name", PAIRS)
def test_depth_of_a_rendered_ball_on_the_distorted_pixel_grid(name: str) -> None:
    scene = Scene()
    first, second = PAIRS[name]
    images = [scene.render(camera, supersample=2) for camera in (first, second)]
    grays = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image, _, _ in images]
    _, depth, mask = images[0]
    seen = first.unproject(pixel_centres(*SIZE)[mask.ravel()], depth[mask])
    view = View(first, grays[0], seen, mask)
    found = stereo_depth(view, View(second, grays[1], seen), view.box)
    assert found is not None
    x0, y0, x1, y1 = view.box
    estimate, truth, mask = found[0], depth[y0:y1, x0:x1], mask[y0:y1, x0:x1]
    known = mask & (estimate > 0)
    error = np.abs(estimate[known] / truth[known] - 1)
    assert known.sum() > 0.8 * mask.sum()
    assert np.median(error) < 0.005 and (error < 0.01).mean() > 0.85


def test_nothing_is_known_of_what_the_neighbour_does_not_see() -> None:
    scene, first = Scene(), camera_at(0, 20)
    second = camera_at(9, 20)
    shifted = np.array([[240.0, 0, 103.3 - 90], [0, 243.0, 77.6], [0, 0, 1]])
    second = replace(second, K=shifted)  # half of the ball is outside its image
    (image1, depth, mask), (image2, _, _) = (scene.render(c, supersample=2) for c in (first, second))
    pixels = pixel_centres(*SIZE)[mask.ravel()]
    seen = first.unproject(pixels, depth[mask])
    gray1, gray2 = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (image1, image2))
    found = stereo_depth(View(first, gray1, seen), View(second, gray2, seen), (0, 0, *SIZE))
    assert found is not None
    where, _ = second.project(seen)
    estimate = found[0][mask]
    assert (estimate[where[:, 0] > 10] > 0).mean() > 0.7
    assert (estimate[where[:, 0] < -6] > 0).mean() < 0.02


def test_the_box_of_a_view_is_that_of_its_region() -> None:
    camera = camera_at(0, 20)
    region = np.zeros((SIZE[1], SIZE[0]), bool)
    assert View(camera, region.astype(np.uint8), np.zeros((0, 3)), region).box == (0, 0, 0, 0)
    region[20:31, 40:42] = True
    assert View(camera, region.astype(np.uint8), np.zeros((0, 3)), region).box == (40, 20, 42, 31)
    assert View(camera, region.astype(np.uint8), np.zeros((0, 3))).box == (0, 0, *SIZE)
