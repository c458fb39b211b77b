"""Classes whose labels a network has seen are no new classes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_labelled import write_labelled

from dope.checkpoints import find_checkpoint
from dope.common.errors import UsageError
from dope.config import load_config
from dope.lowshot.episodes import EpisodeConfig
from dope.lowshot.evaluate import EvaluationConfig, evaluate
from dope.lowshot.splits import Split, SplitTable
from dope.trainer import train

SMALL = [
    "network.width=0.125", "data.image_size=32", "data.batch_size=4", "data.pairs_per_object=1", "data.workers=0",
    "schedule.max_steps=1", "validation.every=0", "device=cpu", 'data.categories=["bar", "disc"]',
]  # fmt: skip
PROTOCOL = EvaluationConfig((EpisodeConfig(ways=2, queries=2, episodes=4),))


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    names = ("bar", "disc", "ring", "square")
    return write_labelled(tmp_path_factory.mktemp("shards"), shapes=names, objects=4, held_out=1)


@pytest.mark.parametrize("method", ["simpleshot", "supmoco"])
def test_trained_classes_are_told_and_in_a_table_refused(shards: Path, tmp_path: Path, method: str) -> None:
    torch.set_num_threads(1)
    train(shards, tmp_path, load_config("nano", None, SMALL, method=method))
    run = find_checkpoint(tmp_path)
    notes = evaluate(run, shards, replace(PROTOCOL, compare_untrained=True)).notes
    assert [note.startswith(str(run)) for note in notes if "learnt with the labels of bar, disc" in note] == [True]
    new = EvaluationConfig(PROTOCOL.protocols, categories=("ring", "square"))
    assert not any("labels" in note for note in evaluate(run, shards, new).notes)
    leaking = SplitTable("mine", (), (Split(("ring",), ("disc", "square")),))
    with pytest.raises(UsageError, match="was trained with the labels of disc, which split 0 of mine tests"):
        evaluate(run, shards, PROTOCOL, table=leaking)


def test_feat_knows_the_classes_that_its_encoder_was_trained_with(shards: Path, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    train(shards, tmp_path / "start", load_config("nano", None, SMALL, method="simpleshot"))
    others = [
        *SMALL, "data.batch_size=1", 'data.categories=["ring", "square"]', "feat.ways=2", "feat.queries=2",
        "schedule.max_steps=2", f"feat.start={tmp_path / 'start'}",
    ]  # fmt: skip
    for _ in range(2):  # and still does when it has been stopped
        train(shards, tmp_path / "run", load_config("nano", None, others, method="feat"), stop_after=1)
        run = find_checkpoint(tmp_path / "run")
        note = "learnt with the labels of bar, disc, ring, square"
        assert any(note in text for text in evaluate(run, shards, PROTOCOL).notes)
    leaking = SplitTable("mine", (), (Split((), ("bar", "disc")),))
    with pytest.raises(UsageError, match="was trained with the labels of bar, disc, which split 0 of mine tests"):
        evaluate(run, shards, PROTOCOL, table=leaking)
