"""Every kind of bad input that preparation must survive: a row that names the file and the remedy; the others go on.

Elsewhere: a camera that only turns and two objects in one folder as structure from motion sees them (test_sfm.py),
a shard cut in half (test_streaming.py), a checkpoint of another configuration (test_trainer.py), a misspelt key
(test_settings.py, test_cli.py).
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from tiny_media import encode, index_first, pan, write_photos, write_video

from dope.common import files
from pipeline import prepare, tasks
from pipeline.cameras.model_checks import split_warning
from pipeline.console import describe, show_rows
from pipeline.inputs.sources import find_sources, input_errors_as_rows
from pipeline.masks.imported import MasksConfig
from pipeline.prepare import ColmapConfig, add_masks
from pipeline.sequence import Sequence
from pipeline.stages import StageResult
from pipeline.tasks import RunOptions

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def only_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """In this process, and without cameras and depth: what is bad here shows before them."""
    monkeypatch.setattr(tasks, "run_in_child", lambda work, *args, limits, notify: work(*args, notify))
    for name in ("reconstruct", "compute_depth"):
        monkeypatch.setattr(prepare, name, lambda *_: {})


def prep(tmp_path: Path, bad: Path, masks: str | None = None) -> tuple[list[StageResult], list[StageResult]]:
    """`prep colmap BAD GOOD`: the rows of the bad input and of the good one, which comes after it."""
    good = write_photos(tmp_path / "good", pan(6, seed=3))
    sources, errors = find_sources([bad, good], masks=masks)
    rows = prepare.prepare(sources, tmp_path / "work", ColmapConfig(), RunOptions(workers=2))
    rows += input_errors_as_rows(errors)
    return [row for row in rows if row.sequence != "good"], [row for row in rows if row.sequence == "good"]


def absent(path: Path) -> Path:
    return path / "phone.mp4"


def empty_folder(path: Path) -> Path:
    (path / "nothing").mkdir(parents=True)
    return path / "nothing"


def text(path: Path) -> Path:
    path.mkdir()
    (path / "letter.mp4").write_text("Dear video,\n" * 400)
    return path / "letter.mp4"


def cut_before_its_index(path: Path) -> Path:
    video = write_video(path / "cut.mp4", pan(20))
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    return video


def film(*frames: np.ndarray) -> Callable[[Path], Path]:
    return lambda path: write_video(path / "film.mp4", list(frames))


def shoot(*frames: np.ndarray) -> Callable[[Path], Path]:
    return lambda path: write_photos(path / "shots", list(frames))


def noisy(frame: np.ndarray, n: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [np.clip(frame + rng.normal(0, 3, frame.shape), 0, 255).astype(np.uint8) for _ in range(n)]


ONE, *_ = MOVING = pan(12)
BLACK = np.zeros_like(ONE)
SIZES = [frame[: 128 - 4 * i] for i, frame in enumerate(pan(9))]


@pytest.mark.parametrize(
    ("make", "what", "remedy"),
    [
        (absent, "no such file or folder", "spelt"),
        (empty_folder, "is an empty folder", "Photos are"),
        (text, "is not a video", "convert it"),
        (cut_before_its_index, "is not a video that can be decoded", "copy it again"),
        (film(ONE), "too few frames: 1 of 1", "Film longer, or lower --set frames.min_frames"),
        (shoot(ONE), "too few frames: 1 of 1", "Take more photos, or lower --set frames.min_frames"),
        (film(*[BLACK] * 12), "the frames show nothing", "lens covered"),
        (shoot(*[BLACK] * 12), "the frames show nothing", "lens covered"),
        (film(*[ONE] * 12), "the camera does not move", "Walk around the object"),
        (shoot(*[ONE] * 12), "the camera does not move", "Walk around the object"),
        (film(*noisy(ONE, 12)), "the camera does not move", "Walk around the object"),
        (shoot(*SIZES), "the photos have different sizes: 1 of 9", "a folder of its own"),
    ],
)
def test_bad_inputs_are_named_with_a_remedy_and_the_others_go_on(
    make: Callable[[Path], Path], what: str, remedy: str, tmp_path: Path
) -> None:
    bad = make(tmp_path / "bad")
    rows, good = prep(tmp_path, bad)
    assert [(row.stage, row.status) for row in rows] == [("frames", "failed")]
    reason = str(rows[0].reason)
    assert reason.startswith(str(bad)) and what in reason and remedy in reason
    assert rows[0].trace is None, "explained, not caught by accident"
    assert [(row.stage, row.status) for row in good] == [(s, "ok") for s in ("frames", "sfm", "depth")]


def test_a_video_cut_in_the_middle_is_used_up_to_there_and_the_row_says_so(tmp_path: Path) -> None:
    video = write_video(tmp_path / "in/a.mp4", pan(60))
    whole = index_first(video.read_bytes())
    video.write_bytes(whole[: len(whole) // 2])
    rows, good = prep(tmp_path, video)
    assert rows[0].ok and "of 60 announced frames could be decoded" in describe(rows[0]) and good[0].ok


def test_a_few_photos_of_another_size_are_left_out_with_the_reason(tmp_path: Path) -> None:
    rows, _ = prep(tmp_path, write_photos(tmp_path / "shots", [*MOVING, ONE[:90]]))
    assert rows[0].ok and rows[0].details["dropped"] == {"other size": 1}
    left_out = Sequence(tmp_path / "work/shots").read_frames()[-1]
    assert left_out.dropped == "other size (192x90, most are 192x128)" and left_out.source_name == "IMG_0012.jpg"


def masks_of_another_size(folder: Path) -> None:
    (folder / "IMG_0003.png").write_bytes(encode(np.full((100, 192), 255, np.uint8), ".png"))


def masks_all_empty(folder: Path) -> None:
    for path in folder.iterdir():
        path.write_bytes(encode(np.zeros((128, 192), np.uint8), ".png"))


def masks_of_other_names(folder: Path) -> None:
    for path in folder.iterdir():
        path.rename(folder / f"other_{path.name}")


def a_mask_cut_off(folder: Path) -> None:
    path = folder / "IMG_0002.png"
    path.write_bytes(path.read_bytes()[:60])


def no_masks(folder: Path) -> None:
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()


@pytest.fixture
def masks(tmp_path: Path) -> Path:
    """Masks of `shots` and of `good`: <masks>/<sequence>/<photo>.png."""
    mask = np.zeros((128, 192), np.uint8)
    mask[20:100, 40:150] = 255
    for name in ("shots", "good"):
        folder = tmp_path / "masks" / name
        folder.mkdir(parents=True)
        for i in range(12):
            (folder / f"IMG_{i:04d}.png").write_bytes(encode(mask, ".png"))
    return tmp_path / "masks"


BAD_MASKS: list[Any] = [
    (masks_of_another_size, "IMG_0003.png", "192x100, its image 'IMG_0003.jpg' is 192x128", "the size of its image"),
    (masks_all_empty, "shots", "all masks are empty", "Object pixels are bright"),
    (masks_of_other_names, "shots", "no mask belongs to any frame (IMG_0000.jpg", "e.g. IMG_1.png"),
    (a_mask_cut_off, "IMG_0002.png", "is cut off", "Copy the file again"),
]


@pytest.mark.parametrize(
    ("damage", "name", "what", "remedy"),
    [*BAD_MASKS, (no_masks, "shots", "no such file or folder of masks", "holds a file or folder for each id")],
)
def test_bad_masks_given_to_colmap(
    damage: Callable[[Path], None], name: str, what: str, remedy: str, masks: Path, tmp_path: Path
) -> None:
    damage(masks / "shots")
    rows, good = prep(tmp_path, write_photos(tmp_path / "shots", MOVING), str(masks))
    assert [(row.stage, row.status) for row in rows] == [("frames", "failed")]
    reason = str(rows[0].reason)
    assert name in reason.split(": ")[0] and what in reason and remedy in reason
    assert all(row.ok for row in good) and good[0].details["masks"]["masks"] == 6


@pytest.mark.parametrize(("damage", "name", "what", "remedy"), BAD_MASKS)
def test_bad_masks_imported_later(
    damage: Callable[[Path], None], name: str, what: str, remedy: str, masks: Path, tmp_path: Path
) -> None:
    damage(masks / "shots")
    prep(tmp_path, write_photos(tmp_path / "shots", MOVING))
    sequences = [Sequence(tmp_path / "work" / name) for name in ("shots", "good")]
    folders = {sequence.id: masks / sequence.id for sequence in sequences}
    bad, good = add_masks(sequences, MasksConfig(), folders, RunOptions(workers=2))
    reason = str(bad.reason)
    assert bad.status == "failed" and name in reason.split(": ")[0] and what in reason and remedy in reason
    assert good.ok and good.details["masks"] == 6


def test_missing_and_empty_masks_of_some_frames_are_counted_in_the_row(masks: Path, tmp_path: Path) -> None:
    (masks / "shots/IMG_0004.png").unlink()
    (masks / "shots/IMG_0005.png").write_bytes(encode(np.zeros((128, 192), np.uint8), ".png"))
    prep(tmp_path, write_photos(tmp_path / "shots", MOVING))
    shots = Sequence(tmp_path / "work/shots")
    (row,) = add_masks([shots], MasksConfig(), {"shots": masks / "shots"}, RunOptions())
    assert row.ok and "11 masks" in describe(row) and "1 missing, 1 empty" in describe(row)
    assert row.details["missing_frames"] == ["IMG_0004.jpg"] and row.details["empty_frames"] == ["IMG_0005.jpg"]


def test_two_objects_in_one_folder_are_told_in_the_row(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What structure from motion says of it (test_sfm.py) reaches the table."""
    models: Any = [SimpleNamespace(frames=list(range(9))), SimpleNamespace(frames=list(range(9, 15)))]
    monkeypatch.setattr(prepare, "reconstruct", lambda *_: {"warnings": split_warning(models)})
    rows, _ = prep(tmp_path, write_photos(tmp_path / "shots", MOVING))
    assert "2 separate models of 9 and 6 frames; the largest is kept" in describe(rows[1])


