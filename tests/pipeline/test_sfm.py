"""Structure from motion on images made here, with cameras that are known to the last digit."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dope.common.errors import BadInput
from dope.common.seeds import generator
from pipeline.cameras import colmap, model_checks
from pipeline.cameras.compare import compare_cameras, read_reference
from pipeline.cameras.sfm import SfmConfig, reconstruct
from pipeline.geometry import Camera, similarity_between
from pipeline.sequence import Frame, Sequence, SequenceInfo, read_image, write_image

CAPTURES = Path(__file__).parents[2].parent / "shared/data/captures"
SIZE = 320
K = np.array([[450.0, 0, SIZE / 2], [0, 450.0, SIZE / 2], [0, 0, 1]])  # the first guess is 1.2 * 320 = 384


def texture(seed: int, size: int = 240) -> np.ndarray:
    """Blobs of many sizes, so that every scale has features."""
    rng = generator(seed, "texture")
    image = np.zeros((size, size, 3))
    for cell in (4, 8, 16, 32):
        noise = rng.normal(size=(size // cell, size // cell, 3)) * cell**0.4
        image += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * image, 0, 255).astype(np.uint8)


def box(seed: int, half: float = 1.0) -> list[tuple[np.ndarray, np.ndarray]]:
    """Faces of a textured box: corners (4, 3) in the texture's order, and the texture."""
    square = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
    faces = []
    for axis in range(3):
        for side in (-half, half):
            corners = np.insert(square, axis, side, axis=1)
            faces.append((corners, texture(10 * seed + 2 * axis + (side > 0))))
    return faces


def look_at(position: np.ndarray, target: np.ndarray) -> Camera:
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0.0, -1.0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return Camera(SIZE, SIZE, K, np.zeros(4), R, -R @ position)


def orbit(n: int, step_deg: float, distance: float = 4.2) -> list[Camera]:
    angles = np.radians(20 + step_deg * np.arange(n))
    height = 1.8 + 0.3 * np.sin(2 * angles)
    positions = np.stack([distance * np.cos(angles), distance * np.sin(angles), height], axis=1)
    return [look_at(position, np.zeros(3)) for position in positions]


def render(faces: list[tuple[np.ndarray, np.ndarray]], camera: Camera) -> np.ndarray:
    """The faces that look at the camera (convex body: no two of them overlap), by homography; pixel centres at +0.5."""
    image = np.full((SIZE, SIZE, 3), 40, np.uint8)
    for corners, picture in faces:
        middle = corners.mean(axis=0)
        if (camera.centre - middle) @ middle <= 0:
            continue
        size = picture.shape[0]
        source = np.array([[0, 0], [size, 0], [size, size], [0, size]], dtype=np.float32) - 0.5
        target = (camera.project(corners)[0] - 0.5).astype(np.float32)
        H = cv2.getPerspectiveTransform(source, target)
        warped = cv2.warpPerspective(picture, H, (SIZE, SIZE), flags=cv2.INTER_LINEAR)
        inside = cv2.warpPerspective(np.full((size, size), 255, np.uint8), H, (SIZE, SIZE)) > 127
        image[inside] = warped[inside]
    return image


def make_sequence(folder: Path, images: list[np.ndarray], masks: list[np.ndarray] | None = None, **info) -> Sequence:
    sequence = Sequence(folder)
    frames = []
    for number, image in enumerate(images):
        frame = Frame(number, f"view{number}.png", image.shape[1], image.shape[0], image=f"images/{number:06d}.jpg")
        write_image(folder / frame.image, image)
        if masks is not None:
            sequence.write_mask(frame, masks[number])
        frames.append(frame)
    sequence.write_frames(frames)
    sequence.write_info(SequenceInfo(folder.name, str(folder), "photos", n_frames=len(frames), **info))
    return sequence


def reference(cameras: list[Camera]) -> dict[str, Camera]:
    return {f"view{number}": camera for number, camera in enumerate(cameras)}


CAMERAS = orbit(12, 8.0)
CONFIG = SfmConfig(max_image_size=SIZE, fallback_image_size=SIZE)


@pytest.fixture(scope="module")
def box_images() -> list[np.ndarray]:
    return [render(box(1), camera) for camera in CAMERAS]


@pytest.fixture(scope="module")
def done(tmp_path_factory, box_images) -> tuple[Sequence, dict]:
    """A sequence of a box with a dropped frame in its midst, reconstructed as an ordered one."""
    sequence = make_sequence(tmp_path_factory.mktemp("sfm") / "box", box_images, ordered=True)
    frames = sequence.read_frames()
    frames[5].image, frames[5].dropped = None, "blurred"
    sequence.write_frames(frames)
    return sequence, reconstruct(sequence, CONFIG)


def test_the_cameras_of_a_box_are_found(done):
    sequence, details = done
    errors = compare_cameras(sequence.read_frames(), reference(CAMERAS))
    assert details["n_registered"] == 11 and details["registered_share"] == 1
    assert errors.relative_rotation_max_deg < 0.6 and errors.rotation_max_deg < 2
    assert errors.translation_max_percent < 1
    assert abs(sequence.read_frames()[0].fx / K[0, 0] - 1) < 0.08, "from a first guess that is 15% off"


