"""The index of a folder of shards, checked against the shards before anything is trained or evaluated."""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dope.common.errors import BadInput, UsageError
from dope.storage import REMEDY, Shards, Storage, open_storage, reason_of
from dope.tar_samples import REMAKE, Location, OtherSample, ShardReader

COLUMNS = ("key", "shard", "offset", "size", "sequence", "split", "n_correspondences", "category")
CHECKED_TOGETHER = 64
"""Shards whose first samples are read at a time."""


@dataclass(frozen=True)
class SampleIndex:
    """The samples of one split, in the order in which they were written.

    Attributes:
        storage: where the shards lie.
        keys, shards, sequences: (N,) str.
        offsets, sizes: (N,) int64, the bytes of each sample in its shard.
        correspondences: (N,) int64, how many each sample has.
        categories: (N,) str, empty where the object has none.
        objects: (N,) int64, the place of the sample's sequence in the sorted list of all sequences of the dataset.
        fingerprint: of the contents of this split's shards, the same for every copy.
        left_out: samples that the split has besides these.
    """

    storage: Storage
    keys: NDArray[np.str_]
    shards: NDArray[np.str_]
    sequences: NDArray[np.str_]
    offsets: NDArray[np.int64]
    sizes: NDArray[np.int64]
    correspondences: NDArray[np.int64]
    categories: NDArray[np.str_]
    objects: NDArray[np.int64]
    fingerprint: str
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.keys)

    def location(self, row: int) -> Location:
        """Where a sample lies."""
        return Location(str(self.shards[row]), int(self.offsets[row]), int(self.sizes[row]), str(self.keys[row]))

    def with_correspondences(self, least: int) -> SampleIndex:
        """Only the samples with at least so many. Raises `BadInput` where there are samples, but no such ones."""
        enough = self.correspondences >= least
        if enough.all():
            return self
        if not enough.any():
            most = int(self.correspondences.max())
            raise BadInput(
                f"none of its {len(self):,} pairs has {least} correspondences; the most are {most}",
                where=self.storage.where("index.parquet"),
                remedy=f"Use --set data.min_correspondences={most}, or prepare more overlapping views "
                "(`dope prep correspond`)"
                if most
                else "Prepare other views: `dope prep status` says why pairs have no correspondences",
            )
        return replace(self._where(enough), left_out=self.left_out + int((~enough).sum()))

    def of_categories(self, names: Sequence[str]) -> SampleIndex:
        """Only the samples of objects of these categories; of all where none is given.

        Raises:
            UsageError: a category of which there is no sample.
        """
        if not names or not len(self):
            return self
        check_categories(names, self.categories.tolist(), self.storage.address)
        return self._where(np.isin(self.categories, list(names)))

    def _where(self, chosen: NDArray[np.bool_]) -> SampleIndex:
        columns = ("keys", "shards", "sequences", "offsets", "sizes", "correspondences", "categories", "objects")
        return replace(self, **{name: getattr(self, name)[chosen] for name in columns})


def check_categories(names: Sequence[str], known: Iterable[str], where: str) -> None:
    """Raise `UsageError` naming the first category that is not among the known ones, with the closest of them."""
    there = sorted({name for name in known if name})
    for name in names:
        if name not in there:
            close = difflib.get_close_matches(name, there, n=3, cutoff=0.5)
            shown = ", ".join(there[:8]) + (" ..." if len(there) > 8 else "")
            hint = f"did you mean {' or '.join(map(repr, close))}?" if close else f"there are: {shown or 'none'}"
            raise UsageError(f"no samples of category '{name}' ({hint})", where=where, remedy="See data.categories")


def read_index(shards: Shards, split: str) -> SampleIndex:
    """Read `index.parquet` and `dataset.json` and check that the shards of a split are those they describe.

    Presence, size and the first sample of each shard are checked, not every byte (`verify_hashes` does).

    Raises:
        BadInput: a file is missing, cut off, or of another dataset; the message names it and what to do.
    """
    storage = open_storage(shards)
    sizes = storage.sizes()
    manifest = read_manifest(storage, sizes)
    table, digest = read_table(storage, "index.parquet", COLUMNS, may_be_null=("category",))
    tables = storage.read_json("dataset.json").get("tables")
    if isinstance(tables, dict) and tables.get("index.parquet", digest) != digest:
        raise BadInput("is not the one of dataset.json", where=storage.where("index.parquet"), remedy=REMAKE)
    try:
        sequences = np.unique(table["sequence"].to_numpy(zero_copy_only=False).astype(str))
        table = table.filter(pc.equal(table["split"], split))
        columns = {name: table[name].to_numpy(zero_copy_only=False) for name in COLUMNS}
        names = columns["sequence"].astype(str)
        index = SampleIndex(
            storage=storage,
            keys=columns["key"].astype(str),
            shards=columns["shard"].astype(str),
            sequences=names,
            offsets=columns["offset"].astype(np.int64),
            sizes=columns["size"].astype(np.int64),
            correspondences=columns["n_correspondences"].astype(np.int64),
            categories=np.array([name or "" for name in table["category"].to_pylist()], str),
            objects=np.searchsorted(sequences, names),
            fingerprint=fingerprint_of({name: entry["sha256"] for name, entry in manifest.items()}, split),
        )
    except (pa.ArrowException, ValueError, TypeError) as error:
        what = f"has values of another kind than `dope prep shards` writes ({reason_of(error)})"
        raise BadInput(what, where=storage.where("index.parquet"), remedy=REMAKE) from error
    _check_shards(index, manifest, sizes, split)
    return index


