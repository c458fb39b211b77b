"""Prepared sequences for other tools: what is exported is what they read, and comes back as the same cameras."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic import Scene, orbit, write_sequence
from typer.testing import CliRunner

from dope.common.errors import BadInput
from pipeline.cameras.colmap.base import pycolmap
from pipeline.cameras.export import export_sequence
from pipeline.cameras.known import KnownCameras, place_cameras, read_known_cameras
from pipeline.cameras.sfm import SfmConfig
from pipeline.commands import app
from pipeline.engines import holding
from pipeline.geometry import Camera
from pipeline.sequence import Sequence

CAMERAS = orbit(6, arc_deg=60, width=160, height=120, focal=190, distortion=(0.05, -0.02, 0.001, -0.0005))
POINTS = np.random.default_rng(0).uniform(-0.8, 0.8, (300, 3))


@pytest.fixture()
def sequence(tmp_path) -> Sequence:
    """Six views with masks and depth; the fifth has no camera, the points are given."""
    sequence = write_sequence(tmp_path / "work" / "a thing", CAMERAS, Scene("box"))
    frames = sequence.read_frames()
    for frame in frames:
        frame.source_name = f"IMG_{frame.frame}.png"
    sequence.write_frames(frames)
    cameras = {f"IMG_{i}": camera for i, camera in enumerate(CAMERAS) if i != 4}
    known = KnownCameras(cameras, POINTS, np.full((300, 3), 9, np.uint8), "the test")
    place_cameras(sequence, known, SfmConfig(known_points="given", keep_database=False))
    return sequence


def opengl(row: dict) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and shift, world to camera, of a row as nerfstudio's documentation describes it."""
    pose = np.array(row["transform_matrix"])
    pose[:3, 1:3] *= -1
    inverse = np.linalg.inv(pose)
    return inverse[:3, :3], inverse[:3, 3]


def test_transforms_hold_the_cameras_in_opengl_axes_and_paths_that_exist(sequence):
    done = export_sequence(sequence, "transforms", None)
    values = json.loads((sequence.folder / "transforms.json").read_text())
    assert done["frames"] == 5 and len(values["frames"]) == 5 and values["camera_model"] == "OPENCV"
    by_number = {frame.frame: frame for frame in sequence.registered_frames()}
    for row in values["frames"]:
        camera = by_number[int(Path(row["file_path"]).stem)].camera
        R, t = opengl(row)
        np.testing.assert_allclose(R, camera.R, atol=1e-12)
        np.testing.assert_allclose(t, camera.t, atol=1e-12)
        assert (sequence.folder / row["file_path"]).is_file() and (sequence.folder / row["mask_path"]).is_file()
        assert "depth_file_path" not in row and "fl_x" not in row, "one camera for all stands at the top"
    assert (values["w"], values["h"], values["fl_x"], values["k1"]) == (160, 120, 190, 0.05)
    assert values["ply_file_path"] == "points.ply" and "depth_unit_scale_factor" not in values


@pytest.mark.parametrize("elsewhere", [False, True])
def test_what_is_exported_comes_back_as_the_same_cameras_and_points(sequence, tmp_path, elsewhere):
    out = tmp_path / "far" / "away" if elsewhere else None
    done = export_sequence(sequence, "transforms", out)
    known = read_known_cameras(Path(done["path"]))
    before = {frame.source_name: frame.camera for frame in sequence.registered_frames()}
    assert known.cameras.keys() == before.keys()
    for name, camera in known.cameras.items():
        assert_same(camera, before[name], atol=1e-9)
    assert known.xyz is not None and len(known.xyz) == done["points"] > 50 and (known.rgb == 9).all()
    if elsewhere:
        row = json.loads(Path(done["path"]).read_text())["frames"][0]
        assert (out / row["file_path"]).resolve() == (sequence.images / "000000.jpg").resolve()
    place_cameras(sequence, known, SfmConfig(known_points="none", keep_database=False))
    scale = sequence.read_info().input_scale
    for frame in sequence.registered_frames():
        np.testing.assert_allclose(frame.camera.R, before[frame.source_name].R, atol=1e-9)
    again = [frame.camera.centre for frame in sequence.registered_frames()]
    apart = np.linalg.norm(again[3] - again[0]) / scale
    centres = [camera.centre for camera in before.values()]
    assert apart == pytest.approx(np.linalg.norm(centres[3] - centres[0]), rel=1e-9)


def assert_same(one: Camera, other: Camera, atol: float) -> None:
    assert (one.width, one.height) == (other.width, other.height)
    for name in ("K", "distortion", "R", "t"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=atol)