def in_a_private_mount(script: str, *words: object) -> subprocess.CompletedProcess[str]:
    command = ["unshare", "--mount", "--map-root-user", "sh", "-euc", script, "sh", *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)


def test_a_full_disk_is_named_and_the_work_goes_on_when_there_is_room(tmp_path: Path) -> None:
    """A real one: a file system in memory, too small for the photos."""
    disk, report = tmp_path / "disk", tmp_path / "report"
    disk.mkdir()
    mount = 'mount -t tmpfs -o size="$1" none "$2"'
    try:
        allowed = in_a_private_mount(mount, "600k", disk).returncode == 0
    except FileNotFoundError:
        allowed = False
    if not allowed:
        pytest.skip("mounting a file system of its own is not allowed here")
    photos = write_photos(tmp_path / "fox", [cv2.resize(frame, (768, 512)) for frame in pan(12)])
    assert sum(path.stat().st_size for path in photos.iterdir()) > 700_000
    prep = '"$3" -m cli prep colmap "$4" --out "$2/work"'
    script = (
        f'{mount}; {prep} >"$5" 2>&1 && exit 9; ls -A "$2/work/fox" "$2/work/fox/stages" >>"$5" || true; '
        f'mount -o remount,size=64m "$2"; {prep} --set sfm.max_image_size=64 --json || true'
    )
    answer = in_a_private_mount(script, "600k", disk, sys.executable, photos, report)
    said = " ".join(report.read_text().split())
    assert answer.returncode == 0, said + answer.stderr
    assert "no space left on the disk" in said and str(disk / "work") in said and "Free some space" in said
    assert "Traceback" not in said and "frames.json" not in said and "partial" not in said
    assert files.json.loads(answer.stdout.splitlines()[0])["status"] == "ok", "the frames are taken now"


