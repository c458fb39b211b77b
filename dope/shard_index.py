"""The index of a folder of shards, checked against the shards before anything is trained or evaluated."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dope.common import files
from dope.common.errors import BadInput
from dope.tar_samples import REMAKE, ShardReader

COLUMNS = ("key", "shard", "offset", "size", "sequence", "split")


@dataclass(frozen=True)
class SampleIndex:
    """The samples of one split, in the order in which they were written.

    Attributes:
        folder: where the shards lie.
        keys, shards, sequences: (N,) str.
        offsets, sizes: (N,) int64, the bytes of each sample in its shard.
        objects: (N,) int64, the place of the sample's sequence in the sorted list of all sequences of the dataset.
        fingerprint: of the contents of this split's shards, the same for every copy.
    """

    folder: Path
    keys: NDArray[np.str_]
    shards: NDArray[np.str_]
    sequences: NDArray[np.str_]
    offsets: NDArray[np.int64]
    sizes: NDArray[np.int64]
    objects: NDArray[np.int64]
    fingerprint: str

    def __len__(self) -> int:
        return len(self.keys)


def read_index(folder: Path, split: str) -> SampleIndex:
    """Read `index.parquet` and `dataset.json` and check that the shards of a split are those they describe.

    Presence, size and the first sample of each shard are checked, not every byte (`verify_hashes` does).

    Raises:
        BadInput: a file is missing, cut off, or of another dataset; the message names it and what to do.
    """
    manifest = read_manifest(folder)
    table = read_table(folder / "index.parquet", COLUMNS)
    recorded = files.read_json(folder / "dataset.json").get("tables", {}).get("index.parquet")
    if recorded is not None and files.sha256_of(folder / "index.parquet") != recorded:
        raise BadInput("is not the one of dataset.json", where=folder / "index.parquet", remedy=REMAKE)
    sequences = np.unique(table["sequence"].to_numpy(zero_copy_only=False).astype(str))
    table = table.filter(pc.equal(table["split"], split))
    columns = {name: table[name].to_numpy(zero_copy_only=False) for name in COLUMNS}
    names = columns["sequence"].astype(str)
    index = SampleIndex(
        folder=folder,
        keys=columns["key"].astype(str),
        shards=columns["shard"].astype(str),
        sequences=names,
        offsets=columns["offset"].astype(np.int64),
        sizes=columns["size"].astype(np.int64),
        objects=np.searchsorted(sequences, names),
        fingerprint=_fingerprint({name: manifest[name]["sha256"] for name in sorted(manifest) if _is_of(name, split)}),
    )
    _check_shards(index, manifest, split)
    return index


def read_manifest(folder: Path) -> dict[str, dict[str, Any]]:
    """The shards that `dataset.json` lists: name -> {"sha256", "bytes", "samples"}."""
    if not folder.is_dir():
        raise BadInput("no such folder", where=folder, remedy="SHARDS is what `dope prep shards --out` wrote")
    path = folder / "dataset.json"
    if not path.is_file():
        raise BadInput(
            "is no folder of shards: it has no dataset.json",
            where=folder,
            remedy="SHARDS is what `dope prep shards --out` wrote; dataset.json is written last, so an interrupted run "
            "must be run again",
        )
    shards = files.read_json(path).get("shards")
    if not isinstance(shards, dict) or not all(isinstance(s, dict) and "sha256" in s for s in shards.values()):
        raise BadInput("lists no shards", where=path, remedy=REMAKE)
    return shards


def verify_hashes(folder: Path, split: str | None = None) -> None:
    """Read every shard (of a split) whole and compare its SHA-256. Raises `BadInput` naming the first that differs."""
    for name, entry in read_manifest(folder).items():
        if (split is None or _is_of(name, split)) and files.sha256_of(folder / name) != entry["sha256"]:
            raise BadInput("its SHA-256 is not the one in dataset.json", where=folder / name, remedy=REMAKE)


def read_table(path: Path, columns: Sequence[str]) -> pa.Table:
    """A Parquet file that has these columns. Raises `BadInput` where it is absent, damaged or lacks one."""
    try:
        table = pq.read_table(path)
    except FileNotFoundError:
        raise BadInput("no such file", where=path, remedy=REMAKE) from None
    except (pa.ArrowException, OSError) as error:
        raise BadInput(f"cannot be read ({error})", where=path, remedy=REMAKE) from error
    missing = [name for name in columns if name not in table.column_names]
    if missing:
        raise BadInput(f"lacks the columns {', '.join(missing)}", where=path, remedy=REMAKE)
    return table


def _check_shards(index: SampleIndex, manifest: dict[str, dict[str, Any]], split: str) -> None:
    """Each shard of the split is there, has its size and its number of samples, and starts with the right sample."""
    indexed, first, counts = np.unique(index.shards, return_index=True, return_counts=True)
    samples = dict(zip(indexed.tolist(), counts.tolist(), strict=True))
    listed = [name for name in manifest if _is_of(name, split)]
    for name in sorted({*listed, *samples}):
        path = index.folder / name
        if name not in manifest:
            raise BadInput("is in index.parquet but not in dataset.json", where=path, remedy=REMAKE)
        if not path.is_file():
            raise BadInput("this shard is missing", where=path, remedy=REMAKE)
        size, expected = path.stat().st_size, manifest[name].get("bytes")
        if expected is not None and size != expected:
            state = "is cut off" if size < expected else "is of another dataset"
            raise BadInput(f"{state}: {size:,} bytes instead of {expected:,}", where=path, remedy=REMAKE)
        if manifest[name].get("samples", samples.get(name, 0)) != samples.get(name, 0):
            raise BadInput(
                f"index.parquet has {samples.get(name, 0)} samples of it, dataset.json {manifest[name]['samples']}",
                where=path,
                remedy=REMAKE,
            )
    ends = np.zeros(len(indexed), np.int64)
    np.maximum.at(ends, np.searchsorted(indexed, index.shards), index.offsets + index.sizes)
    reader = ShardReader(index.folder)
    for name, row, end in zip(indexed.tolist(), first.tolist(), ends.tolist(), strict=True):
        size = (index.folder / name).stat().st_size
        if size < end:
            raise BadInput(
                f"is cut off: {size:,} bytes, its samples need {end:,}", where=reader.folder / name, remedy=REMAKE
            )
        reader.sample(name, int(index.offsets[row]), int(index.sizes[row]), str(index.keys[row]))
        reader.close()


def _is_of(shard: str, split: str) -> bool:
    return shard.startswith(split + "-")


def _fingerprint(hashes: dict[str, str]) -> str:
    return hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()[:16]
