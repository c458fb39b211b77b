from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from dope.common.errors import BadInput
from pipeline.cameras.compare import compare_cameras, read_reference
from pipeline.geometry import Camera, Similarity
from pipeline.sequence import Frame

K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def rotation(vector: list[float]) -> np.ndarray:
    return cv2.Rodrigues(np.array(vector, dtype=float))[0]


def cameras(n: int = 6) -> list[Camera]:
    rng = np.random.default_rng(1)
    return [Camera(640, 480, K, np.zeros(4), rotation(list(rng.normal(size=3))), rng.normal(size=3)) for _ in range(n)]


def frames_of(views: list[Camera]) -> list[Frame]:
    frames = [Frame(i, f"IMG_{i}.JPG", 640, 480) for i in range(len(views))]
    for frame, camera in zip(frames, views, strict=True):
        frame.set_camera(camera)
    return frames


MOVE = Similarity(3.0, rotation([0.2, -0.7, 0.4]), np.array([5.0, 1.0, -2.0]))


def test_a_moved_and_scaled_world_has_no_errors():
    views = cameras()
    errors = compare_cameras(
        frames_of([view.transformed(MOVE) for view in views]), {f"IMG_{i}": v for i, v in enumerate(views)}
    )
    assert errors.n_registered == errors.n_reference == 6
    assert errors.rotation_max_deg < 1e-6 and errors.relative_rotation_max_deg < 1e-6
    assert errors.translation_max_percent < 1e-6


def test_one_camera_turned_by_three_degrees():
    views = cameras(8)
    moved = [view.transformed(MOVE) for view in views]
    turn = rotation([0, 0, np.radians(3)])
    moved[4] = replace(moved[4], R=turn @ moved[4].R, t=turn @ moved[4].t)  # about its own centre
    errors = compare_cameras(frames_of(moved), {f"IMG_{i}": view for i, view in enumerate(views)})
    assert errors.rotation_max_deg == pytest.approx(3, abs=1e-6) and errors.rotation_median_deg < 1e-6
    assert errors.relative_rotation_max_deg == pytest.approx(3, abs=1e-6)
    assert errors.translation_max_percent < 1e-6


def test_frames_without_camera_or_reference_do_not_count():
    views = cameras(5)
    frames = frames_of(views)
    frames[1].clear_camera()
    reference = {f"IMG_{i}": view for i, view in enumerate(views) if i != 3}
    errors = compare_cameras(frames, reference)
    assert (errors.n_reference, errors.n_registered) == (4, 3) and errors.relative_rotation_max_deg < 1e-6
    none = compare_cameras(frames[:1], reference)
    assert none.n_registered == 1 and np.isnan(none.rotation_median_deg)


def test_reading_a_reference_file(tmp_path):
    row = {"name": "a", "width": 640, "height": 480, "fx": 500, "fy": 510, "cx": 320, "cy": 240, "dist": [0.1]}
    row |= {"w2c_R": np.eye(3).tolist(), "w2c_t": [0, 0, 1]}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"frames": [row]}))
    camera = read_reference(path)["a"]
    assert camera.K[1, 1] == 510 and list(camera.distortion) == [0.1, 0, 0, 0] and camera.t[2] == 1
    path.write_text(json.dumps({"frames": [row, {**row, "w2c_R": [1, 2]}]}))
    with pytest.raises(BadInput, match="frame 1"):
        read_reference(path)
    path.write_text("[]")
    with pytest.raises(BadInput, match="frames"):
        read_reference(path)
