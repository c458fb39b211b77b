"""Classes whose labels a network has seen are no new classes, nor those whose objects it has seen without labels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_checkpoints import ALONE, CONFIG
from tiny_labelled import write_labelled
from tiny_shards import write_shards

from dope.checkpoints import find_checkpoint, save_checkpoint
from dope.common.errors import UsageError
from dope.config import load_config
from dope.lowshot.episodes import EpisodeConfig
from dope.lowshot.evaluate import EvaluationConfig, evaluate
from dope.lowshot.splits import Split, SplitTable
from dope.methods import method_of
from dope.shard_index import read_index
from dope.state import new_state
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


def test_objects_that_were_learnt_from_without_labels_are_told(tmp_path: Path) -> None:
    shards = write_shards(tmp_path / "shards", n_objects=12, val_objects=4)
    elsewhere = write_shards(tmp_path / "elsewhere", n_objects=16, seed=1)
    for name, categories in (("all", ()), ("some", ("category_0", "category_1"))):
        config = replace(CONFIG, data=replace(CONFIG.data, categories=categories))
        fingerprint = read_index(shards, "train").fingerprint
        save_checkpoint(tmp_path / name, new_state(method_of(config), ALONE), method_of(config), fingerprint)

    def notes(name: str, on: Path = shards, table: SplitTable | None = None, **changes: Any) -> str:
        config = replace(PROTOCOL, **changes)
        told = evaluate(tmp_path / name, on, config, table=table).notes
        return " ".join(note for note in told if "without labels" in note)

    told = notes("all", compare_untrained=True)
    assert told.count("learnt") == 1  # the random weights did not
    assert told.startswith("all learnt from pairs of these shards") and "category_3 are not new to it" in told
    assert "objects of category_0, category_1 are not new" in notes("some")
    assert notes("all", elsewhere) == notes("some", categories=("category_2", "category_3")) == ""
    splits = SplitTable("mine", (), (Split((), ("category_1", "category_2")), Split((), ("category_2", "category_3"))))
    told = "objects of category_1 are not to be tested by mine; --set data.categories"
    assert told in notes("some", table=splits) and "category_3" in notes("all", table=splits)
