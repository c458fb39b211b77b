"""Sequences to a folder of WebDataset shards with an index, whole or not at all, the same bytes every time."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import dope
from dope.common import files, seeds, settings
from dope.common.errors import BadInput, UsageError
from pipeline.engines import Share
from pipeline.holdout import held_out_arc, held_out_objects
from pipeline.sequence import Sequence
from pipeline.shard_parts import Plan, write_part
from pipeline.shard_writer import PairSample, SequenceContents, ViewSample, WrittenShard, write_tar
from pipeline.stages import read_marker

FORMAT = 1  # of the folder; a new number makes every dataset be written anew
OURS = re.compile(r"(train|val|views)-\d{6}\.tar|index\.parquet|views\.parquet|dataset\.json|\.lock")
REDO = "Copy the shards again from where they came, or write them anew with `dope prep shards --overwrite`"

_PLACE = [("key", pa.string()), ("shard", pa.string()), ("offset", pa.int64()), ("size", pa.int64())]
_NAMES = [("sequence", pa.string()), ("instance", pa.string()), ("category", pa.string()), ("split", pa.string())]
INDEX_SCHEMA = pa.schema(
    [
        *_PLACE,
        *_NAMES,
        ("frame1", pa.int32()),
        ("frame2", pa.int32()),
        ("n_correspondences", pa.int32()),
        ("angle_deg", pa.float64()),
        ("overlap", pa.float64()),
    ]
)
VIEWS_SCHEMA = pa.schema([*_PLACE, *_NAMES, ("frame", pa.int32()), ("mask_share", pa.float64())])


@dataclass(frozen=True)
class ShardsConfig:
    """How samples are split and packed."""

    samples_per_shard: int = 1024
    """Samples in one tar, about 60 MB of pairs; the samples are spread evenly over the tars."""
    holdout: Literal["frames", "sequences", "none"] = "frames"
    """What validation sees: neighbouring views of every object, whole objects, or nothing."""
    val_fraction: float = 0.25
    """Share of each object's views (holdout=frames) or of the objects (holdout=sequences) that is held out."""
    seed: int = 0
    """Shuffles the pairs and chooses what is held out."""


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
) -> dict[str, Any]:
    """Pack the views and pairs of sequences whose correspond stage is ok into `out`.

    The old contents of `out` stay until the new are whole. The order of `sequences` does not matter.

    Args:
        share: the part of the tars that this container writes; the last to finish completes the folder.

    Returns:
        Counts by split, sequences left out with reasons, sequences without validation pairs, "skipped": True where
        `out` already holds exactly this, and for a share "waiting_for": how many tars others have still to write.

    Raises:
        BadInput: no sequence can be used, or two have the same id.
        UsageError: a setting makes no sense, or `out` holds something that is not a dataset.
        DiskFull: no space left; what was in `out` is untouched.
    """
    _check_settings(config)
    out = out.resolve()
    _check_folder(out)
    contents, marks, left_out = _usable(sequences)
    if not contents:
        reasons = "; ".join(f"{id}: {reason}" for id, reason in list(left_out.items())[:3])
        raise BadInput(
            f"no sequence has correspondences ({reasons or 'none was given'})",
            remedy="Run `dope prep correspond` first",
        )
    mark = settings.config_hash(
        {"format": FORMAT, "config": settings.to_dict(config), "sequences": marks, "left_out": left_out}
    )
    if not overwrite and (there := _same_dataset(out, mark)):
        return {**there, "skipped": True}
    plan, details = _plan(contents, config)
    details["left_out"] = left_out
    ours = share.of(plan)
    total, done = sum(len(samples) for _, samples in ours), 0

    def report(n: int) -> None:
        nonlocal done
        done += n
        if progress:
            progress(done, total)

    def finish(folder: Path, written: list[WrittenShard]) -> None:
        details["bytes"] = sum(shard.entry["bytes"] for shard in written)
        _write_tables(folder, written, {"fingerprint": mark, "counts": details, "settings": settings.to_dict(config)})

    if share.count > 1:
        waiting_for = write_part(out, mark, plan, share, finish, report)
        return {**details, "skipped": False, "waiting_for": waiting_for}
    with files.atomic_folder(out) as folder:
        written = []
        for name, samples in plan:
            written.append(write_tar(folder / name, samples))
            report(len(samples))
        finish(folder, written)
    return {**details, "skipped": False}


def _write_tables(folder: Path, written: list[WrittenShard], facts: dict[str, Any]) -> None:
    """index.parquet, views.parquet and, last, dataset.json beside the tars."""
    for name, schema, of_views in (("index.parquet", INDEX_SCHEMA, False), ("views.parquet", VIEWS_SCHEMA, True)):
        rows = [row for shard in written if shard.name.startswith("views-") == of_views for row in shard.rows]
        with files.atomic_path(folder / name) as partial:
            pq.write_table(pa.Table.from_pylist(rows, schema), partial)
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


def _check_settings(config: ShardsConfig) -> None:
    if config.samples_per_shard < 1:
        raise UsageError(f"must be positive, not {config.samples_per_shard}", where="samples_per_shard")
    if config.holdout != "none" and not 0 < config.val_fraction < 1:
        remedy = "Use --holdout none to hold nothing out"
        raise UsageError(f"must lie between 0 and 1, not {config.val_fraction}", where="val_fraction", remedy=remedy)


