"""Which single views a folder of shards holds, for methods that learn from views and their classes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dope.common.errors import BadInput
from dope.shard_index import check_categories, read_manifest, read_table
from dope.storage import Shards, Storage, open_storage, reason_of
from dope.tar_samples import REMAKE, Location

COLUMNS = ("key", "shard", "offset", "size", "sequence", "split", "category")


@dataclass(frozen=True)
class ViewIndex:
    """The views of one split that have a category, in the order in which they were written.

    Attributes:
        storage: where the shards lie.
        keys, shards, sequences: (N,) str.
        offsets, sizes: (N,) int64, the bytes of each sample in its shard.
        labels: (N,) int64, places in `classes`.
        classes: sorted names of the categories, of all splits: the same numbers in training and in validation.
        objects: (N,) int64, the place of the view's sequence in the sorted list of all sequences.
        fingerprint: of the contents of the shards, of the choice of classes and of the labels.
        left_out: views of the split without a category.
    """

    storage: Storage
    keys: NDArray[np.str_]
    shards: NDArray[np.str_]
    sequences: NDArray[np.str_]
    offsets: NDArray[np.int64]
    sizes: NDArray[np.int64]
    labels: NDArray[np.int64]
    classes: tuple[str, ...]
    objects: NDArray[np.int64]
    fingerprint: str
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.keys)

    def location(self, row: int) -> Location:
        """Where a sample lies."""
        return Location(str(self.shards[row]), int(self.offsets[row]), int(self.sizes[row]), str(self.keys[row]))


def read_view_index(shards: Shards, split: str, categories: Sequence[str] = ()) -> ViewIndex:
    """Read `views.parquet`: the views of a split, of some categories (none given: of all).

    Presence and size of each shard are checked; its samples when they are read.

    Raises:
        BadInput: a file is missing, cut off, or of another dataset; or no view has a category.
        UsageError: a category of which there is no view.
    """
    storage = open_storage(shards)
    there = storage.sizes()
    manifest = read_manifest(storage, there)
    table, digest = read_table(storage, "views.parquet", COLUMNS, may_be_null=("category",))
    where, tables = storage.where("views.parquet"), storage.read_json("dataset.json").get("tables")
    if isinstance(tables, dict) and tables.get("views.parquet", digest) != digest:
        raise BadInput("is not the one of dataset.json", where=where, remedy=REMAKE)
    try:
        columns = {name: np.array(table[name].to_pylist(), object) for name in COLUMNS}
        names = np.array([name or "" for name in columns["category"]], str)
        sequences = columns["sequence"].astype(str)
        offsets, sizes = columns["offset"].astype(np.int64), columns["size"].astype(np.int64)
    except (pa.ArrowException, ValueError, TypeError) as error:
        what = f"has values of another kind than `dope prep shards` writes ({reason_of(error)})"
        raise BadInput(what, where=where, remedy=REMAKE) from error
    of_split = columns["split"] == split
    if not (names != "").any():
        remedy = "This method learns from classes: give them to `dope prep`, or train one that needs none"
        raise BadInput("the views have no category", where=where, remedy=remedy)
    if categories:
        check_categories(categories, names.tolist(), storage.address)
    chosen = np.isin(names, list(categories)) if categories else names != ""
    classes = sorted(set(names[chosen].tolist()))
    rows = of_split & chosen
    used = sorted(set(columns["shard"][rows].tolist()))
    for name in used:
        expected = manifest.get(name, {}).get("bytes")
        if name not in there or name not in manifest:
            raise BadInput("this shard is missing", where=storage.where(name), remedy=REMAKE)
        if expected is not None and there[name] != expected:
            what = f"is not the shard of dataset.json: {there[name]:,} bytes instead of {expected:,}"
            raise BadInput(what, where=storage.where(name), remedy=REMAKE)
    labels = np.searchsorted(classes, names[rows]).astype(np.int64)
    # the same photos may have been given other classes
    hashes = [{name: manifest[name]["sha256"] for name in used}, classes, hashlib.sha256(labels.tobytes()).hexdigest()]
    return ViewIndex(
        storage=storage,
        keys=columns["key"][rows].astype(str),
        shards=columns["shard"][rows].astype(str),
        sequences=sequences[rows],
        offsets=offsets[rows],
        sizes=sizes[rows],
        labels=labels,
        classes=tuple(classes),
        objects=np.searchsorted(np.unique(sequences), sequences[rows]).astype(np.int64),
        fingerprint=hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()[:16],
        left_out=int((of_split & (names == "")).sum()),
    )
