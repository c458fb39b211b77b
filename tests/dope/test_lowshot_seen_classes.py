"""Classes whose objects a network has seen without labels are not quite new to it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from tiny_checkpoints import ALONE, CONFIG
from tiny_shards import write_shards

from dope.checkpoints import save_checkpoint
from dope.lowshot.episodes import EpisodeConfig
from dope.lowshot.evaluate import EvaluationConfig, evaluate
from dope.lowshot.splits import Split, SplitTable
from dope.methods import method_of
from dope.shard_index import read_index
from dope.state import new_state

PROTOCOL = EvaluationConfig((EpisodeConfig(ways=2, queries=2, episodes=4),))


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
