"""The order of training samples: a function of (seed, epoch) alone, fixed before it is split over ranks and workers.

An epoch is made of rounds; a round holds each object once, with one pair of its own. The place in the run is (epoch,
samples consumed): going on from there gives the samples not yet seen, once each, with any number of workers or ranks.

shuffled: the objects of a round are shuffled, and each object's pairs are drawn without replacement until all were
used, then anew. sequential, for slow storage: a round takes one round of the shards (every object's k-th pair lies
together there), cut into blocks of neighbours; the blocks are shuffled, and a batch is made of a few of them.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import UsageError
from dope.common.seeds import derive_seed, generator

logger = logging.getLogger(__name__)

Order = Literal["shuffled", "sequential"]
BLOCKS_MIXED = 4
"""Blocks of neighbours whose samples are shuffled together (sequential order); a batch that holds more mixes more."""


@dataclass(frozen=True)
class Place:
    """Where in the run we are: `consumed` samples (of all ranks) of `epoch` have been trained on."""

    epoch: int = 0
    consumed: int = 0


class EpochOrder(ABC):
    """Epochs of equal steps, which ranks share and which a run may go on in at any of them.

    Attributes:
        batch_size: samples (or episodes) in a step over all ranks.
        steps_per_epoch: whole steps; what is left over is dropped.
        unit: what `batch_size` counts, for errors.
    """

    batch_size: int
    steps_per_epoch: int
    unit: ClassVar[str] = "samples"

    @abstractmethod
    def epoch(self, epoch: int) -> NDArray[np.int64]:
        """(steps_per_epoch, batch_size, ...) sample rows."""

    def batches(self, start: Place, epochs: int, *, rank: int = 0, world: int = 1) -> Iterator[list[int]]:
        """The rows of `rank`'s contiguous share of each step, from `start` to the end of `epochs`.

        Raises:
            UsageError: the batch cannot be divided by `world`.
        """
        if self.batch_size % world:
            raise UsageError(
                f"{self.batch_size} {self.unit} a step cannot be divided among {world} ranks",
                where="data.batch_size",
                remedy=f"Use --set data.batch_size={max(1, self.batch_size // world) * world}",
            )
        share = self.batch_size // world
        return self._shares(start, epochs, slice(rank * share, (rank + 1) * share))

    def after(self, place: Place) -> Place:
        """The place one step later; `consumed` counts what `batch_size` does."""
        consumed = place.consumed + self.batch_size
        if consumed >= self.steps_per_epoch * self.batch_size:
            return Place(place.epoch + 1, 0)
        return Place(place.epoch, consumed)

    def _shares(self, start: Place, epochs: int, mine: slice) -> Iterator[list[int]]:
        for epoch in range(start.epoch, epochs):
            first = start.consumed // self.batch_size if epoch == start.epoch else 0
            for batch in self.epoch(epoch)[first:]:
                yield batch[mine].ravel().tolist()


class SampleOrder(EpochOrder):
    """Cuts epochs into batches of sample rows.

    Args:
        objects: (N,) the object number of each sample row, in the order in which the rows lie in the shards.
        batch_size: samples in a batch over all ranks.
        pairs_per_object: rounds in an epoch.
        seed: the run's seed.
        order: shuffled or sequential.
        block: neighbouring samples that stay together in sequential order.

    Raises:
        UsageError: an epoch is smaller than one batch.
    """

    def __init__(
        self,
        objects: NDArray[np.integer],
        batch_size: int,
        *,
        pairs_per_object: int = 1,
        seed: int = 12345,
        order: Order = "shuffled",
        block: int = 32,
    ) -> None:
        self.batch_size, self.rounds, self.seed = batch_size, pairs_per_object, seed
        self.sequential, self.block = order == "sequential", block
        self._by_object = np.argsort(objects, kind="stable")
        self._numbers, self._first, self._counts = np.unique(
            np.asarray(objects)[self._by_object], return_index=True, return_counts=True
        )
        self.n_objects = len(self._numbers)
        self.steps_per_epoch = self.n_objects * pairs_per_object // batch_size
        if self.steps_per_epoch == 0:
            enough = -(-batch_size // max(1, self.n_objects))
            raise UsageError(
                f"{self.n_objects} objects x {pairs_per_object} pairs are less than one batch of {batch_size}",
                where="data.batch_size",
                remedy=f"Use --set data.batch_size={max(2, self.n_objects * pairs_per_object)} or less, "
                f"or --set data.pairs_per_object={enough} or more",
            )
        if self.n_objects < batch_size:
            logger.warning(
                "%d objects fill a batch of %d only with several pairs of one object, never contrasted with each other",
                self.n_objects,
                batch_size,
            )

    def epoch(self, epoch: int) -> NDArray[np.int64]:
        """(steps_per_epoch, batch_size) sample rows; no object twice in a row where there are enough objects."""
        rows: list[NDArray[np.int64]] = []
        rest = np.empty(0, np.int64)  # objects of the batch that the last round left incomplete
        for step in range(self.rounds):
            number = epoch * self.rounds + step
            random = generator(self.seed, "round", number)
            missing = -len(rest) % self.batch_size
            shown = self._rows_in_turn(number) if self.sequential else self._pair_of_round(number)
            order = self._in_blocks(shown, random) if self.sequential else random.permutation(self.n_objects)
            if len(rest) and self.n_objects >= self.batch_size:
                order = _without_first(order, rest, missing)
            if self.sequential:
                order = self._mixed_blocks(order, missing, random)
            rows.append(shown[order])
            pending = np.concatenate([rest, order])
            rest = pending[len(pending) - len(pending) % self.batch_size :]
        whole = self.steps_per_epoch * self.batch_size
        batches = np.concatenate(rows)[:whole].reshape(self.steps_per_epoch, self.batch_size)
        # which sample of a batch is which says nothing; side by side, a rank's share is neighbours as well
        return np.sort(batches, axis=1) if self.sequential else batches

    def _pair_of_round(self, number: int) -> NDArray[np.int64]:
        """(n_objects,) the sample row that each object shows in round `number`."""
        cycle, position = np.divmod(number, self._counts)
        # rank the pairs of each object by a key that changes with the object's cycle
        keys = _mixed(np.arange(len(self._by_object)), np.repeat(cycle, self._counts), derive_seed(self.seed, "pairs"))
        ranked = np.lexsort((keys, np.repeat(np.arange(self.n_objects), self._counts)))
        return self._by_object[ranked[self._first + position]]

    def _rows_in_turn(self, number: int) -> NDArray[np.int64]:
        """(n_objects,) the same, but the k-th pair of every object, with a k drawn without replacement.

        Objects with fewer pairs show them again, beginning with another one each time that all k were drawn.
        """
        most = int(self._counts.max())
        cycle, position = divmod(number, most)
        k = int(generator(self.seed, "turns", cycle).permutation(most)[position])
        return self._by_object[self._first + np.where(k < self._counts, k, (k + cycle) % self._counts)]

    def _in_blocks(self, shown: NDArray[np.int64], random: np.random.Generator) -> NDArray[np.int64]:
        """The objects as their rows lie in the shards, cut into blocks (elsewhere in each round), these shuffled."""
        cuts = np.arange(int(random.integers(1, self.block + 1)), self.n_objects, self.block)
        blocks = np.split(np.argsort(shown), cuts)
        return np.concatenate([blocks[i] for i in random.permutation(len(blocks))])

    def _mixed_blocks(self, order: NDArray[np.int64], missing: int, random: np.random.Generator) -> NDArray[np.int64]:
        """Shuffle within windows of whole batches that hold at least `BLOCKS_MIXED` blocks, after the first `missing`
        samples, which complete the batch of the round before."""
        window = -(-BLOCKS_MIXED * self.block // self.batch_size) * self.batch_size
        starts = range(missing, len(order), window)
        mixed = [random.permutation(order[start : start + window]) for start in starts]
        return np.concatenate([order[:missing], *mixed])


def _without_first(order: NDArray[np.int64], taken: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Move the objects of `taken` out of the first `n` places of a permutation, keeping the order otherwise."""
    free = np.flatnonzero(~np.isin(order, taken))[:n]
    return np.concatenate([order[free], np.delete(order, free)])


def _mixed(row: NDArray[np.int64], cycle: NDArray[np.int64], seed: int) -> NDArray[np.uint64]:
    """A pseudo-random key for each (row, cycle): SplitMix64 (Steele et al. 2014), run twice."""
    state = np.full(row.shape, seed, np.uint64)
    for part in (row, cycle):
        state = (state ^ part.astype(np.uint64)) + np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    return state
