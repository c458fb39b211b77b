from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_media import index_first, pan, texture, with_rotation, write_video

from dope.common.errors import BadInput
from pipeline.inputs.frames import FramesConfig, extract_frames
from pipeline.inputs.sources import Source
from pipeline.inputs.videos import Windows
from pipeline.sequence import Sequence


def extract(path: Path, out: Path, **settings: object) -> tuple[dict, Sequence]:
    sequence = Sequence(out / path.stem)
    config = FramesConfig(**settings)  # type: ignore[arg-type]
    return extract_frames(Source(path, path.stem, "video"), sequence, config), sequence


def error_of(path: Path, out: Path, **settings: object) -> str:
    with pytest.raises(BadInput) as caught:
        extract(path, out, **settings)
    assert not (out / path.stem / "images").exists() and not (out / path.stem / "frames.parquet").exists()
    assert str(path) in str(caught.value), "the file is named"
    return str(caught.value)


@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".mkv", ".webm"])
def test_frames_come_upright_in_order_with_their_times(tmp_path: Path, suffix: str) -> None:
    frames = pan(24)
    details, sequence = extract(write_video(tmp_path / f"a{suffix}", frames), tmp_path / "out", every=3, candidates=1)
    rows = sequence.read_frames()
    numbers = [int(row.source_name) for row in rows]
    assert numbers == list(range(1, 24, 3)), "the middle of each window"
    np.testing.assert_allclose([row.time_s for row in rows], np.array(numbers) / 25, atol=2e-3)
    for row, number in zip(rows, numbers, strict=True):
        errors = [np.abs(sequence.read_image(row).astype(int) - frame).mean() for frame in frames]
        assert int(np.argmin(errors)) == number
    assert details["kept"] == details["frames"] == 8 and details["dropped"] == {} and details["warnings"] == []
    info = sequence.read_info()
    assert (info.kind, info.ordered, info.n_frames, info.source) == ("video", True, 8, str(tmp_path / f"a{suffix}"))
    assert (rows[0].width, rows[0].height, rows[0].source_width) == (192, 128, 192)


def test_the_sharpest_of_each_window_is_taken(tmp_path: Path) -> None:
    frames = pan(30)
    sharp = {2, 5, 11, 12, 19, 21, 28}
    video = [f if i in sharp else cv2.GaussianBlur(f, (0, 0), 4) for i, f in enumerate(frames)]
    _, sequence = extract(write_video(tmp_path / "a.mp4", video), tmp_path / "out", every=5)
    taken = [int(row.source_name) for row in sequence.read_frames()]
    assert set(taken) <= sharp and len(taken) == 6


def test_a_target_count_is_met_and_spread_evenly() -> None:
    for total, count in ((100, 60), (1800, 60), (61, 60), (10, 10)):
        windows = Windows(total / count, candidates=5)
        taken = [windows.window_of(i) for i in range(total)]
        assert sorted(set(taken)) == list(range(count))
        looked_at = [i for i in range(total) if windows.is_candidate(i)]
        assert {windows.window_of(i) for i in looked_at} == set(range(count)), "each window has a candidate"
        assert max(np.bincount(taken, weights=[windows.is_candidate(i) for i in range(total)])) <= 5


