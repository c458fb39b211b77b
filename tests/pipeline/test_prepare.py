"""What is run, what is kept and what is refused: the stages over sequences, with stand-ins for their work."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import orbit
from tiny_media import encode, pan, write_photos
from typer.testing import CliRunner

from dope.common.errors import BadInput
from pipeline import commands, prepare, tasks
from pipeline.cameras.sfm import SfmConfig
from pipeline.children import ChildFailed, ChildStopped
from pipeline.correspond.match import CorrespondConfig
from pipeline.inputs.sources import Source, find_sources, known_sources
from pipeline.masks.imported import MasksConfig
from pipeline.masks.mask_io import write_masks
from pipeline.prepare import ColmapConfig, add_masks, correspond_all
from pipeline.run import RunConfig, items_of, run_all
from pipeline.sequence import Sequence
from pipeline.stages import StageResult, read_marker
from pipeline.tasks import RunOptions

HERE, AGAIN = RunOptions(), RunOptions(overwrite=True)
MORE = ColmapConfig(sfm=SfmConfig(max_features=3000))

pytestmark = pytest.mark.filterwarnings("ignore:__array__:DeprecationWarning")  # of pycocotools under NumPy 2


@pytest.fixture(autouse=True)
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Work is done in this process; cameras, depth, GrabCut and matching only say that they were asked."""
    made: list[str] = []

    def stand_in(name: str) -> Callable[..., dict[str, Any]]:
        def work(sequence: Sequence, *_: object) -> dict[str, Any]:
            masks = sequence.read_info().masks_from if any(f.mask for f in sequence.read_frames()) else None
            made.append(f"{name} with masks of {masks}")
            return {}

        return work

    def grabcut(sequence: Sequence, config: MasksConfig) -> dict[str, Any]:
        made.append(f"grabcut {config.grabcut.radius:g}")
        frames = sequence.read_frames()
        mask = np.zeros((frames[0].height, frames[0].width), bool)
        mask[: len(mask) // 2] = True
        nothing = BadInput("nothing")
        return write_masks(sequence, frames, ((f, mask) for f in frames if f.image), min_share=0.01, nothing=nothing)

    monkeypatch.setattr(tasks, "run_in_child", lambda work, *args, limits, notify: work(*args, notify))
    for name in ("reconstruct", "compute_depth", "correspond"):
        monkeypatch.setattr(prepare, name, stand_in(name))
    monkeypatch.setattr(prepare, "_grabcut", grabcut)
    return made


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return write_photos(tmp_path / "in/fox", pan(6))


def masks_for(photos: Path, folder: Path, columns: int = 60) -> Path:
    folder.mkdir(parents=True)
    mask = np.zeros((128, 192), np.uint8)
    mask[:, :columns] = 255
    for photo in photos.iterdir():
        (folder / f"{photo.stem}.png").write_bytes(encode(mask, ".png"))
    return folder


def colmap(photos: Path, work: Path, masks: Path | None = None, **settings: Any) -> list[StageResult]:
    source = Source(photos, "fox", "photos", masks=masks)
    config = settings.get("config", ColmapConfig())
    return prepare.prepare([source], work, config, settings.get("options", HERE))


def states(rows: list[StageResult]) -> list[str]:
    return [f"{row.stage} {row.status}{' skipped' if row.skipped else ''}" for row in rows]


def test_finished_work_is_skipped_without_a_process(
    photos: Path, tmp_path: Path, calls: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert states(colmap(photos, tmp_path / "w")) == ["frames ok", "sfm ok", "depth ok"]
    monkeypatch.delattr(tasks, "run_in_child")
    assert states(colmap(photos, tmp_path / "w")) == ["frames ok skipped", "sfm ok skipped", "depth ok skipped"]
    assert len(calls) == 2


def test_changed_settings_and_changed_photos_run_from_there_on(photos: Path, tmp_path: Path, calls: list[str]) -> None:
    colmap(photos, tmp_path / "w")
    assert states(colmap(photos, tmp_path / "w", config=MORE)) == ["frames ok skipped", "sfm ok", "depth ok"]
    write_photos(photos, pan(7, seed=1))
    assert states(colmap(photos, tmp_path / "w", config=MORE)) == ["frames ok", "sfm ok", "depth ok"]
    assert len(Sequence(tmp_path / "w/fox").read_frames()) == 7


def test_masks_of_grabcut_are_made_again_and_never_taken_for_given_ones(
    photos: Path, tmp_path: Path, calls: list[str]
) -> None:
    colmap(photos, tmp_path / "w")
    fox = Sequence(tmp_path / "w/fox")
    wider = replace(MasksConfig(), grabcut=replace(MasksConfig().grabcut, radius=2.0))
    calls.clear()
    for config, options in ((MasksConfig(), HERE), (MasksConfig(), HERE), (wider, HERE), (wider, AGAIN)):
        (row,) = add_masks([fox], config, {}, options)
        assert row.ok and row.details["from"] == "GrabCut" and row.details["masks"] == 6
    assert calls == ["grabcut 1.2", "grabcut 2", "grabcut 2"]
    assert fox.read_info().masks_from == "grabcut"


def test_cameras_and_depth_do_not_depend_on_masks_made_later(photos: Path, tmp_path: Path, calls: list[str]) -> None:
    fox = Sequence(tmp_path / "w/fox")
    colmap(photos, tmp_path / "w")
    add_masks([fox], MasksConfig(), {}, HERE)
    colmap(photos, tmp_path / "w", config=MORE)
    assert calls[-2:] == ["reconstruct with masks of None", "compute_depth with masks of None"]
    assert read_marker(fox, "masks") is None and not fox.masks.exists()

    given, later = masks_for(photos, tmp_path / "given"), masks_for(photos, tmp_path / "later", columns=99)
    colmap(photos, tmp_path / "w", given)
    add_masks([fox], MasksConfig(), {"fox": later}, HERE)
    colmap(photos, tmp_path / "w", given, config=MORE)
    assert calls[-2:] == ["reconstruct with masks of input", "compute_depth with masks of input"]
    mask = fox.read_mask(fox.read_frames()[0])
    assert mask is not None and mask[0].sum() == 60


def test_instances_that_came_with_the_input_are_picked_alike_whatever_cameras_there_are(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Away from the middle of the image the object is seen by the cameras only, which are not there at first."""
    squares = [(48, 80), (100, 8)]  # top, left: near the middle, and where the cameras say that the object is
    corners = [[x, y, x + 24, y, x + 24, y + 24, x, y + 24] for y, x in squares]
    value = [{"image_id": path.name, "segmentation": [c]} for path in photos.iterdir() for c in corners]
    (tmp_path / "r.json").write_text(json.dumps(value))
    fox = Sequence(tmp_path / "w/fox")

    def reconstruct(sequence: Sequence, *_: object) -> dict[str, Any]:
        frames = sequence.read_frames()
        for frame, camera in zip(frames, orbit(len(frames), width=192, height=128, wobble=0.0), strict=True):
            frame.set_camera(replace(camera, K=camera.K + np.array([[0, 0, -75.0], [0, 0, 48.0], [0, 0, 0]])))
        sequence.write_frames(frames)
        return {}

    monkeypatch.setattr(prepare, "reconstruct", reconstruct)
    colmap(photos, tmp_path / "w", tmp_path / "r.json")
    before = fox.read_mask(fox.read_frames()[0])
    assert before is not None and before[60, 92] and not before[110, 20]
    add_masks([fox], MasksConfig(), {"fox": masks_for(photos, tmp_path / "later")}, HERE)
    for pick in ("consistent", "centre"):
        config = replace(MORE, masks=MasksConfig(pick=pick))  # type: ignore[arg-type]
        prepare.restore_input_masks(fox, tmp_path / "r.json", config.masks)
        np.testing.assert_array_equal(fox.read_mask(fox.read_frames()[0]), before)
        add_masks([fox], config.masks, {"fox": tmp_path / "r.json"}, AGAIN)  # these may look at the cameras
        after = fox.read_mask(fox.read_frames()[0])
        assert after is not None and after[110, 20], "else this test would show nothing"


def test_given_masks_are_kept_until_others_take_their_place(photos: Path, tmp_path: Path) -> None:
    fox = Sequence(tmp_path / "w/fox")
    colmap(photos, tmp_path / "w", masks_for(photos, tmp_path / "given"))
    (row,) = add_masks([fox], MasksConfig(), {}, HERE)
    assert row.ok and row.details["from"] == "the input" and row.details["masks"] == 6
    (row,) = add_masks([fox], MasksConfig(), {"fox": masks_for(photos, tmp_path / "later", columns=99)}, HERE)
    assert row.ok and row.details["from"] == str(tmp_path / "later")
    (row,) = add_masks([fox], MasksConfig(), {}, HERE)
    assert row.status == "failed" and "were replaced since" in str(row.reason) and "--from" in str(row.reason)


def test_a_failed_import_leaves_the_masks_whose_they_are(photos: Path, tmp_path: Path) -> None:
    fox = Sequence(tmp_path / "w/fox")
    colmap(photos, tmp_path / "w", masks_for(photos, tmp_path / "given"))
    (tmp_path / "none").mkdir()
    (row,) = add_masks([fox], MasksConfig(), {"fox": tmp_path / "none"}, HERE)
    assert row.status == "failed" and fox.read_info().masks_from == "input"
    assert add_masks([fox], MasksConfig(), {}, HERE)[0].ok


def test_correspondences_need_masks_that_are_in_order(photos: Path, tmp_path: Path, calls: list[str]) -> None:
    fox = Sequence(tmp_path / "w/fox")
    colmap(photos, tmp_path / "w", masks_for(photos, tmp_path / "given"))
    assert correspond_all([fox], CorrespondConfig(), HERE)[0].ok, "given masks need no further stage"
    (tmp_path / "none").mkdir()
    add_masks([fox], MasksConfig(), {"fox": tmp_path / "none"}, HERE)
    (row,) = correspond_all([fox], CorrespondConfig(), HERE)
    assert row.status == "failed" and "stage 'masks' failed" in str(row.reason)

    colmap(photos, tmp_path / "w")  # without masks
    (row,) = correspond_all([fox], CorrespondConfig(), HERE)
    assert row.status == "failed" and "dope prep masks" in str(row.reason)
    add_masks([fox], MasksConfig(), {}, HERE)
    assert correspond_all([fox], CorrespondConfig(), HERE)[0].ok
    (fox.stages / "masks.json").unlink()  # a run that was killed while it wrote masks
    assert correspond_all([fox], CorrespondConfig(), AGAIN)[0].status == "failed"


def break_off(monkeypatch: pytest.MonkeyPatch, error: Exception, stage: str | None) -> None:
    def child(work: object, *_: object, limits: object, notify: Callable[[str], None]) -> None:
        if stage:
            notify(f"{stage}: started")
        raise error

    monkeypatch.setattr(tasks, "run_in_child", child)


def test_what_was_stopped_goes_on(photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        break_off(patch, ChildStopped("was stopped before it was done"), "frames")
        assert states(colmap(photos, tmp_path / "w")) == ["frames failed"]
    assert states(colmap(photos, tmp_path / "w")) == ["frames ok", "sfm ok", "depth ok"]


def test_a_crash_is_kept_and_tried_again_where_asked(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    colmap(photos, tmp_path / "w")
    with monkeypatch.context() as patch:
        break_off(patch, ChildFailed("the process was ended by SIGSEGV"), "sfm")
        assert states(colmap(photos, tmp_path / "w", config=MORE)) == ["sfm failed"]
    with monkeypatch.context() as patch:
        break_off(patch, ChildFailed("no module could be loaded"), None)  # no stage is to blame for that
        assert "no module" in str(colmap(photos, tmp_path / "v")[0].reason)
    assert list((tmp_path / "v").rglob("*.json")) == []
    rows = colmap(photos, tmp_path / "w", config=MORE)
    assert states(rows) == ["frames ok skipped", "sfm failed skipped"] and "SIGSEGV" in str(rows[1].reason)
    rows = colmap(photos, tmp_path / "w", config=MORE, options=RunOptions(retry_failed=True))
    assert states(rows) == ["frames ok skipped", "sfm ok", "depth ok"]


def test_another_input_of_the_same_name_never_takes_the_place(photos: Path, tmp_path: Path) -> None:
    colmap(photos, tmp_path / "w")
    other = write_photos(tmp_path / "other/fox", pan(6, seed=9))
    for options in (HERE, AGAIN):
        (row,) = colmap(other, tmp_path / "w", options=options)
        assert row.status == "failed" and str(other) in str(row.reason) and str(photos) in str(row.reason)
    assert states(colmap(photos, tmp_path / "w"))[0] == "frames ok skipped"
    photos.rename(tmp_path / "moved")
    assert states(colmap(tmp_path / "moved", tmp_path / "w"))[0] == "frames ok skipped", "a moved input is the same"


@pytest.mark.parametrize(
    ("text", "reason"),
    [("{}", "does not say its id, source, kind"), ("[]", "is not a JSON object"),
     ('{"id": "fox", "source": 7, "kind": "video"}', "does not say its source")],
)  # fmt: skip
def test_a_sequence_json_of_another_shape_stops_nothing(photos: Path, tmp_path: Path, text: str, reason: str) -> None:
    work = tmp_path / "w"
    colmap(photos, work)
    sequence = Sequence(work / "fox")
    (sequence.folder / "sequence.json").write_text(text)
    with pytest.raises(BadInput, match=rf"sequence\.json: {reason}.*--overwrite"):
        sequence.read_info()
    assert known_sources(work) == {}
    assert states(add_masks([sequence], MasksConfig(), {}, HERE)) == ["masks failed"]
    (sequence.stages / "depth.json").unlink()
    (row, *_) = run_all(items_of([], [sequence], {}, work), RunConfig(), HERE)
    assert row.status == "failed" and "the same command with its INPUT" in str(row.reason)
    assert states(colmap(photos, work, options=AGAIN)) == ["frames ok", "sfm ok", "depth ok"]
    assert sequence.read_info().id == "fox"


def test_an_input_that_cannot_be_read_does_not_stop_the_others(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = write_photos(tmp_path / "in/gone", pan(6))
    sources, _ = find_sources([bad, photos])
    for photo in bad.iterdir():
        photo.unlink()
    bad.rmdir()
    rows = prepare.prepare(sources, tmp_path / "w", ColmapConfig(), HERE)
    assert states(rows) == ["frames failed", "frames ok", "sfm ok", "depth ok"]
    assert str(bad) in str(rows[0].reason)


def test_masks_that_cannot_be_read_do_not_stop_the_others(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        prepare.prepare([Source(photos, name, "photos")], tmp_path / "w", ColmapConfig(), HERE)
    masks = {name: masks_for(photos, tmp_path / "masks" / name) for name in ("a", "b")}
    closed, whole = masks["a"] / "IMG_0002.png", Path.open

    def opened(path: Path, *args: Any, **more: Any) -> Any:
        if path == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return whole(path, *args, **more)

    monkeypatch.setattr(Path, "open", opened)
    sequences = [Sequence(tmp_path / "w" / name) for name in masks]
    rows = add_masks(sequences, MasksConfig(), masks, HERE)
    assert states(rows) == ["masks failed", "masks ok"]
    assert str(closed) in str(rows[0].reason) and "Permission denied" in str(rows[0].reason)


def test_a_work_folder_that_cannot_be_made_is_named(photos: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    (row,) = colmap(photos, tmp_path / "file")
    assert row.status == "failed" and str(tmp_path / "file") in str(row.reason) and "WORK" in str(row.reason)


def test_parts_of_an_array_job_read_the_folder_of_masks_alike(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        prepare.prepare([Source(photos, name, "photos")], tmp_path / "w", ColmapConfig(), HERE)
    masks_for(photos, tmp_path / "masks/b")
    seen: list[tuple[list[str], dict[str, Path]]] = []

    def add(chosen: list[Sequence], config: object, folders: dict[str, Path], *_: object) -> list[StageResult]:
        seen.append(([sequence.id for sequence in chosen], folders))
        return []

    monkeypatch.setattr(prepare, "add_masks", add)
    for part in range(3):  # more parts than sequences: the last has nothing to do
        words = ["masks", str(tmp_path / "w"), "--from", str(tmp_path / "masks")]
        answer = CliRunner().invoke(commands.app, [*words, "--shard-index", str(part), "--num-shards", "3"])
        assert answer.exit_code == 0, answer.output
    assert [ids for ids, _ in seen] == [["a"], ["b"], []]
    assert all(folders == {"b": tmp_path / "masks/b"} for _, folders in seen)
