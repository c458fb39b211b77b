from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_media import encode, pan, texture, with_orientation, write_photos

from dope.common.errors import BadInput
from pipeline.inputs.frame_quality import QualityConfig, difference, look_at, neighbours_are_alike
from pipeline.inputs.frames import FramesConfig, extract_frames
from pipeline.inputs.photos import list_photos, read_jpeg_header, read_photo, turn_upright
from pipeline.inputs.sources import Source, find_sources, source_fingerprint
from pipeline.sequence import Sequence


def extract(folder: Path, out: Path, **settings: object) -> tuple[dict, Sequence]:
    sequence = Sequence(out / folder.name)
    config = FramesConfig(**settings)  # type: ignore[arg-type]
    return extract_frames(Source(folder, folder.name, "photos"), sequence, config), sequence


def test_photos_come_in_natural_order_and_jpegs_as_they_are(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "a", pan(12), "p{}.jpg")
    (folder / "notes.txt").write_text("no photo")
    (folder / ".hidden.jpg").write_bytes(b"no photo")
    details, sequence = extract(folder, tmp_path / "out")
    rows = sequence.read_frames()
    assert [row.source_name for row in rows] == [f"p{i}.jpg" for i in range(12)]
    assert details["kept"] == 12 and all(row.time_s is None for row in rows)
    for row in rows:
        assert (sequence.folder / str(row.image)).read_bytes() == (folder / row.source_name).read_bytes()


@pytest.mark.parametrize("suffix", [".png", ".webp", ".tiff", ".bmp", ".JPEG"])
def test_photos_of_all_kinds_are_stored_as_jpeg(tmp_path: Path, suffix: str) -> None:
    frames = pan(5)
    (tmp_path / "a").mkdir()
    for i, frame in enumerate(frames):
        (tmp_path / f"a/{i}{suffix}").write_bytes(encode(frame, suffix))
    _, sequence = extract(tmp_path / "a", tmp_path / "out")
    for row, frame in zip(sequence.read_frames(), frames, strict=True):
        stored = sequence.read_image(row)
        assert (sequence.folder / str(row.image)).read_bytes()[:2] == b"\xff\xd8"
        assert np.abs(stored.astype(int) - frame).mean() < 4


def test_sixteen_bit_grey_and_alpha_photos_are_stored_as_colour(tmp_path: Path) -> None:
    frames = pan(6)
    (tmp_path / "a").mkdir()
    for i, frame in enumerate(frames):
        grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        wide = grey.astype(np.uint16) * 257
        alpha = np.dstack([frame, np.full_like(grey, 9)])
        cv2.imwrite(str(tmp_path / f"a/{i}.png"), (grey, wide, alpha)[i % 3])
    _, sequence = extract(tmp_path / "a", tmp_path / "out")
    for row, frame in zip(sequence.read_frames(), frames, strict=True):
        grey = cv2.cvtColor(sequence.read_image(row), cv2.COLOR_BGR2GRAY)
        assert np.abs(grey.astype(int) - cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)).mean() < 4


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_honoured_at_every_size(tmp_path: Path, orientation: int) -> None:
    lying = cv2.GaussianBlur(texture(128, 256), (0, 0), 2)
    path = tmp_path / "a.jpg"
    path.write_bytes(with_orientation(encode(lying), orientation))
    upright = turn_upright(lying, orientation)
    for long_side in (512, 100, 20):  # as it is, decoded whole, decoded at an eighth
        photo = read_photo(path, long_side)
        assert photo.source_size == (upright.shape[1], upright.shape[0])
        height, width = photo.image.shape[:2]
        assert max(height, width) == min(long_side, 256) and width * upright.shape[0] == height * upright.shape[1]
        wanted = cv2.resize(upright, (width, height), interpolation=cv2.INTER_AREA)
        assert np.abs(photo.image.astype(int) - wanted).mean() < 4
        assert (photo.jpeg is not None) == (orientation == 1 and long_side == 512)


def test_decoding_small_keeps_the_pixel_grid(tmp_path: Path) -> None:
    """A grid of 8 px does not divide 260 x 196: a decoder that rounds sizes up would shift what it shows."""
    ramp = np.tile(np.linspace(20, 235, 260), (196, 1))
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), np.dstack([ramp] * 3).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 100])
    photo = read_photo(path, 20)
    assert photo.source_size == (260, 196) and photo.image.shape == (15, 20, 3)
    centres = (np.arange(20) + 0.5) / 20 * 260 - 0.5
    np.testing.assert_allclose(photo.image[7, :, 1], np.interp(centres, np.arange(260), ramp[0]), atol=1.5)


def test_what_a_jpeg_says_of_itself() -> None:
    data = encode(texture(48, 64))
    header = read_jpeg_header(with_orientation(data, 6) + b"\0" * 100 + b"a film a phone appended")
    assert header is not None
    assert (header.width, header.height, header.orientation, header.components) == (64, 48, 6, 3) and header.complete
    assert read_jpeg_header(encode(texture(48, 64), ".png")) is None
    thumbnail = encode(texture(16, 16))  # its own end marker must not count for the photo around it
    inside = data[:2] + b"\xff\xe2" + (len(thumbnail) + 2).to_bytes(2) + thumbnail + data[2:]
    for cut in range(3, len(inside) - 1, 7):
        header = read_jpeg_header(inside[:cut])
        assert header is not None and not header.complete, cut


