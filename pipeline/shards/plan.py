"""Which sample goes into which tar: splits, rounds and even shards, as operations on whole columns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dope.common import seeds
from pipeline.shards.catalogue import Catalogue
from pipeline.shards.holdout import held_out_arc, held_out_objects
from pipeline.shards.writer import Kind, PairSample, SequenceContents, ViewSample


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


@dataclass(frozen=True)
class TarPlan:
    """The samples of one tar, in order.

    Attributes:
        name: of the file.
        kind: what it holds.
        sequence: (N,) place of each sample's sequence in the catalogue.
        row: (N,) its row among that sequence's pairs or views.
        held: (N,) True = validation.
    """

    name: str
    kind: Kind
    sequence: NDArray[np.integer]
    row: NDArray[np.integer]
    held: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.sequence)

    def samples(self, contents: Callable[[int], SequenceContents]) -> Iterator[PairSample | ViewSample]:
        """The samples, given what reads a sequence by its place in the catalogue."""
        for k, row, held in zip(self.sequence.tolist(), self.row.tolist(), self.held.tolist(), strict=True):
            split = "val" if held else "train"
            of = contents(k)
            yield PairSample(of, row, split) if self.kind == "pairs" else ViewSample(of, int(of.frames[row]), split)


Plan = list[TarPlan]
"""Every tar of the dataset, the same in every container."""


def plan_tars(catalogue: Catalogue, config: ShardsConfig) -> tuple[Plan, dict[str, Any]]:
    """Every tar (pairs of each split in rounds, views in order), and the counts."""
    held, details = _held_views(catalogue, config)
    sequence = np.repeat(np.arange(len(catalogue), dtype=np.int32), np.diff(catalogue.pair_starts))
    side1, side2 = held[_view_of_pairs(catalogue)].T
    shuffled = _shuffled_pairs(catalogue, config.seed)
    places: dict[str, NDArray[np.int64]] = {}
    for split, wanted in (("train", ~(side1 | side2)), ("val", side1 & side2)):
        chosen = shuffled[wanted[shuffled]]  # still sequence by sequence
        counts = np.bincount(sequence[chosen], minlength=len(catalogue))
        places[split] = chosen[rounds(counts, config.seed, split)]
    details = {
        "sequences": len(catalogue),
        "pairs": {split: len(chosen) for split, chosen in places.items()},
        "views": {"train": int((~held).sum()), "val": int(held.sum())},
        "mixed_pairs_not_written": int((side1 != side2).sum()),
        **details,
    }
    rows = np.arange(len(sequence)) - catalogue.pair_starts[sequence]
    plan: Plan = []
    for split, chosen in places.items():
        for name, part in even_parts(split, len(chosen), config.samples_per_shard):
            of = chosen[part]
            plan.append(TarPlan(name, "pairs", sequence[of], rows[of], np.full(len(of), split == "val")))
    owner = np.repeat(np.arange(len(catalogue), dtype=np.int32), np.diff(catalogue.view_starts))
    view_rows = np.arange(len(owner)) - catalogue.view_starts[owner]
    for name, part in even_parts("views", len(owner), config.samples_per_shard):
        plan.append(TarPlan(name, "views", owner[part], view_rows[part], held[part]))
    return plan, details


def rounds(counts: NDArray[np.integer], seed: int, split: str) -> NDArray[np.int64]:
    """Every object's first sample, then every object's second ...; within a round the objects are shuffled.

    Args:
        counts: (n,) samples of each object; they lie one object after the other.

    Returns:
        (sum of counts,) the samples' places in the order in which they are written.
    """
    starts = np.cumsum(counts) - counts
    order = [np.zeros(0, np.int64)]
    for n in range(int(counts.max(initial=0))):
        there = np.flatnonzero(counts > n)
        shuffled = there[seeds.generator("round", seed, split, n).permutation(len(there))]
        order.append(starts[shuffled] + n)
    return np.concatenate(order)


def _held_views(catalogue: Catalogue, config: ShardsConfig) -> tuple[NDArray[np.bool_], dict[str, Any]]:
    """Which views are held out, and what is to be said of that."""
    held = np.zeros(len(catalogue.frames), dtype=bool)
    ids = [sequence.id for sequence in catalogue.sequences]
    without: list[str] = []
    details: dict[str, Any] = {"without_val_pairs": without}
    if config.holdout == "sequences":
        objects = dict(zip(ids, zip(catalogue.categories, catalogue.instances, strict=True), strict=True))
        val_ids = held_out_objects(objects, config.val_fraction, config.seed)
        for k, id in enumerate(ids):
            held[catalogue.views_of(k)] = id in val_ids
        details["val_sequences"] = sorted(val_ids)
    elif config.holdout == "frames":
        for k, id in enumerate(ids):
            views = catalogue.views_of(k)
            pairs = catalogue.pairs[catalogue.pairs_of(k)]
            held[views] = held_out_arc(catalogue.frames[views], pairs, config.val_fraction, config.seed, id)
            if not held[views].any():
                without.append(id)
    return held, details


def _view_of_pairs(catalogue: Catalogue) -> NDArray[np.int64]:
    """(P, 2) the place in `frames` of the view on either side of every pair."""
    # frames ascend within a sequence: with the sequence's place in front, all of them do
    span = int(catalogue.frames.max(initial=0)) + 1
    n = np.arange(len(catalogue), dtype=np.int64)
    views = np.repeat(n, np.diff(catalogue.view_starts)) * span + catalogue.frames
    pairs = (np.repeat(n, np.diff(catalogue.pair_starts)) * span)[:, None] + catalogue.pairs
    return np.searchsorted(views, pairs)


def _shuffled_pairs(catalogue: Catalogue, seed: int) -> NDArray[np.int64]:
    """The places of all pairs, sequence by sequence, each sequence's own shuffled."""
    order = np.arange(len(catalogue.pairs))
    for k, sequence in enumerate(catalogue.sequences):
        of = order[catalogue.pairs_of(k)]
        of[:] = of[seeds.generator("pairs of", seed, sequence.id).permutation(len(of))]
    return order


def even_parts(kind: str, n: int, most: int) -> Iterator[tuple[str, slice]]:
    """Names and parts of the tars that n samples are spread over."""
    n_shards = -(-n // most)
    for k in range(n_shards):
        yield f"{kind}-{k:06d}.tar", slice(n * k // n_shards, n * (k + 1) // n_shards)
