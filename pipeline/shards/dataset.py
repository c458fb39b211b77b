"""Sequences to a folder of WebDataset shards with an index, whole or not at all, the same bytes every time."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import dope
from dope.common import files, settings
from dope.common.errors import BadInput, UsageError
from pipeline.engines import Share, holding_output
from pipeline.sequence import Sequence
from pipeline.shards.catalogue import read_catalogue
from pipeline.shards.parts import clear_parts, write_part
from pipeline.shards.plan import ShardsConfig, TarPlan, plan_tars
from pipeline.shards.writer import SCHEMAS, SequenceContents, WrittenShard, write_tar

FORMAT = 1  # of the folder; a new number makes every dataset be written anew
OURS = re.compile(r"(train|val|views)-\d{6}\.tar|index\.parquet|views\.parquet|dataset\.json|\.lock|\..+\.partial.*")
KEPT = 8192  # sequences whose tables stay in memory between their samples: rounds visit them in turn, some 100 MB
ROWS = 1 << 20  # of a table that are written at once
REDO = "Copy the shards again from where they came, or write them anew with `dope prep shards --overwrite`"

Progress = Callable[[int, int], None]
"""Called with the samples written and the samples in all."""

EVERYTHING = Share()


def write_shards(
    sequences: list[Sequence],
    out: Path,
    config: ShardsConfig,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
    share: Share = EVERYTHING,
    wait: bool = False,
) -> dict[str, Any]:
    """Pack the views and pairs of sequences whose correspond stage is ok into `out`.

    The old contents of `out` stay until the new are whole. The order of `sequences` does not matter.

    Args:
        share: the part of the tars that this container writes; the last to finish completes the folder.
        wait: where another process writes `out`, wait for it; else it is an error.

    Returns:
        Counts by split, sequences left out with reasons, sequences without validation pairs, "skipped": True where
        `out` already holds exactly this, and for a share "waiting_for": how many tars others have still to write.

    Raises:
        BadInput: no sequence can be used, two have the same id, or another process writes `out`.
        UsageError: a setting makes no sense, or `out` holds something that is not a dataset.
        DiskFull: no space left; what was in `out` is untouched.
    """
    check_output(out, config)
    out = out.resolve()
    catalogue, marks, left_out = read_catalogue(sequences)
    if not len(catalogue):
        reasons = "; ".join(f"{id}: {reason}" for id, reason in list(left_out.items())[:3])
        waiting = not reasons or "has not been run" in reasons
        remedy = "Run `dope prep correspond` first" if waiting else "`dope prep status WORK` says why"
        raise BadInput(f"no sequence has correspondences ({reasons or 'WORK holds none'})", remedy=remedy)
    mark = settings.config_hash(
        {"format": FORMAT, "config": settings.to_dict(config), "sequences": marks, "left_out": left_out}
    )
    if not overwrite and (there := same_dataset(out, mark)):
        clear_parts(out, mark)
        return {**there, "skipped": True}
    plan, details = plan_tars(catalogue, config)
    details["left_out"] = left_out
    contents = functools.lru_cache(maxsize=KEPT)(lambda k: SequenceContents.read(catalogue.sequences[k]))
    total, done = sum(len(tar) for tar in share.of(plan)), 0

    def write(path: Path, tar: TarPlan) -> WrittenShard:
        nonlocal done
        written = write_tar(path, tar.kind, tar.samples(contents), tar.name)
        done += len(tar)
        if progress:
            progress(done, total)
        return written

    def finish(folder: Path, written: list[WrittenShard]) -> None:
        details["bytes"] = sum(shard.entry["bytes"] for shard in written)
        write_tables(folder, written, {"fingerprint": mark, "counts": details, "settings": settings.to_dict(config)})

    if share.count > 1:
        waiting_for = write_part(out, mark, plan, share, write, finish)
        if not waiting_for:
            clear_parts(out)
        return {**details, "skipped": False, "waiting_for": waiting_for}
    with holding_output(out, wait=wait):
        if not overwrite and (there := same_dataset(out, mark)):  # written by the one that was waited for
            return {**there, "skipped": True}
        with files.atomic_folder(out) as folder:
            finish(folder, [write(folder / tar.name, tar) for tar in plan])
        clear_parts(out)
    return {**details, "skipped": False}


def write_tables(folder: Path, written: list[WrittenShard], facts: dict[str, Any]) -> None:
    """index.parquet, views.parquet and, last, dataset.json beside the tars."""
    for name, kind in (("index.parquet", "pairs"), ("views.parquet", "views")):
        rows = pa.concat_tables(
            [SCHEMAS[kind].empty_table(), *(shard.rows for shard in written if shard.kind == kind)],
        )
        with files.atomic_path(folder / name) as partial, pq.ParquetWriter(partial, rows.schema) as table:
            for start in range(0, max(1, len(rows)), ROWS):
                table.write_table(rows.slice(start, ROWS).combine_chunks())
    manifest = {
        "format": FORMAT,
        **facts,
        "shards": {shard.name: shard.entry for shard in written},
        "tables": {name: files.sha256_of(folder / name) for name in ("index.parquet", "views.parquet")},
        "versions": {"dope": dope.__version__, "numpy": np.__version__, "pyarrow": pa.__version__},
    }
    files.write_json(folder / "dataset.json", manifest)


def verify_shards(folder: Path) -> dict[str, int]:
    """Compare a folder of shards, every byte of it, with its dataset.json.

    Returns:
        The number of shards, samples and bytes.

    Raises:
        BadInput: something is missing, cut off, changed or in disagreement; the message names the file.
    """
    if not (folder / "dataset.json").is_file():
        raise BadInput("is no folder of shards: it has no dataset.json", where=folder, remedy=REDO)
    manifest = files.read_json(folder / "dataset.json")
    try:
        shards, tables = manifest["shards"], manifest["tables"]
        expected = [(name, entry["bytes"], entry["sha256"]) for name, entry in shards.items()]
        counted = {name: entry["samples"] for name, entry in shards.items()}
    except (KeyError, TypeError, AttributeError):
        raise BadInput("does not list its shards", where=folder / "dataset.json", remedy=REDO) from None
    for name, size, sha256 in [*expected, *((name, None, sha256) for name, sha256 in tables.items())]:
        _check_file(folder / name, size, sha256)
    indexed = _indexed_samples(folder)
    for name, n in indexed.items():
        if n != counted.pop(name, None):
            raise BadInput(
                f"the tables count {n} samples in it, dataset.json does not", where=folder / name, remedy=REDO
            )
    if counted:
        raise BadInput("the tables have no sample of this shard", where=folder / min(counted), remedy=REDO)
    return {"shards": len(expected), "samples": sum(indexed.values()), "bytes": sum(size for _, size, _ in expected)}


def _check_file(path: Path, size: int | None, sha256: str) -> None:
    if not path.is_file():
        raise BadInput("is missing", where=path, remedy=REDO)
    found = path.stat().st_size
    if size is not None and found != size:
        state = "is cut off" if found < size else "is too long"
        raise BadInput(f"{state}: {found:,} bytes instead of {size:,}", where=path, remedy=REDO)
    if files.sha256_of(path) != sha256:
        raise BadInput("is damaged: its SHA-256 is not the one in dataset.json", where=path, remedy=REDO)


def _indexed_samples(folder: Path) -> dict[str, int]:
    counts: dict[str, int] = {}
    for name in ("index.parquet", "views.parquet"):
        shards = pq.read_table(folder / name, columns=["shard"])["shard"]
        counts |= {row["values"]: row["counts"] for row in shards.value_counts().to_pylist()}
    return counts


def check_output(out: Path, config: ShardsConfig) -> None:
    """Raise `UsageError` for settings that make no sense, or an `out` that must not be replaced."""
    _check_settings(config)
    check_folder(out.resolve())


def _check_settings(config: ShardsConfig) -> None:
    if config.samples_per_shard < 1:
        raise UsageError(f"must be positive, not {config.samples_per_shard}", where="samples_per_shard")
    if config.holdout != "none" and not 0 < config.val_fraction < 1:
        remedy = "Use --holdout none to hold nothing out"
        raise UsageError(f"must lie between 0 and 1, not {config.val_fraction}", where="val_fraction", remedy=remedy)


def check_folder(out: Path) -> None:
    """Writing replaces `out` as a whole: refuse to do so to anything that is not a dataset."""
    if out.exists() and not out.is_dir():
        raise UsageError("is a file, not a folder", where=out, remedy="Choose another --out")
    if out.is_mount():
        remedy = f"Name a folder inside it, e.g. {out / 'shards'}"
        raise UsageError("is a mount point, and a dataset is replaced as a whole", where=out, remedy=remedy)
    foreign = sorted(path.name for path in out.iterdir() if not OURS.fullmatch(path.name)) if out.exists() else []
    if foreign:
        listed = ", ".join(foreign[:3]) + (" ..." if len(foreign) > 3 else "")
        remedy = "Choose an empty or new folder with --out; nothing was written or removed"
        raise UsageError(f"holds files that are not shards ({listed})", where=out, remedy=remedy)


def same_dataset(out: Path, mark: str) -> dict[str, Any] | None:
    """The counts of the dataset in `out` if it is whole and of this fingerprint."""
    try:
        manifest = files.read_json(out / "dataset.json")
        sizes = {name: entry["bytes"] for name, entry in manifest["shards"].items()}
        whole = all((out / name).stat().st_size == size for name, size in sizes.items())
        tables = all((out / name).is_file() for name in manifest["tables"])
        return manifest["counts"] if manifest["fingerprint"] == mark and whole and tables else None
    except (BadInput, OSError, KeyError, TypeError, AttributeError):
        return None  # absent or damaged: it will be written anew