def test_a_known_focal_length_is_kept(tmp_path, box_images):
    sequence = make_sequence(tmp_path / "known", box_images, ordered=True)
    reconstruct(sequence, replace(CONFIG, focal_factor=450 / SIZE, refine_focal=False))
    errors = compare_cameras(sequence.read_frames(), reference(CAMERAS))
    assert all(frame.fx == frame.fy == 450 for frame in sequence.registered_frames())
    assert errors.n_registered == 12 and errors.rotation_max_deg < 1


def test_what_is_written_agrees_with_itself(done):
    sequence, details = done
    frames, info = sequence.read_frames(), sequence.read_info()
    assert [frame.frame for frame in frames if not frame.registered] == [5]
    assert (info.n_registered, info.registered_share, info.unit) == (11, 1.0, "object radius")
    assert info.attempts[-1]["n_registered"] == 11 and info.attempts[-1]["verdict"] == "sensible"
    assert info.attempts[-1]["cpu_seconds"] > 0
    model = colmap.read_model(sequence.sparse)
    assert model.frames == [frame.frame for frame in frames if frame.registered]
    for number, camera in model.cameras().items():
        stored = frames[number].camera
        np.testing.assert_allclose(stored.R, camera.R, atol=1e-12)
        np.testing.assert_allclose(stored.t, camera.t, atol=1e-12)
        np.testing.assert_allclose(stored.distortion, camera.distortion)
    points = colmap.read_points(sequence)
    assert len(points) == details["n_points"] and len(points.point_index) == len(points.frame)
    for number in (0, 7):  # the points of a frame project into it
        own = points.xyz[points.point_index[points.frame == number]]
        pixels, depth = frames[number].camera.project(own)
        assert len(own) > 30 and (depth > 0).all()
        assert ((pixels > -3) & (pixels < SIZE + 3)).all()
    assert not [path.name for path in sequence.folder.iterdir() if "partial" in path.name]


def test_the_unit_is_the_objects_radius_and_the_origin_its_middle(done):
    sequence, _ = done
    frames = sequence.registered_frames()
    true = np.stack([CAMERAS[frame.frame].centre for frame in frames])
    world = similarity_between(np.stack([frame.camera.centre for frame in frames]), true)
    # only the side towards the cameras is seen: the middle of what is seen lies within the box, near the true middle
    assert np.linalg.norm(world.b) < 0.9
    assert 0.8 < world.s < 1.9, "between the box's half edge 1 and its half diagonal 1.73, with some slack"


def test_the_same_input_gives_the_same_bytes(done, tmp_path, box_images):
    sequence, _ = done
    again = make_sequence(tmp_path / "box", box_images, ordered=True)
    again.write_frames([replace(frame) for frame in _without_cameras(sequence.read_frames())])
    reconstruct(again, CONFIG)
    for name in ("frames.parquet", "sparse/points3D.bin", "sparse/images.bin", "sparse/cameras.bin"):
        assert (again.folder / name).read_bytes() == (sequence.folder / name).read_bytes(), name


def _without_cameras(frames: list[Frame]) -> list[Frame]:
    for frame in frames:
        frame.clear_camera()
    return frames


@pytest.fixture(scope="module")
def turntable() -> tuple[list[Camera], list[np.ndarray], list[np.ndarray]]:
    """An object that turns before a still background: cameras around the object, images, masks."""
    background = texture(77, SIZE)
    cameras = orbit(8, 9.0)
    images, masks = [], []
    for camera in cameras:
        image = render(box(2, half=0.8), camera)
        mask = (image != 40).any(axis=2)
        images.append(np.where(mask[..., None], image, background))
        masks.append(cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)
    return cameras, images, masks


@pytest.mark.parametrize("asked", [True, False])
def test_a_turntable_is_solved_with_masks_asked_for_or_not(tmp_path, turntable, asked):
    cameras, images, masks = turntable
    sequence = make_sequence(tmp_path / "turntable", images, masks, ordered=True)
    details = reconstruct(sequence, replace(CONFIG, mask_features=asked, max_rungs=1))
    errors = compare_cameras(sequence.read_frames(), reference(cameras))
    assert details["n_registered"] >= 7 and errors.relative_rotation_max_deg < 1
    assert details["object"]["method"] == "masks"
    if not asked:  # whole images were tried, and their model of the background was not believed
        assert re.search("nothing registers|frames register|hardly moves|moves by itself", details["warnings"][0])
        assert [attempt["masked"] for attempt in sequence.read_info().attempts][-1:] == [True]


def test_a_camera_that_only_turns_is_rejected(tmp_path):
    faces = box(3, half=6.0)  # seen from inside: all faces around the camera
    images = []
    for angle in np.radians(np.arange(7) * 5.0):
        camera = look_at(np.zeros(3), np.array([np.cos(angle), np.sin(angle), 0.1]))
        images.append(_panorama(faces, camera))
    sequence = make_sequence(tmp_path / "turning", images, ordered=True)
    with pytest.raises(BadInput, match=r"hardly moves|frames register") as caught:
        reconstruct(sequence, replace(CONFIG, max_rungs=2))
    assert "--mask-features" in str(caught.value)
    info = sequence.read_info()
    assert info.n_registered == 0 and info.attempts and not sequence.sparse.exists()
    assert all(attempt["verdict"] != "sensible" for attempt in info.attempts)


