"""What is known of a lens: EXIF, the command line, and the cameras that reconstruction starts from."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from tiny_media import pan, write_photos

from dope.common import settings
from dope.common.errors import BadInput, UsageError
from pipeline.cameras import colmap
from pipeline.cameras.colmap.base import opened
from pipeline.cameras.config import SfmConfig
from pipeline.cameras.intrinsics import parse_intrinsics, starting_lenses
from pipeline.inputs.exif import Exif, focal_from_35mm, read_exif
from pipeline.inputs.frames import FramesConfig, extract_frames
from pipeline.inputs.photos import read_photo
from pipeline.inputs.sources import Source
from pipeline.sequence import Frame, Sequence, write_image


def exif_block(order: str, main: dict[int, object], inner: dict[int, object]) -> bytes:
    """A TIFF of two directories; whole numbers are shorts, pairs are rationals."""

    def directory(tags: dict[int, object], at: int) -> bytes:
        entries, tail = b"", b""
        tail_at = at + 2 + 12 * len(tags) + 4
        for tag, value in sorted(tags.items()):
            if isinstance(value, tuple):
                entries += struct.pack(order + "HHII", tag, 5, 1, tail_at + len(tail))
                tail += struct.pack(order + "II", *value)
            elif tag == 0x8769:
                entries += struct.pack(order + "HHII", tag, 4, 1, value)
            else:
                entries += struct.pack(order + "HHIHH", tag, 3, 1, value, 0)
        return struct.pack(order + "H", len(tags)) + entries + b"\0" * 4 + tail

    inner_at = 8 + 2 + 12 * (len(main) + 1) + 4 + 8 * sum(isinstance(v, tuple) for v in main.values())
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    return head + directory({**main, 0x8769: inner_at}, 8) + directory(inner, inner_at)


def with_exif(jpeg: bytes, block: bytes) -> bytes:
    segment = b"Exif\0\0" + block
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_35mm_equivalent_becomes_pixels_along_the_diagonal(order):
    exif = read_exif(exif_block(order, {0x0112: 6}, {0xA405: 26, 0x920A: (425, 100)}))
    assert (exif.orientation, exif.focal_35mm, exif.focal_mm) == (6, 26.0, 4.25)
    expected = 26 * 5000 / np.hypot(36, 24)
    assert exif.focal_px(4000, 3000) == pytest.approx(expected) == exif.focal_px(3000, 4000)


def test_a_sensor_resolution_becomes_pixels_of_the_photo_as_it_is_now():
    tags = {0x920A: (50, 1), 0xA20E: (200000, 36), 0xA210: 3, 0xA002: 20000, 0xA003: 13333}
    exif = read_exif(exif_block("<", {}, tags))
    assert exif.focal_px(20000, 13333) == pytest.approx(50 * 200000 / 360)  # 5,555 px a cm on 36 mm
    assert exif.focal_px(1000, 667) == pytest.approx(50 * 200000 / 360 / 20)


@pytest.mark.parametrize(
    "tags", [{0xA405: 0}, {0x920A: (425, 0), 0xA20E: (100, 1)}, {0x920A: (425, 100)}, {0xA405: 60000}, {}]
)
def test_nonsense_in_exif_is_no_focal_length(tags):
    assert read_exif(exif_block("<", {}, tags)).focal_px(640, 480) is None


def test_damaged_exif_is_never_an_error():
    block = exif_block("<", {0x0112: 3}, {0xA405: 26, 0x920A: (425, 100)})
    for cut in range(len(block)):
        read_exif(block[:cut])
    rng = np.random.default_rng(0)
    for _ in range(300):
        broken = bytearray(block)
        broken[rng.integers(8, len(block))] = rng.integers(256)
        exif = read_exif(bytes(broken))
        assert 1 <= exif.orientation <= 8
        exif.focal_px(640, 480)
    assert read_exif(b"") == read_exif(b"XX" + block[2:]) == Exif()
    signed = block.replace(struct.pack("<HHI", 0x8769, 4, 1), struct.pack("<HHI", 0x8769, 9, 1))
    at = signed.index(struct.pack("<HHI", 0x8769, 9, 1)) + 8
    for place in (-1, -3, -len(block), -(2**31)):  # a directory before the block
        read_exif(signed[:at] + struct.pack("<i", place) + signed[at + 4 :])


def test_a_photo_tells_its_focal_length_at_the_size_that_is_stored(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "photo.jpg"
    write_image(path, rng.integers(0, 255, (300, 400, 3), dtype=np.uint8))
    assert read_photo(path, 1000).focal_px is None
    path.write_bytes(with_exif(path.read_bytes(), exif_block(">", {0x0112: 6}, {0xA405: 26})))
    photo = read_photo(path, 200)
    assert photo.image.shape == (200, 150, 3) and photo.focal_px == pytest.approx(26 * 250 / np.hypot(36, 24))


def test_the_focal_length_of_photos_goes_from_their_exif_into_the_database(tmp_path):
    folder = write_photos(tmp_path / "photos", pan(6))
    for path in folder.iterdir():
        path.write_bytes(with_exif(path.read_bytes(), exif_block("<", {}, {0xA405: 26})))
    sequence = Sequence(tmp_path / "work")
    extract_frames(Source(folder, "photos", "photos"), sequence, FramesConfig(long_side=96))
    frames = sequence.read_frames()
    expected = pytest.approx(26 * np.hypot(96, 64) / np.hypot(36, 24))
    assert [row.focal_px_prior for row in frames] == [expected] * 6
    for config, n_known in ((SfmConfig(), 1), (SfmConfig(exif_focal=False), 0)):
        database = tmp_path / f"{n_known}.db"
        colmap.import_images(database, sequence.images, starting_lenses(frames, config))
        with opened(database) as db:
            (camera,) = db.read_all_cameras()
        assert camera.has_prior_focal_length == bool(n_known) and (camera.mean_focal_length() == expected) == n_known


def frame(number: int, *, prior: float | None = None, size: tuple[int, int] = (640, 480), source: int = 1) -> Frame:
    row = Frame(number, f"{number}.jpg", *size, image=f"images/{number:06d}.jpg")
    row.source_width, row.source_height, row.focal_px_prior = size[0] * source, size[1] * source, prior
    return row


def test_frames_of_one_exif_focal_length_share_a_camera_and_those_without_any_join_the_usual_one():
    frames = [frame(0, prior=500.0), frame(1, prior=900.0), frame(2), frame(3, prior=500.0)]
    first, second = starting_lenses(frames, SfmConfig())
    assert (first.focal_px, second.focal_px, first.model) == (500.0, 900.0, "SIMPLE_RADIAL")
    assert first.names == ("000000.jpg", "000002.jpg", "000003.jpg") and second.names == ("000001.jpg",)
    (only,) = starting_lenses(frames, SfmConfig(exif_focal=False))
    assert only.focal_px is None and len(only.names) == 4
    assert len(starting_lenses(frames, SfmConfig(share_camera=False))) == 4


def test_a_given_focal_length_goes_before_exif():
    frames = [frame(0, prior=500.0)]
    assert starting_lenses(frames, SfmConfig(focal_mm=26.0))[0].focal_px == focal_from_35mm(26.0, 640, 480)
    assert starting_lenses(frames, SfmConfig(focal_factor=2.0))[0].focal_px == 1280


def test_known_intrinsics_are_scaled_to_the_stored_size_and_enter_the_database(tmp_path):
    config = SfmConfig(intrinsics=(1300.0, 1310.0, 650.0, 470.0, 0.1, -0.02, 0.001, 0.002))
    frames = [frame(number, source=2) for number in range(3)]
    (lens,) = starting_lenses(frames, config)
    expected = (650.0, 655.0, 325.0, 235.0, 0.1, -0.02, 0.001, 0.002)
    assert lens.model == "OPENCV" and lens.params == expected
    for row in frames:
        write_image(tmp_path / row.image, np.zeros((480, 640, 3), np.uint8))
    colmap.import_images(tmp_path / "a.db", tmp_path / "images", [lens])
    with opened(tmp_path / "a.db") as db:
        (camera,) = db.read_all_cameras()
        assert tuple(camera.params) == pytest.approx(expected) and camera.has_prior_focal_length


def test_intrinsics_of_another_image_size_are_refused():
    with pytest.raises(BadInput, match=r"principal point \(960, 540\) lies outside the image of 640x480"):
        starting_lenses([frame(0)], SfmConfig(intrinsics=(1400.0, 1400.0, 960.0, 540.0)))


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([700, 700, 320], "3 numbers"),
        ([700, 700, 320, 240, 0, 0, 0], "7 numbers"),
        ([-700, 700, 320, 240], "above 0"),
        ([700, 700, 320, -1], "from the image's corner"),
        ([0.8, 0.8, 0.5, 0.5], "pixels of the source image"),
        ([700, 700, float("nan"), 240], "not finite"),
    ],
)
def test_nonsense_on_the_command_line_is_a_usage_error(values, said):
    with pytest.raises(UsageError, match=said):
        settings.override(SfmConfig(), [f"intrinsics={values}".replace("nan", ".nan")])


def test_a_camera_model_must_hold_the_known_intrinsics():
    for model, values in (("SIMPLE_RADIAL", (700.0, 710.0, 320.0, 240.0)), ("PINHOLE", (7e2, 7e2, 3e2, 2e2, 0.1))):
        with pytest.raises(UsageError, match=model):
            SfmConfig(camera_model=model, intrinsics=values)
    with pytest.raises(UsageError, match="not one of auto, SIMPLE_PINHOLE"):
        settings.override(SfmConfig(), ["camera_model=FISHEYE"])
    with pytest.raises(UsageError, match="intrinsics and focal_mm"):
        SfmConfig(intrinsics=(700.0, 700.0, 320.0, 240.0), focal_mm=26.0)
    with pytest.raises(UsageError, match="'1;2' is not fx,fy"):
        parse_intrinsics("1;2")
