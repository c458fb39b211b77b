"""`dope train --table` and `--split-file`: what a method learns from are the base classes of a table, and no others."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tiny_labelled import write_labelled
from typer.testing import CliRunner

from cli import app
from dope.base_classes import base_categories
from dope.common.errors import UsageError
from dope.config import load_config
from dope.lowshot.splits import Split, SplitTable, paper_table

SMALL = [
    "network.width=0.125", "data.image_size=32", "data.batch_size=4", "data.pairs_per_object=1", "data.workers=0",
    "schedule.max_steps=1", "validation.every=0", "device=cpu",
]  # fmt: skip


def _table(*base: str) -> SplitTable:
    return SplitTable("mine", base, (Split(("ring",), ("square",)),))


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    names = ("bar", "disc", "ring", "square")
    return write_labelled(tmp_path_factory.mktemp("shards"), shapes=names, objects=4, held_out=1)


def test_base_classes_are_the_shards_own_names(shards: Path) -> None:
    assert base_categories(shards, _table("DISC", "b_ar")) == ("bar", "disc")


def test_what_is_missing_is_named(shards: Path) -> None:
    with pytest.raises(UsageError, match="lack 1 of its 2 classes: lamp"):
        base_categories(shards, _table("disc", "lamp"))
    with pytest.raises(UsageError, match="there are none"):
        base_categories(shards, _table())
    assert paper_table("modelnet40_ls").base
    with pytest.raises(UsageError, match="modelnet40_ls, base classes"):
        base_categories(shards, paper_table("modelnet40_ls"))


def test_a_run_learns_from_them_alone(shards: Path, tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"base": ["disc", "bar"], "splits": [{"val": ["ring"], "test": ["square"]}]}))
    options = [part for setting in SMALL for part in ("--set", setting)]
    command = ["train", str(shards), "--method", "simpleshot", "--preset", "nano", "--split-file", str(file), *options]
    result = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "run")], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert load_config(None, tmp_path / "run" / "config.yaml").data.categories == ("bar", "disc")
    other = [*command, "--set", 'data.categories=["bar", "ring"]', "--out", str(tmp_path / "other")]
    with pytest.raises(UsageError, match="other classes"):
        CliRunner().invoke(app, other, catch_exceptions=False)
    with pytest.raises(UsageError, match="--table does too"):
        CliRunner().invoke(app, [*command, "--table", "co3d_ls", "--out", str(tmp_path / "o")], catch_exceptions=False)
    assert not (tmp_path / "other").exists()
