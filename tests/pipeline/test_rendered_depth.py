"""Stereo on rendered photos of a solid object against their true depth: `benchmarks/depth.py` in small."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.depth import Truth, errors_of, measure, render_object, summarise
from pipeline.demo.film import FilmConfig
from pipeline.depth.mvs import DepthConfig
from pipeline.geometry import Camera

FILM = FilmConfig(width=256, height=192, frames=8, arc_deg=(63.0, 63.0), detail=0.6)


def test_depth_of_a_rendered_object_is_dense_and_true(tmp_path: Path) -> None:
    sequence, truths = render_object(tmp_path / "vase", "vase", 1, FILM)
    found = measure(sequence, truths, DepthConfig())
    assert found["coverage"] > 0.82
    assert found["median_error_percent"] < 0.25
    assert found["under_1_percent"] > 0.9


def test_errors_are_those_of_the_objects_pixels() -> None:
    camera = Camera(6, 4, np.eye(3), np.zeros(4), np.eye(3), np.zeros(3))
    mask = np.zeros((4, 6), bool)
    mask[1:3, 1:5] = True
    truth = Truth(camera, np.full((4, 6), 2.0, np.float32), mask)
    depth = np.full((4, 6), 9.0, np.float32)
    depth[mask] = [2.0, 2.01, 2.03, 2.2, 1.99, 0, 0, 2.0]
    found = summarise(errors_of(depth, truth))
    assert found == {
        "coverage": 0.75,
        "median_error_percent": pytest.approx(0.5, abs=1e-3),
        "under_1_percent": pytest.approx(4 / 6, abs=1e-4),
        "under_2_percent": pytest.approx(5 / 6, abs=1e-4),
    }
    assert summarise(errors_of(None, truth))["coverage"] == 0
    assert len(errors_of(depth[::2, ::2], truth)) == 2
