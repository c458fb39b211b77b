"""CO3D's masks: what cannot be used is told, and cameras and depth read them alone, whatever was made later."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.co3d.prepare import MapsConfig
from pipeline.masks.imported import MasksConfig
from pipeline.prepare import add_masks
from pipeline.sequence import Sequence
from pipeline.stages import read_marker
from pipeline.tasks import RunOptions
from tests.pipeline.co3d_runs import ALL, NAME, huge_png, prepare
from tests.pipeline.co3d_tree import Tree, add_sequence, make_tree, views


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    """Children cost a second each; what they do is tested with `dope prep colmap`."""
    monkeypatch.setattr("pipeline.tasks.run_in_child", lambda run, *args, limits, notify: run(*args, notify))


def test_masks_and_depths_that_cannot_be_used_cost_their_frame_only(tmp_path):
    tree = Tree(tmp_path / "co3d")
    rows = add_sequence(tree, NAME, views(10))
    place = tree.folder / NAME
    (place / "masks/frame000001.png").unlink()
    (place / "masks/frame000002.png").write_bytes(huge_png())
    rows[2]["mask"] = None
    cv2.imwrite(str(place / "masks/frame000004.png"), np.full((50, 50), 255, np.uint8))
    (place / "depths/frame000005.jpg.geometric.png").unlink()
    (place / "depths/frame000006.jpg.geometric.png").write_bytes(huge_png())
    rows[6]["depth"] = None
    rows[7]["depth"]["scale_adjustment"] = None
    rows[8]["depth"]["path"] = "../../../etc/passwd"
    results, _, _ = prepare(tree.write(), tmp_path / "work")
    assert all(row.ok for row in results), [row.reason for row in results]
    sequence = Sequence(tmp_path / f"work/apple_{NAME}")
    frames = sequence.read_frames()
    assert [f.frame for f in frames if f.mask is None] == [0, 1, 2, 3] and all(f.image for f in frames)
    assert results[0].details["masks"]["missing"] == 4
    bad = results[0].details["bad_masks"]
    assert sorted(bad) == [0, 1, 3]
    for number, part in ((0, "is not there"), (1, "60000"), (3, "is of another shape")):
        assert part in bad[number]
    assert "3 of 9 masks cannot be used: the mask of frame000001.jpg is not there" in results[0].details["warnings"][0]
    assert [f.frame for f in frames if f.depth is None] == [4, 5, 6, 7, 8]
    reasons = json.dumps(results[2].details)
    for part in ("depth is not there", "60000", "no usable scale_adjustment", "leads outside"):
        assert part in reasons


def test_what_comes_out_does_not_depend_on_what_was_run_before(tmp_path):
    tree = Tree(tmp_path / "co3d")
    add_sequence(tree, NAME, views(12, arc_deg=110))
    for path in (tree.folder / NAME / "depth_masks").iterdir():  # they leave out more than the masks do
        valid = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        valid[:, :60] = 0
        cv2.imwrite(str(path), valid)
    moved = tree.folder / NAME / "masks/frame000005.png"
    cv2.imwrite(str(moved), np.roll(cv2.imread(str(moved), cv2.IMREAD_GRAYSCALE), 40, axis=1))
    tree.write()
    rough = replace(ALL, maps=MapsConfig(depth_masks=False))
    before = (ALL, rough, replace(rough, maps=replace(rough.maps, depth="stereo")))
    sequence = Sequence(tmp_path / f"work/apple_{NAME}")
    for number, config in enumerate(before):
        rows, _, _ = prepare(tree, tmp_path / "work", config)
        prepare(tree, tmp_path / f"fresh{number}", config)
        assert all(row.ok for row in rows)
        for folder in ("depths", "sparse"):
            for path in (sequence.folder / folder).iterdir():
                fresh = tmp_path / f"fresh{number}/{sequence.id}" / folder / path.name
                assert path.read_bytes() == fresh.read_bytes(), (number, path.name)
        (row,) = add_masks([sequence], MasksConfig(), {}, RunOptions())
        assert row.details["flagged"] == 1 and not row.skipped


def test_depth_made_again_reads_the_masks_of_the_download_also_after_a_kill(tmp_path, monkeypatch):
    tree = Tree(tmp_path / "co3d")
    add_sequence(tree, NAME, views(6, arc_deg=60))
    tree.write()
    own = tmp_path / "own"
    own.mkdir()
    for path in (tree.folder / NAME / "masks").iterdir():
        cv2.imwrite(str(own / path.name), np.full((96, 128), 255, np.uint8))
    sequence, fresh = (Sequence(tmp_path / work / f"apple_{NAME}") for work in ("work", "fresh"))
    prepare(tree, tmp_path / "work")
    add_masks([sequence], MasksConfig(), {sequence.id: own}, RunOptions())
    stereo = replace(ALL, maps=MapsConfig(depth="stereo"))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("pipeline.co3d.frames.write_masks", killed)
        prepare(tree, tmp_path / "work", stereo)
    assert read_marker(sequence, "masks") is None
    for work in ("work", "fresh"):
        prepare(tree, tmp_path / work, stereo)
    assert sequence.read_info().masks_from == "input"
    for folder in ("masks", "depths"):
        for path in (fresh.folder / folder).iterdir():
            assert path.read_bytes() == (sequence.folder / folder / path.name).read_bytes()


def killed(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_masks_of_the_download_are_kept_and_come_back_with_new_cameras(tmp_path):
    tree = make_tree(tmp_path / "co3d")
    prepare(tree, tmp_path / "work")
    sequence = Sequence(tmp_path / f"work/apple_{NAME}")
    before = sequence.read_mask(sequence.read_frames()[0])
    (row,) = add_masks([sequence], MasksConfig(), {}, RunOptions())
    assert row.ok and row.details["masks"] == 8 and row.details["from"] == "the input"
    own = tmp_path / "own"
    own.mkdir()
    for frame in sequence.read_frames():
        cv2.imwrite(str(own / f"{Path(frame.source_name).stem}.png"), np.full((96, 128), 255, np.uint8))
    (row,) = add_masks([sequence], MasksConfig(), {sequence.id: own}, RunOptions())
    assert row.ok and sequence.read_mask(sequence.read_frames()[0]).all()
    rows, _, _ = prepare(tree, tmp_path / "work", replace(ALL, maps=MapsConfig(points="depth")))
    assert [row.skipped for row in rows] == [True, False, False]
    assert (sequence.read_mask(sequence.read_frames()[0]) == before).all()
    assert sequence.read_info().masks_from == "input"