def _panorama(faces: list[tuple[np.ndarray, np.ndarray]], camera: Camera) -> np.ndarray:
    """The inside of a box from its middle, by looking up the face that each ray meets."""
    ys, xs = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = np.stack([(xs - SIZE / 2) / K[0, 0], (ys - SIZE / 2) / K[1, 1], np.ones_like(xs)], axis=-1) @ camera.R
    rays /= np.abs(rays).max(axis=-1, keepdims=True)  # onto the cube [-1, 1]^3
    axis = np.abs(rays).argmax(axis=-1)
    image = np.zeros((SIZE, SIZE, 3), np.uint8)
    for number, (_, picture) in enumerate(faces):
        face_axis, side = number // 2, 1 if number % 2 else -1
        here = (axis == face_axis) & (np.sign(np.take_along_axis(rays, axis[..., None], -1)[..., 0]) == side)
        uv = (np.delete(rays, face_axis, axis=-1) + 1) / 2 * (picture.shape[0] - 1)
        looked_up = cv2.remap(picture, uv[..., 0].astype(np.float32), uv[..., 1].astype(np.float32), cv2.INTER_LINEAR)
        image[here] = looked_up[here]
    return image


def test_equal_frames_are_rejected(tmp_path, box_images):
    sequence = make_sequence(tmp_path / "same", [box_images[0]] * 6)
    with pytest.raises(BadInput, match=r"nothing registers|hardly moves|frames register"):
        reconstruct(sequence, replace(CONFIG, max_rungs=2))


def test_frames_without_texture_are_rejected_and_old_cameras_forgotten(tmp_path):
    sequence = make_sequence(tmp_path / "blank", [np.full((SIZE, SIZE, 3), 90, np.uint8)] * 4)
    frames = sequence.read_frames()
    frames[0].set_camera(CAMERAS[0])
    sequence.write_frames(frames)
    with pytest.raises(BadInput, match="nothing registers: 0 of 4 frames"):
        reconstruct(sequence, CONFIG)
    assert not sequence.registered_frames()


def test_two_frames_are_too_few(tmp_path, box_images):
    with pytest.raises(BadInput, match="2 usable frames"):
        reconstruct(make_sequence(tmp_path / "two", box_images[:2]), CONFIG)


def test_two_objects_in_one_folder_keep_the_larger_and_say_so(tmp_path, box_images):
    others = [render(box(5), camera) for camera in orbit(6, 8.0)]
    sequence = make_sequence(tmp_path / "mixed", box_images[:9] + others)
    details = reconstruct(sequence, replace(CONFIG, max_rungs=1))
    assert details["n_registered"] == 9
    assert [frame.frame for frame in sequence.registered_frames()] == list(range(9))
    assert any("2 separate models of 9 and 6 frames" in text for text in details["warnings"])


def test_frames_of_two_sizes_get_two_cameras(tmp_path, box_images):
    images = [
        cv2.resize(im, (240, 240), interpolation=cv2.INTER_AREA) if i % 2 else im for i, im in enumerate(box_images)
    ]
    sequence = make_sequence(tmp_path / "sizes", images, ordered=True)
    reconstruct(sequence, CONFIG)
    for frame in sequence.registered_frames():
        assert (frame.camera.width, frame.camera.height) == (frame.width, frame.height)
        assert abs(frame.fx / frame.width / (K[0, 0] / SIZE) - 1) < 0.08
    assert len(sequence.registered_frames()) >= 11


def test_largest_angles_against_a_loop():
    rng = np.random.default_rng(0)
    group = np.sort(rng.integers(0, 40, 300))
    rays = rng.normal(size=(300, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    expected = [
        max(
            (np.degrees(np.arccos(np.clip(a @ b, -1, 1))) for a in rays[group == g] for b in rays[group == g]),
            default=0,
        )
        for g in range(41)
    ]
    np.testing.assert_allclose(model_checks.largest_angles_deg(rays, group, 41), expected, atol=1e-5)


@pytest.mark.captures
@pytest.mark.skipif(bool(os.environ.get("CI")) or not CAPTURES.is_dir(), reason="needs the captures in ../shared/data")
def test_a_real_video_of_a_fox(tmp_path):
    paths = sorted((CAPTURES / "fox/images").iterdir())[:24]
    sequence = make_sequence(tmp_path / "fox", [read_image(path) for path in paths], ordered=True)
    frames = sequence.read_frames()
    for frame, path in zip(frames, paths, strict=True):
        frame.source_name = path.name
    sequence.write_frames(frames)
    reconstruct(sequence, SfmConfig())
    errors = compare_cameras(sequence.read_frames(), read_reference(CAPTURES / "fox/cameras.json"))
    assert errors.n_registered >= 22 and errors.relative_rotation_median_deg < 0.5
