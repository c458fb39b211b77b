"""CO3D's set lists: which frames they choose, and that whatever they name without effect is told."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cli import app
from pipeline.co3d.prepare import Co3dConfig, Co3dFramesConfig, prepare_co3d
from pipeline.co3d.sources import Choice, find_co3d
from pipeline.tasks import RunOptions
from tests.pipeline.co3d_tree import make_tree, numbers, row, tree_of


def test_set_lists_of_both_versions_choose_frames(tmp_path):
    frames = [row("a", i) for i in range(6)] + [row("b", i) for i in range(6)]
    sets = {"train": [["a", i, "x"] for i in (0, 2, 4)], "val": [["a", 5, "x"], ["b", 1, "x"]]}
    old = tree_of(tmp_path / "v1", frames, sets=sets)
    new = tree_of(tmp_path / "v2", frames, sets=sets, version=2)
    for tree, choice, expected in (
        (old, Choice(sets=["train"]), {"a": [0, 2, 4]}),
        (old, Choice(subsets=["train"]), {"a": [0, 2, 4]}),
        (old, Choice(subsets=["train"], sets=["val"]), {"a": [0, 2, 4, 5], "b": [1]}),
        (new, Choice(subsets=["fewview_dev"]), {"a": [0, 2, 4, 5], "b": [1]}),
        (new, Choice(subsets=["fewview_dev"], sets=["val"]), {"a": [5], "b": [1]}),
        (new, Choice(), {"a": list(range(6)), "b": list(range(6))}),
    ):
        sources, failed, _ = find_co3d(tree.root, tmp_path / "work", choice)
        assert {source.annotation.name: numbers(source) for source in sources} == expected and not failed
    for tree, choice, reason in (
        (old, Choice(sets=["nope"]), "no set nope in its set lists (there are: train, val)"),
        (new, Choice(subsets=["train"]), "no subset train (there are: fewview_dev)"),
        (new, Choice(subsets=["fewview_dev"], sets=["nope"]), "no set nope"),
    ):
        sources, failed, _ = find_co3d(tree.root, tmp_path / "work", choice)
        assert not sources and reason in str(failed[0].reason)
    (old.folder / "set_lists.json").unlink()
    assert "has no set lists" in str(find_co3d(old.root, tmp_path / "work", Choice(sets=["train"]))[1][0].reason)


def test_categories_without_a_subset_are_left_out_unless_they_or_none_is_named(tmp_path):
    sets = {"train": [["a", i, "x"] for i in range(3)]}
    for name in ("apple", "banana"):
        tree_of(tmp_path / "co3d", [row("a", i) for i in range(3)], sets=sets, version=2, category=name)
    (tmp_path / "co3d/banana/set_lists/set_lists_fewview_dev.json").unlink()
    for choice, n_sources, n_failed, n_left_out in (
        (Choice(subsets=["fewview_dev"]), 1, 0, 1),
        (Choice(subsets=["fewview_dev"], categories=["apple", "banana"]), 1, 1, 0),
        (Choice(subsets=["fewview_de"]), 0, 2, 0),
    ):
        found = find_co3d(tmp_path / "co3d", tmp_path / "work", choice)
        assert tuple(map(len, found)) == (n_sources, n_failed, n_left_out), choice
        assert all("no subset fewview_de" in str(r.reason) for rows in found[1:] for r in rows)


def test_sequences_of_the_set_lists_that_are_not_annotated_are_failed_rows(tmp_path: Path) -> None:
    sets = {"x": [["zzz", 1, "p"], ["zzz", 2, "p"], ["a", 1, "p"], ["yyy", 1, "p"]], "y": [["www", 1, "p"]]}
    tree = tree_of(tmp_path / "co3d", [row("a", i) for i in range(3)], sets=sets)
    sources, failed, _ = find_co3d(tree.root, tmp_path / "work", Choice(subsets=["x"]))
    assert [source.id for source in sources] == ["apple_a"]
    assert [(r.sequence, r.status) for r in failed] == [("apple_zzz", "failed"), ("apple_yyy", "failed")]
    assert "its set lists name the sequence 'zzz', its annotations do not" in str(failed[0].reason)
    _, failed, _ = find_co3d(tree.root, tmp_path / "work", Choice(subsets=["x"], sequences=["apple_yyy"]))
    assert [r.sequence for r in failed] == ["apple_yyy"]
    tree = tree_of(tmp_path / "v2", [row("a", 1)], sets={"train": [["zzz", 1, "p"]]}, version=2)
    words = ["prep", "co3d", str(tree.root), "--out", str(tmp_path / "w"), "--subset", "fewview_dev", "--json"]
    answer = CliRunner().invoke(app, words)
    assert answer.exit_code == 1 and json.loads(answer.stdout)["sequence"] == "apple_zzz"


def test_entries_that_name_no_frame_are_told_and_the_others_used(tmp_path: Path) -> None:
    wrong = ["odd", ["b"], [7, 1, "p"], ["a", "1", "p"], ["a", True, "p"], ["\ud800", 1, "p"]]
    sets = {"x": [["a", 1, "p"], *wrong], "y": [["a", 2, "p"], "odd"], "z": ["odd"]}
    tree = tree_of(tmp_path / "co3d", [row("a", i) for i in range(3)], sets=sets)
    (source,), failed, _ = find_co3d(tree.root, tmp_path / "work", Choice(subsets=["x", "y"]))
    assert numbers(source) == [1, 2]
    reasons = [str(r.reason) for r in failed]
    assert len(reasons) == 2 and all(r.status == "failed" for r in failed)
    assert "apple/set_lists.json: row 2 of set x is no [sequence, frame number, path]" in reasons[0]
    assert "row 2 of set y is no" in reasons[1] and "such rows were left out" in reasons[1]
    sources, failed, _ = find_co3d(tree.root, tmp_path / "work", Choice(subsets=["z"]))
    assert not sources and "row 1 of set z" in str(failed[0].reason)


def test_a_set_that_is_there_and_empty_is_not_called_absent(tmp_path: Path) -> None:
    tree = tree_of(tmp_path / "co3d", [row("a", 1)], sets={"train": [["a", 1, "p"]], "val": []}, version=2)
    sources, failed, _ = find_co3d(tree.root, tmp_path / "work", Choice(sets=["val"]))
    assert not sources and "set val names no frame in its set lists" in str(failed[0].reason)
    (source,), failed, _ = find_co3d(tree.root, tmp_path / "work", Choice(sets=["val", "train"]))
    assert numbers(source) == [1] and not failed
    _, failed, _ = find_co3d(tree.root, tmp_path / "work", Choice(sets=["test"]))
    assert "no set test in its set lists (there are: train, val)" in str(failed[0].reason)


def test_frames_of_the_set_lists_that_are_not_annotated_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.tasks.run_in_child", lambda run, *args, limits, notify: run(*args, notify))
    tree = make_tree(tmp_path / "co3d")  # frames 1 to 8
    (name,) = {frame["sequence_name"] for frame in tree.frames}
    tree.sets = {"x": [[name, i, "p"] for i in range(2, 12)], "y": [[name, i, "p"] for i in (20, 21)]}
    tree.write()
    config = Co3dConfig(frames=Co3dFramesConfig(every=1))
    found = {}
    for subset in ("x", "y"):
        sources, failed, _ = find_co3d(tree.root, tmp_path / "work", Choice(subsets=[subset]))
        assert not failed
        found[subset] = prepare_co3d(sources, tmp_path / subset, config, RunOptions())[0]
    warning = "3 frames that the set lists name are not annotated: 9, 10, 11"
    assert found["x"].details["kept"] == 7 and warning in found["x"].details["warnings"]
    assert "not one of the 2 frames that the set lists name is annotated" in str(found["y"].reason)
