"""Views and their classes: what views.parquet must say, and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tiny_labelled import rewrite, write_labelled

from dope.common.errors import BadInput, UsageError
from dope.view_index import read_view_index


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_labelled(tmp_path_factory.mktemp("shards"), shapes=("ring", "bar", "disc"), objects=3, held_out=1)


@pytest.fixture
def copy(shards: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(shards, tmp_path / "copy"))


def test_classes_are_sorted_and_have_the_same_numbers_in_both_splits(shards: Path) -> None:
    train, val = (read_view_index(shards, split) for split in ("train", "val"))
    assert train.classes == val.classes == ("bar", "disc", "ring")
    assert (len(train), len(val)) == (3 * 3 * 2, 3 * 1 * 2)
    for index in (train, val):
        assert [index.classes[n] for n in index.labels] == [name.split("_")[0] for name in index.sequences]
    # an object has one number, and no two splits share one
    assert len(set(zip(train.objects.tolist(), train.sequences.tolist(), strict=True))) == 9
    assert not set(train.objects.tolist()) & set(val.objects.tolist())


def test_a_choice_of_classes_is_numbered_anew_and_known_by_another_fingerprint(shards: Path) -> None:
    every, some = read_view_index(shards, "train"), read_view_index(shards, "train", ["ring", "disc"])
    assert some.classes == ("disc", "ring") and set(some.labels.tolist()) == {0, 1} and len(some) == 12
    assert [some.classes[n] for n in some.labels] == [name.split("_")[0] for name in some.sequences]
    numbers = dict(zip(every.sequences.tolist(), every.objects.tolist(), strict=True))
    assert [numbers[name] for name in some.sequences] == some.objects.tolist()
    assert every.fingerprint != some.fingerprint


def test_an_unknown_class_is_an_error_that_names_the_closest(shards: Path) -> None:
    with pytest.raises(UsageError, match=r"no samples of category 'rung'.*'ring'"):
        read_view_index(shards, "train", ["rung"])


def test_a_class_without_training_views_keeps_its_number(copy: Path) -> None:
    rewrite(copy, lambda rows: [row.update(split="val") for row in rows if row["category"] == "disc"])
    train = read_view_index(copy, "train")
    assert train.classes == ("bar", "disc", "ring") and set(train.labels.tolist()) == {0, 2}


def test_views_without_a_class_are_left_out_and_counted(copy: Path) -> None:
    rewrite(copy, lambda rows: [row.update(category=None) for row in rows if row["sequence"] == "bar_0"])
    train, val = (read_view_index(copy, split) for split in ("train", "val"))
    assert (len(train), train.left_out, val.left_out) == (16, 2, 0)
    assert "bar_0" not in train.sequences


def test_no_class_at_all_is_an_error_that_names_views_parquet(tmp_path: Path) -> None:
    write_labelled(tmp_path, shapes=("bar", "disc"), objects=1, unnamed=True)
    with pytest.raises(BadInput, match=r"views\.parquet: the views have no category.*classes"):
        read_view_index(tmp_path, "train")


def test_the_fingerprint_is_the_same_for_a_copy_and_another_for_other_labels(shards: Path, copy: Path) -> None:
    before = read_view_index(shards, "train").fingerprint
    assert read_view_index(copy, "train").fingerprint == before

    def swap(rows: list[dict[str, Any]]) -> None:
        rows[0]["category"], rows[-1]["category"] = rows[-1]["category"], rows[0]["category"]

    rewrite(copy, swap)
    assert read_view_index(copy, "train").fingerprint != before


def test_a_table_that_is_not_that_of_dataset_json_is_an_error(copy: Path) -> None:
    rows = pq.read_table(copy / "views.parquet").to_pylist()
    rows[0]["category"] = "disc"
    pq.write_table(pa.Table.from_pylist(rows), copy / "views.parquet")
    with pytest.raises(BadInput, match=r"views\.parquet: is not the one of dataset\.json"):
        read_view_index(copy, "train")


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:100])


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (lambda copy: (copy / "views.parquet").unlink(), "views.parquet"),
        (lambda copy: cut(copy / "views.parquet"), r"views\.parquet: cannot be read"),
        (lambda copy: (copy / "views.parquet").write_bytes(b""), r"views\.parquet: cannot be read"),
        (lambda copy: (copy / "dataset.json").unlink(), "no folder of shards"),
        (lambda copy: (copy / "dataset.json").write_text("{"), "dataset.json"),
        (lambda copy: (copy / "views-000000.tar").unlink(), r"views-000000\.tar: this shard is missing"),
        (lambda copy: cut(copy / "views-000000.tar"), r"views-000000\.tar: is not the shard .* 100 bytes instead of"),
        (lambda copy: rewrite(copy, lambda rows: [row.pop("category") for row in rows]), "lacks the columns category"),
        (lambda copy: rewrite(copy, lambda rows: rows[3].update(key=None)), "has rows without key"),
        (lambda copy: rewrite(copy, lambda rows: [r.update(offset="far") for r in rows]), "values of another kind"),
    ],
)
def test_what_is_missing_or_damaged_is_named(copy: Path, harm: Callable[[Path], object], message: str) -> None:
    harm(copy)
    with pytest.raises(BadInput, match=message):
        read_view_index(copy, "train")


def test_locations_are_where_the_samples_lie(shards: Path) -> None:
    index = read_view_index(shards, "val")
    data = (shards / "views-000000.tar").read_bytes()
    for row in range(len(index)):
        at = index.location(row)
        assert data[at.offset : at.offset + at.size].startswith(at.key.encode()) and at.shard == "views-000000.tar"
    assert np.all(index.sizes > 0)