def test_intrinsics_that_differ_stand_in_each_frame(sequence):
    frames = sequence.read_frames()
    frames[1].fx *= 1.1
    sequence.write_frames(frames)
    export_sequence(sequence, "transforms", None)
    values = json.loads((sequence.folder / "transforms.json").read_text())
    assert "fl_x" not in values and [round(row["fl_x"]) for row in values["frames"]] == [190, 209, 190, 190, 190]


def test_depth_is_exported_in_thousandths_of_the_unit(sequence):
    frames = sequence.read_frames()
    far = np.full((120, 160), 70.0, np.float32)
    far[:60] = 2.5
    sequence.write_depth(frames[0], far)
    sequence.write_frames(frames)
    done = export_sequence(sequence, "transforms", None, depths=True)
    values = json.loads((sequence.folder / "transforms.json").read_text())
    assert values["depth_unit_scale_factor"] == 0.001 and done["depths"] == 5
    for row in values["frames"]:
        stored = cv2.imread(str(sequence.folder / row["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        frame = frames[int(Path(row["file_path"]).stem)]
        depth = sequence.read_depth(frame)
        known = depth <= 65.5
        np.testing.assert_allclose(stored[known] * 0.001, depth[known], atol=0.00051)
        assert (stored[~known] == 0).all()
    assert values["frames"][0]["depth_file_path"].endswith("000000.png")


def test_colmap_text_is_the_same_model(sequence, tmp_path):
    export_sequence(sequence, "colmap-text", tmp_path / "text")
    folder = tmp_path / "text" / "sparse_text"
    text, binary = pycolmap.Reconstruction(folder), pycolmap.Reconstruction(sequence.sparse)
    assert (folder / "images.txt").is_file() and text.num_points3D() == binary.num_points3D() > 0
    assert {image.name for image in text.images.values()} == {image.name for image in binary.images.values()}


@pytest.mark.parametrize("format", ["transforms", "colmap-text"])
def test_exporting_into_work_itself_leaves_its_files_where_they_are(sequence, format):
    before = {path: path.read_bytes() for path in sequence.folder.rglob("*") if path.is_file()}
    work = str(sequence.folder.parent)
    run = CliRunner().invoke(app, ["export", work, "--format", format, "--out", work])
    assert run.exit_code == 0, run.output
    assert len(before) > 15 and all(path.read_bytes() == data for path, data in before.items())


def test_every_frame_has_a_mask_and_a_depth_map_or_none_has(sequence, tmp_path):
    frames = sequence.read_frames()
    frames[1].mask = frames[2].depth = None
    sequence.write_frames(frames)
    done = export_sequence(sequence, "transforms", tmp_path / "out", depths=True)
    rows = json.loads(Path(done["path"]).read_text())["frames"]
    for key, empty in (("mask_path", 1), ("depth_file_path", 2)):
        maps = [cv2.imread(str(tmp_path / "out" / row[key]), cv2.IMREAD_UNCHANGED) for row in rows]
        assert [bool(values.any()) for values in maps] == [i != empty for i in range(5)]
    assert done["depths"] == 4
    for frame in frames:
        frame.mask = None
    sequence.write_frames(frames)
    export_sequence(sequence, "transforms", tmp_path / "out")
    assert "mask_path" not in (tmp_path / "out" / "transforms.json").read_text()


def test_a_sequence_without_cameras_is_refused_and_the_others_are_exported(sequence, tmp_path):
    empty = write_sequence(sequence.folder.with_name("empty"), CAMERAS[:2], depths=False)
    frames = empty.read_frames()
    empty.write_frames([replace(frame, registered=False) for frame in frames])
    with pytest.raises(BadInput, match="no frame has a camera"):
        export_sequence(empty, "transforms", None)
    run = CliRunner().invoke(app, ["export", str(sequence.folder.parent), "--out", str(tmp_path / "out")])
    assert run.exit_code == 1 and "a thing: 5 cameras" in run.output and "empty: " in run.output
    assert (tmp_path / "out" / "a thing" / "transforms.json").is_file()
    assert not (tmp_path / "out" / "empty").exists()


def test_a_sequence_that_is_being_worked_on_is_refused(sequence, tmp_path):
    """Else what it is exported as could be half of one state and half of the next."""
    words = ["export", str(sequence.folder.parent), "--out", str(tmp_path / "out")]
    with holding(sequence.folder):
        run = CliRunner().invoke(app, words)
    assert run.exit_code == 1 and f"is being worked on by process {os.getpid()}" in run.output
    assert not (tmp_path / "out").exists()
    assert CliRunner().invoke(app, words).exit_code == 0


@pytest.mark.parametrize("arguments", [["--format", "ply"], ["--format", "colmap-text", "--depths"]])
def test_wrong_usage_is_told_before_anything_is_written(sequence, arguments):
    run = CliRunner().invoke(app, ["export", str(sequence.folder.parent), *arguments])
    assert run.exit_code != 0 and not (sequence.folder / "transforms.json").exists()