def _check_folder(out: Path) -> None:
    """Writing replaces `out` as a whole: refuse to do so to anything that is not a dataset."""
    if out.exists() and not out.is_dir():
        raise UsageError("is a file, not a folder", where=out, remedy="Choose another --out")
    foreign = sorted(path.name for path in out.iterdir() if not OURS.fullmatch(path.name)) if out.exists() else []
    if foreign:
        listed = ", ".join(foreign[:3]) + (" ..." if len(foreign) > 3 else "")
        remedy = "Choose an empty or new folder with --out; nothing was written or removed"
        raise UsageError(f"holds files that are not shards ({listed})", where=out, remedy=remedy)


def _usable(sequences: list[Sequence]) -> tuple[list[SequenceContents], list[list[str | None]], dict[str, str]]:
    """The sequences that can be packed, sorted by id; what identifies each; the others with the reason."""
    contents: list[SequenceContents] = []
    marks: list[list[str | None]] = []
    left_out: dict[str, str] = {}
    ordered = sorted(sequences, key=lambda sequence: sequence.id)
    for before, after in itertools.pairwise(ordered):
        if before.id == after.id:
            raise BadInput(
                f"has the same id as {before.folder}", where=after.folder, remedy="Rename one of the folders"
            )
    for sequence in ordered:
        marker = read_marker(sequence, "correspond")
        if marker is None:
            left_out[sequence.id] = "stage 'correspond' has not been run"
        elif not marker.ok:
            left_out[sequence.id] = f"stage 'correspond' {marker.status}: {marker.reason}"
        else:
            try:
                found = SequenceContents.read(sequence)
            except BadInput as error:
                left_out[sequence.id] = str(error)
                continue
            contents.append(found)
            # the content, too: the same settings may have given something else (another version, more threads)
            content = marker.details.get("content")
            marks.append([sequence.id, marker.fingerprint, content, found.category, found.instance])
    return contents, marks, left_out


def _same_dataset(out: Path, mark: str) -> dict[str, Any] | None:
    """The counts of the dataset in `out` if it is whole and of this fingerprint."""
    try:
        manifest = files.read_json(out / "dataset.json")
        sizes = {name: entry["bytes"] for name, entry in manifest["shards"].items()}
        whole = all((out / name).stat().st_size == size for name, size in sizes.items())
        tables = all((out / name).is_file() for name in manifest["tables"])
        return manifest["counts"] if manifest["fingerprint"] == mark and whole and tables else None
    except (BadInput, OSError, KeyError, TypeError, AttributeError):
        return None  # absent or damaged: it will be written anew


def _plan(contents: list[SequenceContents], config: ShardsConfig) -> tuple[Plan, dict[str, Any]]:
    """Name and samples of every tar (pairs of each split in rounds, views in order), and the counts."""
    objects = {one.id: (one.category, one.instance) for one in contents}
    val_ids = held_out_objects(objects, config.val_fraction, config.seed) if config.holdout == "sequences" else set()
    of_object: dict[str, list[list[PairSample]]] = {"train": [], "val": []}
    views: list[ViewSample] = []
    mixed, without_val = 0, []
    for one in contents:
        held = np.full(len(one.frames), one.id in val_ids)
        if config.holdout == "frames":
            held = held_out_arc(one.frames, one.pair_frames, config.val_fraction, config.seed, one.id)
            if not held.any():
                without_val.append(one.id)
        views += [ViewSample(one, int(f), "val" if h else "train") for f, h in zip(one.frames, held, strict=True)]
        sides = held[np.searchsorted(one.frames, one.pair_frames)]  # (P, 2)
        order = seeds.generator("pairs of", config.seed, one.id).permutation(len(sides))
        for split, is_val in (("train", False), ("val", True)):
            rows = [int(row) for row in order if (sides[row] == is_val).all()]
            of_object[split].append([PairSample(one, row, split) for row in rows])
        mixed += int((sides[:, 0] != sides[:, 1]).sum())
    pairs = {split: list(rounds(samples, config.seed, split)) for split, samples in of_object.items()}
    details: dict[str, Any] = {
        "sequences": len(contents),
        "pairs": {split: len(samples) for split, samples in pairs.items()},
        "views": {split: sum(view.split == split for view in views) for split in ("train", "val")},
        "mixed_pairs_not_written": mixed,
        "without_val_pairs": without_val,
    }
    if config.holdout == "sequences":
        details["val_sequences"] = sorted(val_ids)
    plan: Plan = []
    kinds: list[tuple[str, list[PairSample] | list[ViewSample]]] = [*pairs.items(), ("views", views)]
    for kind, samples in kinds:
        n_shards = -(-len(samples) // config.samples_per_shard)
        ends = [len(samples) * (k + 1) // n_shards for k in range(n_shards)]
        for k, (start, end) in enumerate(zip([0, *ends], ends, strict=False)):
            plan.append((f"{kind}-{k:06d}.tar", samples[start:end]))
    return plan, details


def rounds(samples: list[list[PairSample]], seed: int, split: str) -> Iterator[PairSample]:
    """Every object's first sample, then every object's second ...; within a round the objects are shuffled."""
    for n in range(max(map(len, samples), default=0)):
        there = [of_object[n] for of_object in samples if len(of_object) > n]
        for k in seeds.generator("round", seed, split, n).permutation(len(there)):
            yield there[k]
