"""Files of cameras as other tools write them: what may be left out of them, and what is refused and why."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from camera_files import named, transforms, write_cameras_json, write_colmap_binary, write_colmap_text, write_transforms

from dope.common.errors import BadInput
from pipeline.cameras.known import read_known_cameras
from pipeline.sequence import write_image


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "frames.bin", "rigs.bin"])
@pytest.mark.parametrize("cut", [0.0, 0.5, 0.95, 1.05])
def test_a_truncated_model_is_said_to_be_damaged(tmp_path, name, cut):
    folder = write_colmap_binary(tmp_path / "model", named())
    data = (folder / name).read_bytes()
    (folder / name).write_bytes((data + bytes(100))[: int(cut * len(data) + (cut > 1))])
    with pytest.raises(BadInput, match=r"model that cannot be read \(.* is damaged or cut off"):
        read_known_cameras(folder)


def test_models_that_cannot_be_used_say_what_to_do(tmp_path):
    with pytest.raises(BadInput, match=r"holds no cameras.*sparse/0"):
        read_known_cameras(tmp_path)
    fisheye = write_colmap_text(tmp_path / "fisheye", named(), model="OPENCV_FISHEYE")
    with pytest.raises(BadInput, match=r"OPENCV_FISHEYE.*image_undistorter"):
        read_known_cameras(fisheye)
    (fisheye / "images.txt").write_text("")
    with pytest.raises(BadInput):
        read_known_cameras(fisheye)
    (fisheye / "points3D.txt").unlink()
    with pytest.raises(BadInput, match="cannot be read"):
        read_known_cameras(fisheye)


def test_a_model_without_rigs_as_older_colmaps_write_it(tmp_path):
    folder = write_colmap_binary(tmp_path / "model", named())
    (folder / "rigs.bin").unlink()
    (folder / "frames.bin").unlink()
    assert len(read_known_cameras(folder).cameras) == 9


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda v: v.pop("fl_x"), "frame 0 .*lacks 'fl_x'"),
        (lambda v: v["frames"][4].pop("transform_matrix"), "frame 4 .*lacks 'transform_matrix'"),
        (lambda v: v["frames"][4].pop("file_path"), "frame 4 .*lacks 'file_path'"),
        (lambda v: v["frames"][4].update(file_path="images/0003.jpg"), "'images/0003.jpg' is there twice"),
        (lambda v: v["frames"][2].update(transform_matrix=[[1, 2], [3, 4]]), "frame 2 .*shape"),
        (lambda v: v["frames"][2].update(transform_matrix=np.zeros((4, 4)).tolist()), "no rotation"),
        (lambda v: v["frames"][2].update(transform_matrix=[["x"] * 4] * 4), "frame 2 .*not a camera"),
        (
            lambda v: v["frames"][2]["transform_matrix"][0].__setitem__(3, float("nan")),
            "frame 2 .*0002.jpg.*not finite",
        ),
        (lambda v: v.update(camera_model="OPENCV_FISHEYE"), "OPENCV_FISHEYE.*Undistort"),
        (lambda v: v.update(k3=0.1), "k3.*Undistort"),
        (lambda v: v.update(w=float("inf")), "frame 0 .*not a camera"),
        (lambda v: v.update(fl_x=float("nan")), "not finite"),
        (lambda v: v.update(cx=None), "frame 0 .*not a camera"),
        (lambda v: v.update(applied_transform=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]]), "mirrors"),
        (lambda v: v.update(applied_transform="x"), "applied_transform"),
        (lambda v: v.update(applied_transform=1e308), "applied_transform"),
        (lambda v: v.update(applied_transform=[[10**400] * 4] * 3), "applied_transform"),
        (lambda v: (v.pop("w"), [row.update(file_path="x" * 5000) for row in v["frames"]]), "none of its images"),
        (lambda v: (v.pop("w"), [row.update(file_path="/") for row in v["frames"]]), "none of its images"),
        (lambda v: v.update(frames=[]), "no camera with a pose"),
        (lambda v: v.update(frames={"a": 1}), "no list of `frames`"),
        (lambda v: (v.pop("w"), v.pop("h")), "no image size"),
    ],
)
def test_a_damaged_transforms_file_is_refused_with_the_frame(tmp_path, change, said):
    values = transforms(named())
    change(values)
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    with pytest.raises(BadInput, match=said):
        read_known_cameras(tmp_path)


def test_intrinsics_may_stand_in_each_frame_and_be_angles(tmp_path):
    values = transforms(named())
    for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"):
        values.pop(key)
    values["camera_angle_x"] = 2 * math.atan(320 / 2 / 380)
    values["frames"][1] |= {"fl_x": 400, "fl_y": 410, "cx": 150, "k1": 0.5}
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    cameras = list(read_known_cameras(tmp_path).cameras.values())
    np.testing.assert_allclose(cameras[0].K, [[380, 0, 160], [0, 380, 120], [0, 0, 1]])
    np.testing.assert_allclose(cameras[1].K, [[400, 0, 150], [0, 410, 120], [0, 0, 1]])
    assert cameras[1].distortion.tolist() == [0.5, 0, 0, 0]


def test_one_digit_of_a_large_camera_file_is_another_input(tmp_path):
    from pipeline.inputs.sources import place_fingerprint

    path = write_transforms(tmp_path, named(), note="1" * 1_000_000) / "transforms.json"
    before = place_fingerprint(tmp_path, whole=True), place_fingerprint(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 4] = ord("2")
    path.write_bytes(data)
    after = place_fingerprint(tmp_path, whole=True), place_fingerprint(path)
    assert before[0] != after[0] and before[1] != after[1]


def test_sizes_that_are_not_given_are_those_of_the_images(tmp_path):
    values = transforms({name.removesuffix(".jpg"): camera for name, camera in named().items()})
    values.pop("w"), values.pop("h")
    write_image(tmp_path / "images/0003.jpg", np.zeros((240, 320, 3), np.uint8))
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    assert {(c.width, c.height) for c in read_known_cameras(tmp_path).cameras.values()} == {(320, 240)}


def test_a_file_that_is_cut_off_is_never_to_be_deleted(tmp_path):
    """It is the user's own: nothing here could make it again."""
    for path in (write_transforms(tmp_path, named()) / "transforms.json", write_cameras_json(tmp_path, named())):
        path.write_text(path.read_text()[:500])
        with pytest.raises(BadInput, match=r"is not valid JSON.*Write it again with the tool") as caught:
            read_known_cameras(path)
        assert str(path) in str(caught.value) and "Delete" not in str(caught.value)
