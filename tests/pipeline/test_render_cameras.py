"""Cameras of renders have the paper's distribution; the check of pairs finds what does not agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dope.common import settings
from dope.common.errors import UsageError
from pipeline.render.cameras import looking_at, paired_cameras
from pipeline.render.check import seen_by_both
from pipeline.render.config import RenderConfig, ViewpointsConfig
from tests.pipeline.analytic import picture_of

CONFIG = ViewpointsConfig()


def test_focal_length_and_centre_are_the_papers() -> None:
    K = paired_cameras(CONFIG, 0)[0].K
    assert K[0, 0] == K[1, 1] == pytest.approx(186.6667, abs=1e-3)
    assert K[0, 2] == K[1, 2] == 112
    half = paired_cameras(replace(CONFIG, size=112), 0)[0].K
    assert half[0, 0] == pytest.approx(93.3333, abs=1e-3) and half[0, 2] == 56


def test_the_place_looked_at_is_in_the_middle_and_up_is_up() -> None:
    eye, target = np.array([2.0, -1, 1.5]), np.array([0.1, 0.2, -0.3])
    camera = looking_at(eye, target, CONFIG)
    np.testing.assert_allclose(camera.centre, eye, atol=1e-12)
    np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.R) == pytest.approx(1)
    pixels, depth = camera.project(np.stack([target, target + np.array([0, 0, 0.1])]))
    np.testing.assert_allclose(pixels[0], [112, 112], atol=1e-9)
    assert depth[0] == pytest.approx(np.linalg.norm(target - eye))
    assert pixels[1, 0] == pytest.approx(112, abs=1e-9) and pixels[1, 1] < 112


def test_viewpoints_follow_the_papers_distribution() -> None:
    cameras = paired_cameras(replace(CONFIG, pairs=3000), "distribution")
    centres = np.stack([camera.centre for camera in cameras])
    distance = np.linalg.norm(centres, axis=1)
    zenith = np.degrees(np.arccos(centres[:, 2] / distance))
    azimuth = np.degrees(np.arctan2(centres[:, 1], centres[:, 0])) % 360
    turn = (azimuth[1::2] - azimuth[::2] + 180) % 360 - 180
    for values, low, high in ((distance, 1.75, 4), (zenith, 10, 80), (azimuth[::2], 0, 360), (turn, -90, 90)):
        assert low <= values.min() and values.max() <= high
        share = np.histogram(values, 5, (low, high))[0] / len(values)
        np.testing.assert_allclose(share, 0.2, atol=0.025)
    # the axis passes the origin at the distance of the jitter
    axes = np.stack([camera.R[2] for camera in cameras])
    miss = np.linalg.norm(np.cross(axes, centres), axis=1)
    assert 0.3 < miss.mean() < 0.5 and miss.max() < np.sqrt(3) * 0.5


def test_cameras_are_a_function_of_the_seed() -> None:
    first, again, other = (paired_cameras(CONFIG, 0, name) for name in ("a", "a", "b"))
    assert all(np.array_equal(x.R, y.R) and np.array_equal(x.t, y.t) for x, y in zip(first, again, strict=True))
    assert not np.array_equal(first[0].t, other[0].t)
    fewer = paired_cameras(replace(CONFIG, pairs=2), 0, "a")
    assert np.array_equal(fewer[3].t, first[3].t)  # more pairs leave the first as they are


def test_exact_pictures_agree_within_a_tenth_of_a_pixel() -> None:
    cameras = paired_cameras(CONFIG, "agree")
    pictures = [picture_of(camera, ground=-0.5) for camera in cameras]
    seen = [seen_by_both(pictures[i], cameras[i], pictures[i + 1], cameras[i + 1]) for i in range(0, 20, 2)]
    miss = np.concatenate([pair.miss_px for pair in seen])
    assert len(miss) > 10_000
    assert np.median(miss) < 0.02 and (miss < 1).mean() > 0.99
    for pair in seen:
        np.testing.assert_allclose(np.linalg.norm(pair.points, axis=1), 0.5, atol=1e-5)  # on the sphere


@pytest.mark.parametrize("wrong", ["ray length", "half a pixel", "other place"])
def test_pictures_that_are_wrong_do_not(wrong: str) -> None:
    camera, other = paired_cameras(replace(CONFIG, jitter=0.1), "wrong")[:2]
    one, two = picture_of(camera), picture_of(other)
    if wrong == "ray length":
        y, x = np.mgrid[:224, :224] + 0.5 - 112
        one = replace(one, depth=(one.depth * np.sqrt(1 + (x**2 + y**2) / 186.667**2)).astype(np.float32))
    elif wrong == "half a pixel":
        camera = replace(camera, K=camera.K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))
    else:
        camera = replace(camera, t=camera.t + np.array([0.02, 0, 0]))
    assert np.median(seen_by_both(one, camera, two, other).miss_px) > 0.1


@pytest.mark.parametrize(
    "setting",
    [
        "viewpoints.zenith_deg=[0,10]",
        "viewpoints.zenith_deg=[80,10]",
        "viewpoints.zenith_deg=[.nan,10]",
        "viewpoints.distance=[-2,-1]",
        "viewpoints.lens_mm=0",
        "viewpoints.sensor_mm=0",
        "look.strength=[-1,-1]",
        "look.places=-1",
        "mesh.min_mask_share=5",
        "jpeg_quality=500",
    ],
)
def test_settings_that_show_nothing_are_refused_before_any_object(setting: str) -> None:
    with pytest.raises(UsageError, match=setting.split("=")[0].rsplit(".", maxsplit=1)[-1]):
        settings.override(RenderConfig(), [setting])
