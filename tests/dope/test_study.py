"""Studies: which runs there are, what they are made by, what is done again, and what a failure costs."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tiny_results import row

from dope.commands.study import _name_and_shards
from dope.common.errors import UsageError
from dope.lowshot.results import append_rows
from dope.study import run as study
from dope.study.run import Piece, StudyConfig, commands, pieces_of, run_study
from dope.study.table import study_table
from dope.study.variants import ABLATIONS, KINDS, METHODS

SHARDS: dict[Any, str] = {"pairs": "renders", "labelled": "classes", "predicted": "guessed"}
CONFIG = StudyConfig(SHARDS, "test", settings=("data.image_size=32",), base=("cup", "mug"), seeds=(0, 1))


class Calls:
    """Stands in for the processes: notes commands, leaves checkpoints, fails where it is told to."""

    def __init__(self, fails: str = "") -> None:
        self.commands: list[tuple[str, ...]] = []
        self.fails = fails

    def __call__(self, command: tuple[str, ...], log: Path, config: StudyConfig) -> str | None:
        self.commands.append(command)
        if self.fails and any(self.fails in part for part in command):
            return "exit code 1"
        if command[0] == "train":
            (log.parent / "checkpoints").mkdir(exist_ok=True)
        return None

    def of(self, what: str) -> list[str]:
        place = 3 if what == "train" else 1
        return [Path(command[place]).name for command in self.commands if command[0] == what]


def test_every_ablation_of_the_paper_is_one_change_of_dope() -> None:
    names = [variant.name for variant in ABLATIONS]
    assert len(set(names)) == len(names) == 7 and ABLATIONS[0].settings == ()
    assert all(variant.method == "dope" for variant in ABLATIONS)
    changes = {variant.settings or variant.source for variant in ABLATIONS[1:]}
    assert len(changes) == 6  # no two are the same
    assert [variant.name for variant in KINDS["all"]].count("dope") == 1


def test_settings_of_all_variants_are_settings() -> None:
    from dope.config import load_config

    for variant in KINDS["all"]:
        if variant.method == "dope":
            load_config("nano", None, variant.settings, method=variant.method)


def test_commands_say_all_that_a_run_is(tmp_path: Path) -> None:
    pieces = {piece.name: piece for piece in pieces_of(METHODS, CONFIG, tmp_path)}
    train, evaluation = (command for _, command in commands(pieces["feat-seed1"], CONFIG, tmp_path))
    assert train[:4] == ("train", "classes", "--out", str(tmp_path / "runs" / "feat-seed1"))
    assert train[4:8] == ("--method", "feat", "--preset", "nano")
    settings = [b for a, b in itertools.pairwise(train) if a == "--set"]
    assert settings == [
        "seed=12346", "data.image_size=32", "data.batch_size=1", 'data.categories=["cup", "mug"]',
        f"feat.start={tmp_path / 'runs' / 'simpleshot-seed1'}",
    ]  # fmt: skip
    assert evaluation == ("eval", str(tmp_path / "runs" / "feat-seed1"), "test")
    own = replace(CONFIG, settings=("feat:schedule.max_steps=9", "schedule.max_steps=5", "dope:loss.chunk=64"))
    settings = [
        b for a, b in itertools.pairwise(next(commands(pieces["feat-seed0"], own, tmp_path))[1]) if a == "--set"
    ]
    assert settings[:3] == ["seed=12345", "schedule.max_steps=5", "schedule.max_steps=9"]  # the last one wins
    with pytest.raises(UsageError, match="no 'feet' to give settings to"):
        pieces_of(METHODS, replace(CONFIG, settings=("feet:schedule.max_steps=9",)), tmp_path)
    unlabelled = next(commands(pieces["dope-seed0"], CONFIG, tmp_path))[1]
    assert unlabelled[1] == "renders" and not any("categories" in part for part in unlabelled)


def test_more_views_are_tested_beside_and_shown_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    also = replace(CONFIG, also=(("photos", "pictures"),), also_evaluation=("--ways", "4", "--fit"), seeds=(0,))
    (piece,) = pieces_of(ABLATIONS[:1], also, tmp_path)
    *_, (what, command) = commands(piece, also, tmp_path)
    folder = piece.run / "eval-photos"
    assert what == "evaluation-photos"
    assert command == ("eval", str(piece.run), "pictures", "--out", str(folder), "--ways", "4", "--fit")
    append_rows(piece.run / "eval" / "results.parquet", [row(run=piece.name, ways=5, accuracy=0.9)])
    append_rows(folder / "results.parquet", [row(run=piece.name, ways=4, accuracy=0.3)])
    assert "| 5w" in study_table([piece], tmp_path) and "90.0" in (tmp_path / "table.md").read_text()
    assert "| 4w" in study_table([piece], tmp_path, "photos") and "30.0" in (tmp_path / "table-photos.md").read_text()

    calls = Calls()
    monkeypatch.setattr(study, "_call", calls)
    run_study(ABLATIONS[:1], also, tmp_path, lambda text: None)
    assert [command[0] for command in calls.commands] == ["train", "eval", "eval"]
    append_rows(folder / "results.parquet", [row(run=piece.name, ways=4, accuracy=0.3)])
    other = replace(also, also_evaluation=("--ways", "3"))
    run_study(ABLATIONS[:1], other, tmp_path, lambda text: None)
    assert calls.commands[3:] == [("eval", str(piece.run), "pictures", "--out", str(folder), "--ways", "3")]
    assert not (folder / "results.parquet").exists()  # rows of 4 ways and of 3 would be refused side by side
    assert (piece.run / "eval" / "results.parquet").exists()


def test_the_caption_has_all_numbers_of_queries(tmp_path: Path) -> None:
    pieces = pieces_of(ABLATIONS[:1], replace(CONFIG, seeds=(0,)), tmp_path)
    rows = [row(shots=shots, queries=q, asked_queries=15, run=pieces[0].name) for shots, q in ((1, 9), (5, 5))]
    append_rows(pieces[0].run / "eval" / "results.parquet", rows)
    assert "of 9 or 5 queries a class" in study_table(pieces, tmp_path)


def test_rows_of_validation_classes_are_not_in_the_table(tmp_path: Path) -> None:
    pieces = pieces_of(ABLATIONS[:1], replace(CONFIG, seeds=(0,)), tmp_path)
    rows = [row(run=pieces[0].name, part=part, accuracy=a) for part, a in (("val", 0.9), ("test", 0.4))]
    append_rows(pieces[0].run / "eval" / "results.parquet", rows)
    assert "40.0" in (text := study_table(pieces, tmp_path)) and "90.0" not in text and "65.0" not in text


@pytest.mark.parametrize("text", ["photos", "=x", "photos=", "a/b=x"])
def test_more_views_are_named(text: str) -> None:
    with pytest.raises(UsageError, match="is not NAME=SHARDS"):
        _name_and_shards(text)


def test_what_others_start_from_comes_first_and_nothing_is_done_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = Calls()
    monkeypatch.setattr(study, "_call", calls)
    feat_first = tuple(sorted(METHODS, key=lambda variant: variant.name != "feat"))
    outcome = run_study(feat_first, CONFIG, tmp_path, lambda text: None)
    assert len(outcome.done) == 16 and not outcome.failed
    trained = calls.of("train")
    assert trained.index("feat-seed0") > trained.index("simpleshot-seed0")
    assert sorted(trained) == sorted(calls.of("eval")) == sorted(piece.name for piece in outcome.done)
    calls.commands.clear()
    run_study(METHODS, CONFIG, tmp_path, lambda text: None)
    assert calls.commands == []
    otherwise = replace(CONFIG, evaluation=("--ways", "3"))
    run_study(METHODS[-1:], otherwise, tmp_path, lambda text: None)
    assert calls.of("train") == [] and calls.of("eval") == ["dope-seed0", "dope-seed1"]


def test_a_failure_costs_what_starts_from_it_and_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(study, "_call", Calls(fails="simpleshot-seed1"))
    outcome = run_study(METHODS, CONFIG, tmp_path, said.append)
    assert outcome.failed == {
        "simpleshot-seed1": "training: exit code 1",
        "feat-seed1": "it starts from simpleshot-seed1, which is not there",
    }
    assert len(outcome.done) == 14 and any("simpleshot-seed1: training failed" in line for line in said)
    again = Calls()
    monkeypatch.setattr(study, "_call", again)
    assert not run_study(METHODS, CONFIG, tmp_path, said.append).failed
    assert sorted(again.of("train")) == ["feat-seed1", "simpleshot-seed1"]


def test_other_settings_train_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = Calls()
    monkeypatch.setattr(study, "_call", calls)
    run_study(ABLATIONS[:1], CONFIG, tmp_path, lambda text: None)
    other = StudyConfig(SHARDS, "test", settings=("data.image_size=64",), seeds=(0,))
    run_study(ABLATIONS[:1], other, tmp_path, lambda text: None)
    assert calls.of("eval") == ["dope-seed0", "dope-seed1", "dope-seed0"]
    assert calls.of("train") == ["dope-seed0", "dope-seed1", "dope-seed0"]  # `dope train` itself says what differs


def test_variants_without_shards_are_named() -> None:
    with pytest.raises(UsageError, match="'simpleshot' is trained on other shards") as caught:
        pieces_of(METHODS, StudyConfig({"pairs": "renders"}, "test"), Path("out"))
    assert "--labelled" in str(caught.value)
    with pytest.raises(UsageError, match="--predicted-masks"):
        pieces_of(ABLATIONS, StudyConfig({"pairs": "renders"}, "test"), Path("out"))


def test_a_command_that_fails_is_quoted_from_its_log(tmp_path: Path) -> None:
    piece = Piece(ABLATIONS[0], 0, tmp_path / "runs" / "dope-seed0")
    piece.run.mkdir(parents=True)
    command = ("train", str(tmp_path / "none"), "--out", str(piece.run))
    why = study._call(command, piece.run / "log.txt", CONFIG)
    assert why is not None and "exit code 1" in why and "no such folder" in why
    log = (piece.run / "log.txt").read_text()
    assert log.startswith(f"\n$ dope train {tmp_path / 'none'}") and json.dumps("error:")[1:-1] in log


def test_the_table_has_means_over_seeds_and_how_they_differ(tmp_path: Path) -> None:
    pieces = pieces_of(ABLATIONS[:2], CONFIG, tmp_path)
    accuracies = {"dope-seed0": 0.60, "dope-seed1": 0.64, "other_objects-seed0": 0.5, "other_objects-seed1": 0.5}
    for piece in pieces:
        rows = [
            row(run=piece.name, ways=ways, shots=1, accuracy=accuracies[piece.name] - (ways - 5) / 100, ci95=0.01)
            for ways in (5, 10)
        ]
        append_rows(piece.run / "eval" / "results.parquet", rows)
    text = study_table(pieces, tmp_path)
    assert (tmp_path / "table.md").read_text() == text
    lines = text.splitlines()
    assert lines[0] == "|  | classifier | 5w1s | 10w1s |"
    assert lines[2] == "| DOPE (2nd view + other objects) | local matching | 62.0 ± 1.0 (2.8) | 57.0 ± 1.0 (2.8) |"
    assert lines[3] == "| other objects only | local matching | 50.0 ± 1.0 (0.0) | 45.0 ± 1.0 (0.0) |"
    assert lines[4] == "| chance |  | 20.0 | 10.0 |" and "means over 2 seeds" in text
    append_rows(pieces[0].run / "eval" / "results.parquet", [row(run="dope-seed0", ways=5, shots=5, episodes=7)])
    with pytest.raises(UsageError, match="episodes"):
        study_table(pieces, tmp_path)
