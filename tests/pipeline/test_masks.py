from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_media import encode, pan, with_orientation, write_photos, write_video

from dope.common.errors import BadInput
from pipeline.inputs.frames import FramesConfig, extract_frames
from pipeline.inputs.sources import Source, find_sources
from pipeline.masks.imported import MasksConfig, import_masks
from pipeline.masks.mask_io import read_mask_values
from pipeline.sequence import Sequence

N, HEIGHT, WIDTH = 6, 128, 192


def disc(height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    inside = ((x + 0.5) / width - 0.4) ** 2 + (((y + 0.5) / height - 0.55) / 1.3) ** 2 < 0.04
    return np.asarray(inside)


def photos(tmp_path: Path, **settings: object) -> Sequence:
    folder = write_photos(tmp_path / "a", pan(N, WIDTH, HEIGHT))
    sequence = Sequence(tmp_path / "out/a")
    extract_frames(Source(folder, "a", "photos"), sequence, FramesConfig(**settings))  # type: ignore[arg-type]
    return sequence


def put(folder: Path, images: list[np.ndarray], name: str = "IMG_{:04d}.png", first: int = 0) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i, image in enumerate(images, first):
        assert cv2.imwrite(str(folder / name.format(i)), image)
    return folder


def png(height: int, width: int, depth: int, colour: int, rows: list[bytes], extra: bytes = b"") -> bytes:
    """A PNG written by hand, for the kinds that OpenCV reads but does not write."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    data = chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row for row in rows)))
    palette = chunk(b"PLTE", extra) if extra else b""
    return b"\x89PNG\r\n\x1a\n" + header + palette + data + chunk(b"IEND", b"")


def kinds() -> dict[str, bytes]:
    """One mask in all the ways that tools write it."""
    mask = disc()
    grey = mask.astype(np.uint8) * 255
    bits = [np.packbits(row).tobytes() for row in mask]
    indices = [row.astype(np.uint8).tobytes() for row in mask]
    return {
        "1 bit": png(HEIGHT, WIDTH, 1, 0, bits),
        "8 bit": encode(grey, ".png"),
        "16 bit": encode(grey.astype(np.uint16) * 257, ".png"),
        "labels 0 and 1": encode(mask.astype(np.uint8), ".png"),
        "labels 0 and 3, 16 bit": encode(mask.astype(np.uint16) * 3, ".png"),
        "colour": encode(np.dstack([grey * 0, grey * 0, grey]), ".png"),
        "cut-out (alpha)": encode(np.dstack([grey * 0 + 70] * 3 + [grey]), ".png"),
        "opaque colour": encode(np.dstack([grey] * 3 + [grey * 0 + 255]), ".png"),
        "palette": png(HEIGHT, WIDTH, 8, 3, indices, bytes([0, 0, 0, 128, 0, 0])),
        "jpeg": encode(grey, ".jpg"),
    }


@pytest.mark.parametrize("kind", kinds())
def test_masks_of_any_kind_become_the_same(tmp_path: Path, kind: str) -> None:
    sequence = photos(tmp_path)
    suffix = ".jpg" if kind == "jpeg" else ".png"
    (tmp_path / "m").mkdir()
    for i in range(N):
        (tmp_path / f"m/IMG_{i:04d}{suffix}").write_bytes(kinds()[kind])
    details = import_masks(sequence, tmp_path / "m", MasksConfig())
    assert details == {"masks": N, "missing": 0, "empty": 0, "mean_share": pytest.approx(disc().mean(), abs=5e-4)}
    for row in sequence.read_frames():
        assert row.mask == f"masks/{row.frame:06d}.png"
        stored = cv2.imread(str(sequence.folder / row.mask), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.uint8 and set(np.unique(stored)) == {0, 255}
        assert (sequence.read_mask(row) != disc()).mean() < (0.005 if kind == "jpeg" else 1e-9)


def test_soft_masks_are_cut_at_the_threshold(tmp_path: Path) -> None:
    sequence = photos(tmp_path)
    soft = np.tile(np.linspace(0, 255, WIDTH).astype(np.uint8), (HEIGHT, 1))
    folder = put(tmp_path / "m", [soft] * N)
    for threshold in (0.25, 0.5, 0.75):
        import_masks(sequence, folder, MasksConfig(threshold=threshold))
        mask = sequence.read_mask(sequence.read_frames()[0])
        assert mask is not None and mask.mean() == pytest.approx(1 - threshold, abs=0.01)


def test_a_dim_mask_among_bright_ones_is_not_taken_for_labels(tmp_path: Path) -> None:
    bright = disc().astype(np.uint8) * 255
    dim = np.full_like(bright, 3)  # a network that saw nothing
    details = import_masks(photos(tmp_path), put(tmp_path / "m", [dim, *[bright] * (N - 1)]), MasksConfig())
    assert details["empty"] == 1 and details["empty_frames"] == ["IMG_0000.jpg"]


def test_source_size_and_stored_size_both_fit(tmp_path: Path) -> None:
    sequence = photos(tmp_path, long_side=96)
    expected = disc(64, 96)
    for height, width in ((HEIGHT, WIDTH), (64, 96)):
        masks = put(tmp_path / f"m{width}", [disc(height, width).astype(np.uint8) * 255] * N)
        import_masks(sequence, masks, MasksConfig())
        mask = sequence.read_mask(sequence.read_frames()[3])
        assert mask is not None and mask.shape == (64, 96) and (mask != expected).mean() < 0.005


def test_masks_drawn_on_lying_pixels_are_turned_like_their_photo(tmp_path: Path) -> None:
    frames = pan(N, WIDTH, HEIGHT)
    (tmp_path / "a").mkdir()
    for i, frame in enumerate(frames):
        (tmp_path / f"a/{i}.jpg").write_bytes(with_orientation(encode(frame), 6))
    masks = put(tmp_path / "m", [disc().astype(np.uint8) * 255] * N, "{}.png")
    sequence = Sequence(tmp_path / "out/a")
    extract_frames(Source(tmp_path / "a", "a", "photos", masks=masks), sequence, FramesConfig())
    mask = sequence.read_mask(sequence.read_frames()[0])
    np.testing.assert_array_equal(mask, np.rot90(disc(), -1))


def test_masks_of_another_size_are_errors_that_name_both(tmp_path: Path) -> None:
    sequence = photos(tmp_path)
    folder = put(tmp_path / "m", [disc().astype(np.uint8) * 255] * N)
    wrong = put(folder, [disc(100, 192).astype(np.uint8) * 255], first=2) / "IMG_0002.png"
    with pytest.raises(BadInput) as caught:
        import_masks(sequence, folder, MasksConfig())
    assert all(part in str(caught.value) for part in (str(wrong), "192x100", "192x128"))
    wrong.write_bytes(wrong.read_bytes()[:100])
    with pytest.raises(BadInput, match=r"IMG_0002\.png: is cut off"):
        import_masks(sequence, folder, MasksConfig())
    assert not sequence.masks.exists() and all(row.mask is None for row in sequence.read_frames())


def test_missing_masks_are_listed(tmp_path: Path) -> None:
    sequence = photos(tmp_path)
    folder = put(tmp_path / "m", [disc().astype(np.uint8) * 255] * (N - 2))
    details = import_masks(sequence, folder, MasksConfig())
    assert details["missing_frames"] == ["IMG_0004.jpg", "IMG_0005.jpg"] and details["masks"] == N - 2
    assert [row.mask is None for row in sequence.read_frames()] == [False] * 4 + [True] * 2
    cases = {"none": "no mask belongs", "zero": "all masks are empty", "absent": "no such folder"}
    put(tmp_path / "none", [disc().astype(np.uint8)], "other_{}.png")
    put(tmp_path / "zero", [disc().astype(np.uint8) * 0] * N)
    for name, part in cases.items():
        with pytest.raises(BadInput, match=part):
            import_masks(sequence, tmp_path / name, MasksConfig())
    assert sequence.read_mask(sequence.read_frames()[0]) is not None, "what was there before stays"


def test_colmaps_names_are_known(tmp_path: Path) -> None:
    folder = put(tmp_path / "m", [disc().astype(np.uint8) * 255] * N, "IMG_{:04d}.jpg.png")
    assert import_masks(photos(tmp_path), folder, MasksConfig())["masks"] == N


@pytest.mark.parametrize("name", ["{:06d}.png", "frame_{:04d}.png", "take2_{}.png"])
def test_masks_of_a_video_go_by_frame_number(tmp_path: Path, name: str) -> None:
    video = write_video(tmp_path / "a.mp4", pan(20, WIDTH, HEIGHT))
    masks = [np.zeros((HEIGHT, WIDTH), np.uint8) for _ in range(20)]
    for i, mask in enumerate(masks):
        mask[:, : 4 * i + 4] = 255
    source = Source(video, "a", "video", masks=put(tmp_path / "m", masks, name))
    sequence = Sequence(tmp_path / "out/a")
    details = extract_frames(source, sequence, FramesConfig(every=3))
    assert details["masks"]["masks"] == details["kept"] == 7
    for row in sequence.read_frames():
        mask = sequence.read_mask(row)
        assert mask is not None and mask[0].sum() == 4 * int(row.source_name) + 4


def test_two_masks_of_one_video_frame_are_refused(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", pan(20, WIDTH, HEIGHT))
    sequence = Sequence(tmp_path / "out/a")
    extract_frames(Source(video, "a", "video"), sequence, FramesConfig(every=3))
    folder = put(tmp_path / "m", [disc().astype(np.uint8) * 255] * 20, "frame_{:06d}_obj_0.png")
    with pytest.raises(BadInput) as caught:
        import_masks(sequence, folder, MasksConfig())
    for part in (str(folder), "frame_000000_obj_0.png and frame_000001_obj_0.png are both masks of frame 0"):
        assert part in str(caught.value)
    assert not sequence.masks.exists()


def test_taking_frames_again_without_masks_leaves_no_old_ones(tmp_path: Path) -> None:
    sequence = photos(tmp_path)
    import_masks(sequence, put(tmp_path / "m", [disc().astype(np.uint8) * 255] * N), MasksConfig())
    photos(tmp_path)
    assert not sequence.masks.exists() and all(row.mask is None for row in sequence.read_frames())


@pytest.mark.captures
def test_real_masks(tmp_path: Path) -> None:
    captures = Path(__file__).parents[2].parent / "shared/data/captures"
    if not captures.is_dir() or os.environ.get("CI") == "true":
        pytest.skip("the real captures are not here")
    (source,), errors = find_sources([captures / "espresso"], masks="{}/masks")
    assert not errors
    sequence = Sequence(tmp_path / "espresso")
    assert extract_frames(source, sequence, FramesConfig())["masks"]["masks"] == 7
    lying = read_mask_values(captures / "espresso/masks/PXL_20210526_204034523.png") > 0.5
    np.testing.assert_array_equal(sequence.read_mask(sequence.read_frames()[6]), np.rot90(lying, -1))