def test_a_row_is_one_line_whatever_the_names_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    name = "in/new\nline \x1b[31m\udcff<b>"  # the last but one: a byte of a name that is no UTF-8
    show_rows([StageResult("a", "frames", "failed", reason=f"{name}: gone")], as_json=False)
    (row,) = capsys.readouterr().out.splitlines()[1:]
    assert row.rstrip().endswith(r"in/new\nline \x1b[31m\udcff<b>: gone")


def renamed(place: Path, name: bytes) -> Path:
    """A file or folder under another name, which need not be UTF-8."""
    new = Path(os.fsdecode(os.fsencode(place.parent) + b"/" + name))
    try:
        return place.rename(new)
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")


def test_a_name_that_is_no_utf8_is_a_row_and_the_others_go_on(tmp_path: Path) -> None:
    video = renamed(write_video(tmp_path / "raw/film.mp4", pan(8)), b"f\xfflm.mp4")
    (bad,), (good, *_) = prep(tmp_path, video)
    assert good.ok and bad.sequence == "f_lm" and bad.reason is not None
    assert bad.reason.endswith(r"raw/f\udcfflm.mp4: its name is not UTF-8. Rename it")


def test_a_photo_with_a_name_that_is_no_utf8_is_dropped(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "shots", pan(8))
    renamed(folder / "IMG_0003.jpg", b"caf\xe9.jpg")
    (row, *_), _ = prep(tmp_path, folder)
    frames = Sequence(tmp_path / "work/shots").read_frames()
    assert row.ok and [(f.source_name, f.dropped) for f in frames if f.dropped] == [
        (r"caf\udce9.jpg", "its name is not UTF-8")
    ]
