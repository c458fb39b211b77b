"""Cameras that are given: every format says the same, wrong ones are refused, and the images have the last word."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import (
    CAMERAS,
    NAMES,
    NERFSTUDIO_WORLD,
    SHIFTED_WORLD,
    named,
    write_cameras_json,
    write_colmap_binary,
    write_colmap_text,
    write_transforms,
)
from synthetic import Scene, orbit, write_sequence

from dope.common.errors import BadInput
from pipeline.cameras import colmap
from pipeline.cameras.colmap.base import pycolmap
from pipeline.cameras.compare import compare_cameras
from pipeline.cameras.known import KnownCameras, place_cameras, reuse_cameras
from pipeline.cameras.known_points import posed_pairs
from pipeline.cameras.naming import match_names
from pipeline.cameras.project import write_project
from pipeline.cameras.sfm import SfmConfig, reconstruct
from pipeline.geometry import Camera, rotation_angle_deg
from pipeline.sequence import Frame, Sequence

CAPTURES = Path(__file__).parents[2].parent / "shared/data/captures"
NO_POINTS = SfmConfig(known_points="none")
CONFIG = SfmConfig(max_image_size=320, max_features=800)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> Sequence:
    """Images and masks of a scene, without cameras."""
    folder = tmp_path_factory.mktemp("known") / "thing"
    sequence = write_sequence(folder, CAMERAS, Scene("box"), depths=False)
    frames = sequence.read_frames()
    for frame in frames:
        frame.clear_camera()
    sequence.write_frames(frames)
    info = sequence.read_info()
    info.source, info.kind, info.masks_from = "/photos/of/thing", "photos", "input"
    sequence.write_info(info)
    return sequence


@pytest.fixture()
def sequence(filmed, tmp_path) -> Sequence:
    shutil.copytree(filmed.folder, tmp_path / "thing")
    return Sequence(tmp_path / "thing")


def known(cameras: dict[str, Camera], **more: Any) -> KnownCameras:
    return KnownCameras(cameras, more.get("xyz"), more.get("rgb"), "the test")


@pytest.mark.parametrize("kind", ["text", "binary", "transforms", "applied", "shifted", "cameras.json"])
def test_every_format_gives_the_same_cameras(sequence, tmp_path, kind):
    cameras = named()
    path = {
        "text": lambda: write_colmap_text(tmp_path / "model", cameras),
        "binary": lambda: write_colmap_binary(tmp_path / "model", cameras),
        "transforms": lambda: write_transforms(tmp_path, cameras) / "transforms.json",
        "applied": lambda: write_transforms(tmp_path, cameras, world=NERFSTUDIO_WORLD),
        "shifted": lambda: write_transforms(tmp_path, cameras, world=SHIFTED_WORLD),
        "cameras.json": lambda: write_cameras_json(tmp_path, cameras),
    }[kind]()
    details = reuse_cameras(sequence, path, NO_POINTS)
    assert details["n_registered"] == len(CAMERAS) and str(tmp_path) in details["cameras_from"]
    scale = sequence.read_info().input_scale
    centre = np.array(details["object"]["centre"])
    for frame, true in zip(sequence.read_frames(), CAMERAS, strict=True):
        camera = frame.camera
        np.testing.assert_allclose(camera.K, true.K, atol=1e-6)
        np.testing.assert_allclose(camera.distortion, true.distortion, atol=1e-9)
        np.testing.assert_allclose(camera.R, true.R, atol=1e-6)
        np.testing.assert_allclose(camera.centre / scale, true.centre - centre, atol=3e-6)


def test_points_are_triangulated_and_the_object_becomes_the_unit(sequence):
    details = place_cameras(sequence, known(named()), CONFIG)
    assert details["n_points"] > 100 and details["mean_error_px"] < 1 and details["match_error_px"] < 0.6
    assert details["warnings"] == []
    errors = compare_cameras(sequence.read_frames(), {Path(name).stem: c for name, c in named().items()})
    assert errors.n_registered == len(CAMERAS)
    assert errors.rotation_max_deg < 1e-4 and errors.translation_max_percent < 1e-4
    points = colmap.read_points(sequence)
    assert len(points) == details["n_points"]
    scale, centre = sequence.read_info().input_scale, np.array(details["object"]["centre"])
    half = np.array(Scene("box").box)
    on_object = points.xyz[np.linalg.norm(points.xyz, axis=1) < 0.95] / scale + centre
    assert np.median(np.abs(np.abs(on_object) - half).min(axis=1)) < 0.02, "the points lie on the box's faces"


def test_what_is_written_agrees_with_itself_and_is_the_same_again(sequence, tmp_path):
    shutil.copytree(sequence.folder, tmp_path / "again" / "thing")
    again = Sequence(tmp_path / "again" / "thing")
    for one in (sequence, again):
        place_cameras(one, known(named()), CONFIG)
    frames, info = sequence.read_frames(), sequence.read_info()
    for number, camera in colmap.read_model(sequence.sparse).cameras().items():
        np.testing.assert_allclose(frames[number].camera.R, camera.R, atol=1e-12)
        np.testing.assert_allclose(frames[number].camera.t, camera.t, atol=1e-12)
    assert (info.n_registered, info.unit, info.attempts[0]["verdict"]) == (9, "object radius", "given")
    assert not list(sequence.folder.glob(".*"))
    for name in ("frames.parquet", "sparse/images.bin", "sparse/points3D.bin", "sparse/cameras.bin"):
        assert (sequence.folder / name).read_bytes() == (again.folder / name).read_bytes(), name


def test_intrinsics_follow_the_size_of_the_stored_image(sequence):
    large = {name: camera.resized(camera.width * 4, camera.height * 4) for name, camera in named().items()}
    place_cameras(sequence, known(large), NO_POINTS)
    for frame, true in zip(sequence.read_frames(), CAMERAS, strict=True):
        np.testing.assert_allclose(frame.camera.K, true.K, rtol=1e-12)


# --- names -----------------------------------------------------------------------------------------------------------


def test_frames_without_a_camera_stay_without_one(sequence):
    cameras = {f"elsewhere/{name}": camera for name, camera in named().items() if name not in NAMES[2:4]}
    details = place_cameras(sequence, known({**cameras, "other.jpg": CAMERAS[0]}), NO_POINTS)
    assert [frame.frame for frame in sequence.read_frames() if not frame.registered] == [2, 3]
    assert details["registered_share"] == round(7 / 9, 4) and details["unused_cameras"] == 1
    assert "2 frames have no camera: '0002.jpg', '0003.jpg'" in details["warnings"][0]


def test_names_that_match_nothing_are_shown_from_both_sides(sequence):
    with pytest.raises(BadInput, match=r"'IMG_0'.*'0000\.jpg'.*the test|the test.*'IMG_0'.*'0000\.jpg'"):
        place_cameras(sequence, known({f"IMG_{i}": camera for i, camera in enumerate(CAMERAS)}), NO_POINTS)


def test_of_equal_file_names_the_one_in_the_photos_own_folders_counts(sequence):
    cameras = {f"of/thing/{name}": camera for name, camera in named().items()}
    others = {f"of/other/{name}": replace(c, t=c.t + 1) for name, c in named().items()}
    place_cameras(sequence, known({**others, **cameras}), NO_POINTS)
    first, true = sequence.read_frames()[3].camera, CAMERAS[3]
    assert rotation_angle_deg(first.R @ true.R.T) < 1e-9
    with pytest.raises(BadInput, match=r"several cameras may belong to frame '0000\.jpg'"):
        place_cameras(sequence, known({**others, **{f"a/{n}": c for n, c in named().items()}}), NO_POINTS)


def test_frames_of_a_video_are_found_by_their_number(sequence):
    frames = sequence.read_frames()
    for frame in frames:
        frame.source_name = str(7 * frame.frame)
    sequence.write_frames(frames)
    info = sequence.read_info()
    info.kind = "video"
    sequence.write_info(info)
    place_cameras(sequence, known({f"f/frame_{7 * i:05d}.png": c for i, c in enumerate(CAMERAS)}), NO_POINTS)
    assert [round(f.camera.K[0, 0]) for f in sequence.read_frames()] == [380] * 9
    np.testing.assert_allclose(sequence.read_frames()[5].camera.R, CAMERAS[5].R, atol=1e-9)


# --- cameras that cannot be right ------------------------------------------------------------------------------------


def test_a_camera_of_a_turned_image_is_refused_with_the_frames_name(sequence):
    turned = {name: replace(camera, width=240, height=320) for name, camera in named().items()}
    with pytest.raises(BadInput, match=r"240x320 image, frame '0000\.jpg' is 320x240.*EXIF"):
        place_cameras(sequence, known(turned), NO_POINTS)
    cropped = {name: replace(camera, width=320, height=200) for name, camera in named().items()}
    with pytest.raises(BadInput, match="cropped"):
        place_cameras(sequence, known(cropped), NO_POINTS)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda c: replace(c, t=np.array([0, np.nan, 0])), "'0003.jpg' has values that are not finite"),
        (lambda c: replace(c, R=c.R * 1.2), "'0003.jpg' has a matrix that is no rotation"),
        (lambda c: replace(c, R=-c.R), r"no rotation \(det -1\)"),
        (lambda c: replace(c, K=np.diag([-380.0, 380, 1])), "no sensible size or focal length"),
        (lambda c: replace(c, width=0), "no sensible size or focal length"),
    ],
)
def test_a_camera_that_cannot_be_one_is_named(sequence, spoil, said):
    cameras = named()
    cameras["0003.jpg"] = spoil(cameras["0003.jpg"])
    before = (sequence.folder / "frames.parquet").read_bytes()
    with pytest.raises(BadInput, match=said):
        place_cameras(sequence, known(cameras), NO_POINTS)
    assert (sequence.folder / "frames.parquet").read_bytes() == before and not sequence.sparse.exists()


def test_rounded_rotations_are_made_exact_and_the_camera_stays_where_it_is(sequence):
    rounded = {}
    for name, c in named().items():
        R = np.round(c.R, 3)
        rounded[name] = replace(c, R=R, t=-R @ c.centre)
    details = place_cameras(sequence, known(rounded), NO_POINTS)
    scale, centre = sequence.read_info().input_scale, np.array(details["object"]["centre"])
    for frame, true in zip(sequence.read_frames(), CAMERAS, strict=True):
        np.testing.assert_allclose(frame.camera.R @ frame.camera.R.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(frame.camera.centre / scale, true.centre - centre, atol=1e-5)


def test_cameras_of_another_convention_are_refused_by_the_images(sequence):
    wrong = {}
    for name, c in named().items():  # OpenGL axes taken for OpenCV's
        R = np.diag([1.0, -1, -1]) @ c.R
        wrong[name] = replace(c, R=R, t=-R @ c.centre)
    with pytest.raises(BadInput, match=r"the images contradict the cameras: .* px .median.*OpenGL"):
        place_cameras(sequence, known(wrong), CONFIG)
    assert not sequence.sparse.exists() and not list(sequence.folder.glob(".*"))
    assert place_cameras(sequence, known(wrong), NO_POINTS)["n_registered"] == 9, "but not where nothing is checked"


def test_an_inexact_focal_length_is_a_warning(sequence):
    inexact = {}
    for name, c in named().items():
        K = c.K.copy()
        K[[0, 1], [0, 1]] *= 1.15
        inexact[name] = replace(c, K=K)
    (warning,) = place_cameras(sequence, known(inexact), CONFIG)["warnings"]
    assert "px (median) from the lines" in warning and "focal length" in warning


def test_images_without_texture_leave_the_cameras_believed(sequence):
    from pipeline.sequence import write_image

    for frame in sequence.read_frames():
        write_image(sequence.folder / frame.image, np.full((240, 320, 3), 90, np.uint8))
    details = place_cameras(sequence, known(named()), CONFIG)
    assert details["n_points"] == 0 and "too few to say" in details["warnings"][0]
    assert details["object"]["method"] == "masks, without points"


# --- where points come from -------------------------------------------------------------------------------------------


def test_without_points_the_object_is_where_the_masks_are_or_the_axes_meet(sequence):
    details = place_cameras(sequence, known(named()), NO_POINTS)
    assert "0 points: stereo depth and GrabCut need them" in details["warnings"][0]
    assert details["n_points"] == 0 and details["object"]["method"] == "masks, without points"
    # the box's half sides are 0.9, 0.65 and 0.75
    assert np.linalg.norm(details["object"]["centre"]) < 0.2 and 0.75 < details["object"]["radius"] < 1.4
    frames = sequence.read_frames()
    for frame in frames:
        frame.mask = None
    sequence.write_frames(frames)
    details = place_cameras(sequence, known(named()), NO_POINTS)
    assert details["object"]["method"] == "optical axes, without points"
    assert np.linalg.norm(details["object"]["centre"]) < 0.4 and 0.4 < details["object"]["radius"] < 2
    assert len(colmap.read_points(sequence)) == 0


def test_given_points_are_seen_by_the_views_that_show_them(sequence):
    rng = np.random.default_rng(0)
    axis, side = rng.integers(0, 3, 4000), rng.choice([-1.0, 1.0], 4000)
    xyz = rng.uniform(-1, 1, (4000, 3))
    xyz[np.arange(4000), axis] = side
    xyz *= Scene("box").box
    rgb = np.full((4000, 3), 7, np.uint8)
    xyz[0] = np.nan
    config = replace(CONFIG, known_points="given")
    details = place_cameras(sequence, known(named(), xyz=xyz, rgb=rgb), config)
    points = colmap.read_points(sequence)
    assert 1000 < len(points) == details["n_points"] <= 3999 and (points.rgb == 7).all()
    scale, centre = sequence.read_info().input_scale, np.array(details["object"]["centre"])
    back = points.xyz / scale + centre
    half = np.array(Scene("box").box)
    assert (np.abs(np.abs(back) - half).min(axis=1) < 1e-5).all()
    normal = np.where(np.abs(np.abs(back) - half) < 1e-5, np.sign(back), 0)
    seen = points.point_index[points.frame == 4]
    facing = (normal[seen] * (CAMERAS[4].centre - back[seen])).sum(axis=1) > 0
    assert len(seen) > 500 and facing.mean() > 0.8, "what is behind the box is not seen"
    assert "mean_error_px" not in details, "points that were not measured have no error"
    assert place_cameras(sequence, known(named()), config)["points"] == "triangulated", "where none came"


def test_views_are_matched_with_their_neighbours_on_the_orbit():
    cameras = orbit(24, wobble=0.0)
    pairs = posed_pairs(cameras, (1, 2))
    expected = {tuple(sorted((i, (i + gap) % 24))) for i in range(24) for gap in (1, 2)}
    assert set(pairs) == expected
    order = np.random.default_rng(0).permutation(24)
    shuffled = posed_pairs([cameras[i] for i in order], (1, 2))
    assert expected <= {tuple(sorted((int(order[a]), int(order[b])))) for a, b in shuffled}


# --- the sequence as a COLMAP project ---------------------------------------------------------------------------------


def read_database(sequence: Sequence) -> tuple[dict[int, str], dict[int, int], int]:
    """Names and numbers of features by image id, and the number of verified pairs."""
    with pycolmap.Database.open(sequence.folder / "database.db") as db:
        images = db.read_all_images()
        features = {image.image_id: db.num_keypoints_for_image(image.image_id) for image in images}
        assert {frame.frame_id for frame in db.read_all_frames()} == set(features)
        return {image.image_id: image.name for image in images}, features, db.num_verified_image_pairs()


def test_a_sequence_with_frames_alone_is_a_project(sequence):
    size = write_project(sequence, sequence.read_frames())
    names, features, pairs = read_database(sequence)
    assert list(names.values()) == [f"{i:06d}.jpg" for i in range(9)] and set(features.values()) == {0}
    assert pairs == 0 and 0 < size < 1
    assert (sequence.folder / "project.ini").read_text() == "database_path=database.db\nimage_path=images\n"
    assert sorted(p.name for p in sequence.folder.iterdir() if "database" in p.name) == ["database.db"]


@pytest.mark.parametrize("config", [CONFIG, NO_POINTS])
def test_the_database_and_the_model_speak_of_the_same_images(sequence, config):
    frames = sequence.read_frames()
    frames[2].image, frames[2].dropped = None, "blurred"
    sequence.write_frames(frames)
    cameras = {name: camera for name, camera in named().items() if name != NAMES[5]}
    details = place_cameras(sequence, known(cameras), config)
    names, features, pairs = read_database(sequence)
    model = pycolmap.Reconstruction(sequence.sparse)
    assert {i: image.name for i, image in model.images.items()}.items() <= names.items()
    assert set(names.values()) - {image.name for image in model.images.values()} == {"000005.jpg"}
    assert "000002.jpg" not in names.values() and details["database_mib"] > 0
    if config is CONFIG:
        assert pairs > 5 and all(len(image.points2D) == features[i] > 50 for i, image in model.images.items())
    assert sorted(p.name for p in sequence.folder.iterdir() if "database" in p.name) == ["database.db"]


def test_a_reconstruction_leaves_the_database_of_its_best_attempt(sequence):
    details = reconstruct(sequence, replace(CONFIG, camera_model="PINHOLE"))
    names, features, pairs = read_database(sequence)
    images = pycolmap.Reconstruction(sequence.sparse).images
    assert len(images) == details["n_registered"] >= 5 and pairs > 5 and details["database_mib"] > 0
    assert all(names[i] == image.name and len(image.points2D) == features[i] for i, image in images.items())


def test_the_database_may_be_left_out(sequence):
    write_project(sequence, sequence.read_frames())
    details = place_cameras(sequence, known(named()), replace(NO_POINTS, keep_database=False))
    assert "database_mib" not in details
    assert not (sequence.folder / "database.db").exists() and not (sequence.folder / "project.ini").exists()


def test_a_database_that_is_still_open_is_copied_whole_and_an_interrupted_copy_leaves_the_old_one(sequence, tmp_path):
    write_project(sequence, sequence.read_frames())
    before = (sequence.folder / "database.db").read_bytes()
    source = tmp_path / "other.db"
    colmap.enter_images(source, {4: (320, 240)})
    with closing(sqlite3.connect(source)) as writer:
        writer.execute("PRAGMA journal_mode=WAL")
        writer.execute("UPDATE images SET name = 'in the journal.jpg'")
        writer.commit()
        assert source.with_name("other.db-wal").stat().st_size > 0
        write_project(sequence, sequence.read_frames(), source)
    assert list(read_database(sequence)[0].values()) == ["in the journal.jpg"]
    (sequence.folder / "database.db").write_bytes(before)
    source.write_bytes(b"no database")
    with pytest.raises(sqlite3.DatabaseError):
        write_project(sequence, sequence.read_frames(), source)
    assert (sequence.folder / "database.db").read_bytes() == before
    assert not list(sequence.folder.glob(".*"))


@pytest.mark.captures
@pytest.mark.skipif(not CAPTURES.is_dir(), reason="no real captures here")
def test_the_images_of_a_real_capture_confirm_its_cameras(tmp_path):
    from pipeline.inputs.frames import FramesConfig, extract_frames
    from pipeline.inputs.sources import Source

    source = Source(CAPTURES / "fox/images", "fox", "photos")
    sequence = Sequence(tmp_path / "fox")
    extract_frames(source, sequence, FramesConfig(long_side=640, every=5))
    details = reuse_cameras(sequence, CAPTURES / "fox/cameras.json", SfmConfig())
    assert details["n_registered"] == len([f for f in sequence.read_frames() if f.image]) >= 9
    assert details["match_error_px"] < 1 and details["n_points"] > 200 and details["warnings"] == []


@pytest.mark.parametrize("key", ["a.jpg", "images/a.jpg", "a"])
def test_photos_that_differ_in_their_suffix_only_never_share_a_camera(key):
    frames = [Frame(0, "a.jpg", 8, 6), Frame(1, "a.png", 8, 6), Frame(2, "b.jpg", 8, 6)]
    arguments: dict[str, Any] = {"by_number": False, "folder": Path("photos"), "where": "cameras.json"}
    assert match_names(["a.png", "a.jpg", "b"], frames, **arguments) == {0: "a.jpg", 1: "a.png", 2: "b"}
    if key == "a":
        with pytest.raises(BadInput, match=r"'a' may belong to several frames: 'a.jpg', 'a.png'"):
            match_names([key, "b"], frames, **arguments)
    else:
        assert match_names([key, "b"], frames, **arguments) == {0: key, 2: "b"}