def test_damaged_photos_are_rows_with_reasons(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "a", pan(10))
    names = sorted(path.name for path in folder.iterdir())
    cut, text, empty = (folder / names[i] for i in (2, 5, 7))
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size * 2 // 3])
    text.write_text("not an image")
    empty.write_bytes(b"")
    (folder / "IMG_9999.png").write_bytes(encode(texture(64, 64), ".png")[:3000])
    details, sequence = extract(folder, tmp_path / "out")
    dropped = {row.source_name: str(row.dropped) for row in sequence.read_frames() if row.dropped}
    assert set(dropped) == {cut.name, text.name, empty.name, "IMG_9999.png"}
    assert (
        "cut off" in dropped[cut.name] and "cut off" in dropped["IMG_9999.png"] and "not an image" in dropped[text.name]
    )
    assert details["kept"] == 7 and sum(details["dropped"].values()) == 4


def test_photos_of_kinds_that_cannot_be_read_are_told(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "a", pan(8))
    before = source_fingerprint(Source(folder, "a", "photos"))
    for name in ("x1.HEIC", "x2.heic", "raw.dng", "IMG_0003.CR2", ".hidden.heic"):
        (folder / name).write_bytes(b"data")
    details, sequence = extract(folder, tmp_path / "out")
    assert len(sequence.read_frames()) == details["kept"] == 8
    (warning,) = details["warnings"]  # IMG_0003 is there as a JPEG, too
    assert warning.startswith("1 DNG, 2 HEIC files were left out (raw.dng ...)") and "convert them to JPEG" in warning
    assert source_fingerprint(Source(folder, "a", "photos")) != before
    for path in list(folder.glob("*.jpg"))[:5]:
        path.unlink()
    with pytest.raises(BadInput, match=r"3 of 3 frames are usable.*HEIC files were left out.*convert them to JPEG"):
        extract(folder, tmp_path / "out")


def test_one_size_is_kept(tmp_path: Path) -> None:
    frames = pan(9)
    frames[1], frames[6] = np.rot90(frames[1]), frames[6][:100]
    details, sequence = extract(write_photos(tmp_path / "a", frames), tmp_path / "out")
    assert details["dropped"] == {"other size": 2}
    assert sequence.read_frames()[1].dropped == "other size (128x192, most are 192x128)"
    mixed = write_photos(tmp_path / "b", [frame[: 128 - 4 * i] for i, frame in enumerate(pan(9))])
    with pytest.raises(BadInput, match=r"1 of 9 frames are usable, 5 are needed \(8 other size\)"):
        extract(mixed, tmp_path / "out")


def test_copies_are_dropped_wherever_they_lie(tmp_path: Path) -> None:
    frames = pan(8)
    _, sequence = extract(write_photos(tmp_path / "a", [*frames, frames[2]]), tmp_path / "out")
    assert sequence.read_frames()[8].dropped == "near-duplicate of frame 2"


def test_small_photos_and_empty_folders_are_errors(tmp_path: Path) -> None:
    small = write_photos(tmp_path / "small", [frame[:40] for frame in pan(8)])
    with pytest.raises(BadInput, match="8 too small"):
        extract(small, tmp_path / "out")
    (tmp_path / "none").mkdir()
    with pytest.raises(BadInput, match="no photos"):
        extract(tmp_path / "none", tmp_path / "out")


def test_every_and_count_choose_photos(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "a", pan(24))
    for settings, kept in (({"every": 3}, 8), ({"count": 10}, 10), ({"count": 99}, 24), ({}, 24)):
        details, sequence = extract(folder, tmp_path / "out", **settings)
        assert details["kept"] == kept and details["frames"] == 24
        assert details["dropped"] == ({"not sampled": 24 - kept} if kept < 24 else {})
        assert len(list(sequence.images.iterdir())) == kept


def test_order_is_seen_in_the_pictures(tmp_path: Path) -> None:
    frames = pan(24, step=10)
    shuffled = [frames[i] for i in np.random.default_rng(0).permutation(24)]
    for name, shown, expected in (("way", frames, True), ("mixed", shuffled, False)):
        folder = write_photos(tmp_path / name, shown)
        assert extract(folder, tmp_path / "out")[0]["ordered"] is expected
        for ordered in ("yes", "no"):
            _, sequence = extract(folder, tmp_path / "out", ordered=ordered)
            assert sequence.read_info().ordered is (ordered == "yes")
    assert not neighbours_are_alike([look_at(frame) for frame in frames[:5]]), "too few to tell"


def test_flicker_is_no_motion_and_a_moved_part_is() -> None:
    picture = texture(128, 192)
    brighter = np.clip(picture * 1.05 + 4, 0, 255).astype(np.uint8)
    moved = picture.copy()
    moved[40:60, 60:80] = picture[43:63, 64:84]
    duplicate = QualityConfig().duplicate
    assert difference(look_at(picture), look_at(picture)) == 0
    assert difference(look_at(picture), look_at(brighter)) < duplicate < difference(look_at(picture), look_at(moved))


CAPTURES = Path(__file__).parents[2].parent / "shared/data/captures"


@pytest.mark.captures
@pytest.mark.parametrize("name, ordered", [("fox", True), ("co3d_apple", True), ("espresso", False)])
def test_real_captures(tmp_path: Path, name: str, ordered: bool) -> None:
    if not CAPTURES.is_dir() or os.environ.get("CI") == "true":
        pytest.skip("the real captures are not here")
    (source,), _ = find_sources([CAPTURES / name])
    sequence = Sequence(tmp_path / source.id)
    details = extract_frames(source, sequence, FramesConfig())
    assert details["kept"] == len(list_photos(source.path)) and details["ordered"] is ordered