def read_manifest(storage: Storage, files: dict[str, int]) -> dict[str, dict[str, Any]]:
    """The shards that `dataset.json` lists: name -> {"sha256", "bytes", "samples"}; `files` is what is there."""
    if "dataset.json" not in files:
        raise BadInput(
            "is no folder of shards: it has no dataset.json",
            where=storage.address,
            remedy=f"{REMEDY}; dataset.json is written last, so an interrupted run must be run again",
        )
    values = storage.read_json("dataset.json")
    shards = values.get("shards") if isinstance(values, dict) else None
    if not isinstance(shards, dict) or not all(map(_describes_shard, shards.values())):
        raise BadInput("lists no shards", where=storage.where("dataset.json"), remedy=REMAKE)
    return shards


def verify_hashes(shards: Shards, split: str | None = None) -> None:
    """Read every shard (of a split) whole and compare its SHA-256. Raises `BadInput` naming the first that differs."""
    storage = open_storage(shards)
    for name, entry in read_manifest(storage, storage.sizes()).items():
        if (split is None or _is_of(name, split)) and storage.sha256(name) != entry["sha256"]:
            raise BadInput("its SHA-256 is not the one in dataset.json", where=storage.where(name), remedy=REMAKE)


def read_table(
    storage: Storage, name: str, columns: Sequence[str], may_be_null: Sequence[str] = ()
) -> tuple[pa.Table, str]:
    """A Parquet file that has these columns, with a value in every row but those of `may_be_null`; and its SHA-256.

    Raises:
        BadInput: it is absent, damaged or lacks a column.
    """
    data = storage.read_bytes(name)
    try:
        table = pq.read_table(pa.BufferReader(data))
    except (pa.ArrowException, OSError) as error:
        raise BadInput(f"cannot be read ({error})", where=storage.where(name), remedy=REMAKE) from error
    missing = [column for column in columns if column not in table.column_names]
    if missing:
        raise BadInput(f"lacks the columns {', '.join(missing)}", where=storage.where(name), remedy=REMAKE)
    holes = [column for column in columns if table[column].null_count and column not in may_be_null]
    if holes:
        raise BadInput(f"has rows without {', '.join(holes)}", where=storage.where(name), remedy=REMAKE)
    return table, hashlib.sha256(data).hexdigest()


def _check_shards(index: SampleIndex, manifest: dict[str, dict[str, Any]], sizes: dict[str, int], split: str) -> None:
    """Each shard of the split is there, has its size and its number of samples, and holds the samples of the index."""
    indexed, first, counts = np.unique(index.shards, return_index=True, return_counts=True)
    samples = dict(zip(indexed.tolist(), counts.tolist(), strict=True))
    listed = [name for name in manifest if _is_of(name, split)]
    ends = np.zeros(len(indexed), np.int64)
    np.maximum.at(ends, np.searchsorted(indexed, index.shards), index.offsets + index.sizes)
    needed = dict(zip(indexed.tolist(), ends.tolist(), strict=True))
    for name in sorted({*listed, *samples}):
        where = index.storage.where(name)
        if name not in manifest:
            raise BadInput("is in index.parquet but not in dataset.json", where=where, remedy=REMAKE)
        if name not in sizes:
            raise BadInput("this shard is missing", where=where, remedy=REMAKE)
        size, expected = sizes[name], manifest[name].get("bytes")
        if expected is not None and size != expected:
            state = "is cut off" if size < expected else "is of another dataset"
            raise BadInput(f"{state}: {size:,} bytes instead of {expected:,}", where=where, remedy=REMAKE)
        if manifest[name].get("samples", samples.get(name, 0)) != samples.get(name, 0):
            raise BadInput(
                f"index.parquet has {samples.get(name, 0)} samples of it, dataset.json {manifest[name]['samples']}",
                where=where,
                remedy=REMAKE,
            )
        if size < needed.get(name, 0):
            what = f"is cut off: {size:,} bytes, its samples need {needed[name]:,}"
            raise BadInput(what, where=where, remedy=REMAKE)
    _check_samples(index, first)


def _check_samples(index: SampleIndex, first: NDArray[np.integer]) -> None:
    """The shards' first samples are where the index says, or where one is damaged, the shard's last one."""
    last = {name: row for row, name in enumerate(index.shards.tolist())}
    reader = ShardReader(index.storage)
    for start in range(0, len(first), CHECKED_TOGETHER):
        rows = first[start : start + CHECKED_TOGETHER].tolist()
        for row, members in zip(rows, reader.samples([index.location(row) for row in rows]), strict=True):
            if isinstance(members, OtherSample):
                raise members
            if isinstance(members, BadInput):
                (other,) = reader.samples([index.location(last[str(index.shards[row])])])
                if isinstance(other, BadInput):
                    raise members
    reader.close()


def _describes_shard(entry: Any) -> bool:
    if not isinstance(entry, dict) or not isinstance(entry.get("sha256"), str):
        return False
    return all(isinstance(entry.get(name, 0), int) for name in ("bytes", "samples"))


def _is_of(shard: str, split: str) -> bool:
    return shard.startswith(split + "-")


def fingerprint_of(hashes: Mapping[str, Any], split: str) -> str:
    """16 hex digits of the shards of a split, by the SHA-256 of each."""
    own = {name: value for name, value in hashes.items() if _is_of(name, split)}
    return hashlib.sha256(json.dumps(own, sort_keys=True).encode()).hexdigest()[:16]