def test_a_target_count_from_a_real_file(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", pan(40))
    assert extract(video, tmp_path / "out", count=7)[0]["kept"] == 7
    assert extract(video, tmp_path / "out")[0]["kept"] == 40, "fewer than the default 60: all"


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_phone_videos_are_turned_upright(tmp_path: Path, turns: int) -> None:
    frames = pan(8)
    path = write_video(tmp_path / "a.mp4", frames)
    path.write_bytes(with_rotation(path.read_bytes(), turns, 192, 128))
    _, sequence = extract(path, tmp_path / "out", every=1)
    row = sequence.read_frames()[0]
    upright = np.rot90(frames[0], -turns)
    assert sequence.read_image(row).shape == upright.shape == (row.source_height, row.source_width, 3)
    assert np.abs(sequence.read_image(row).astype(int) - upright).mean() < 6


def test_long_frames_are_shrunk_and_none_is_enlarged(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", pan(6))
    _, sequence = extract(video, tmp_path / "out", long_side=96, every=1)
    row = sequence.read_frames()[0]
    assert (row.width, row.height, row.source_width, row.source_height) == (96, 64, 192, 128)
    assert sequence.read_image(row).shape == (64, 96, 3)


def test_files_that_are_no_videos_are_named(tmp_path: Path) -> None:
    text, empty, cut = tmp_path / "text.mp4", tmp_path / "empty.mp4", write_video(tmp_path / "cut.mp4", pan(20))
    text.write_text("not a video\n" * 400)
    empty.touch()
    cut.write_bytes(cut.read_bytes()[:-1500])  # without its index, which this writer puts last
    for path, part in ((text, "not a video"), (empty, "empty file"), (cut, "cut off before its index")):
        assert part in error_of(path, tmp_path / "out")


def test_a_video_cut_in_the_middle_is_used_up_to_there(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", pan(60))
    whole = index_first(video.read_bytes())
    video.write_bytes(whole)
    assert extract(video, tmp_path / "out")[0] | {"ordered": True} == extract(video, tmp_path / "o2")[0]
    video.write_bytes(whole[: len(whole) // 2])
    details, sequence = extract(video, tmp_path / "out", count=20)
    (warning,) = details["warnings"]
    assert "of 60 announced frames" in warning
    assert 15 <= details["kept"] <= 20, "the count is taken from what is there"
    rows = sequence.read_frames()
    assert 10 < int(rows[-1].source_name) < 45


def test_videos_that_show_nothing_are_errors(tmp_path: Path) -> None:
    frames = pan(20)
    rng = np.random.default_rng(0)
    noisy = [np.clip(frames[0] + rng.normal(0, 3, frames[0].shape), 0, 255).astype(np.uint8) for _ in range(20)]
    cases = {
        "one": (frames[:1], "too few frames: 1 of 1"),
        "black": ([np.zeros_like(frames[0])] * 20, "the frames show nothing"),
        "still": ([frames[0]] * 20, "the camera does not move"),
        "noise": (noisy, "the camera does not move"),
    }
    for name, (shown, part) in cases.items():
        text = error_of(write_video(tmp_path / f"{name}.mp4", shown), tmp_path / "out")
        assert part in text, text


def test_an_object_that_turns_before_a_still_background_moves(tmp_path: Path) -> None:
    background = texture(128, 192, seed=5)
    frames = []
    for patch in pan(20, width=48, height=48, seed=6):
        frame = background.copy()
        frame[40:88, 70:118] = patch
        frames.append(frame)
    details, _ = extract(write_video(tmp_path / "turntable.mp4", frames), tmp_path / "out")
    assert details["kept"] == 20


def test_pauses_and_blurred_frames_are_rows_with_reasons(tmp_path: Path) -> None:
    frames = pan(20)
    frames[7] = cv2.GaussianBlur(frames[7], (0, 0), 5)
    frames[12] = frames[13] = frames[11]
    details, sequence = extract(write_video(tmp_path / "a.avi", frames), tmp_path / "out", every=1)
    dropped = {row.frame: row.dropped for row in sequence.read_frames() if row.dropped}
    assert set(dropped) == {7, 12, 13}
    assert dropped[12] == dropped[13] == "near-duplicate of frame 11"
    assert "of neighbours' median" in str(dropped[7])
    assert details["dropped"] == {"blurred": 1, "near-duplicate": 2} and details["kept"] == 17
    stored = sorted(path.name for path in sequence.images.iterdir())
    assert stored == [f"{i:06d}.jpg" for i in range(20) if i not in dropped]


def test_the_same_video_gives_the_same_bytes(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", pan(12))
    contents = []
    for out in ("x", "y"):
        _, sequence = extract(video, tmp_path / out)
        contents.append({p.name: p.read_bytes() for p in sequence.folder.rglob("*") if p.is_file()})
    assert contents[0] == contents[1] and len(contents[0]) == 14


def test_a_failed_run_leaves_what_was_there(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", pan(12))
    _, sequence = extract(video, tmp_path / "out")
    before = {p: p.read_bytes() for p in sequence.folder.rglob("*") if p.is_file()}
    video.write_bytes(b"broken")
    with pytest.raises(BadInput):
        extract(video, tmp_path / "out")
    assert before == {p: p.read_bytes() for p in sequence.folder.rglob("*") if p.is_file()}
