"""Batches of single views with positives of their classes: queries, and behind them the views that are their keys."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dope.common.seeds import generator
from dope.order import Place, SampleOrder


class ClassKeys:
    """For any view, other views of its class.

    Args:
        labels: (N,) the class of each view.
        objects: (N,) the object of each view.
    """

    def __init__(self, labels: NDArray[np.integer], objects: NDArray[np.integer]) -> None:
        labels, objects = np.asarray(labels), np.asarray(objects)
        self._rows = np.lexsort((objects, labels))  # class by class, and object by object within
        label, item = labels[self._rows], objects[self._rows]
        new_class = np.flatnonzero(np.r_[True, label[1:] != label[:-1]])
        new_block = np.flatnonzero(np.r_[True, (label[1:] != label[:-1]) | (item[1:] != item[:-1])])
        place = np.empty(len(labels), np.int64)
        place[self._rows] = np.arange(len(labels))
        # for each view, by its row: its class and its block (the views of its object), and its place within the block
        self._class = np.searchsorted(new_class, place, side="right") - 1
        self._block = np.searchsorted(new_block, place, side="right") - 1
        self._block_start, self._block_size = new_block, np.diff(np.r_[new_block, len(labels)])
        self._within = place - new_block[self._block]
        self._class_start, self._class_size = new_class, np.diff(np.r_[new_class, len(labels)])
        self._first_block = np.searchsorted(new_block, new_class)
        self._blocks = np.diff(np.r_[self._first_block, len(new_block)])

    def draw(self, rows: NDArray[np.integer], keys: int, random: np.random.Generator) -> NDArray[np.int64]:
        """Rows (B, keys) of views of the same classes as the views of `rows` (B,).

        The first is of another object, each being equally likely, the others are any of the class, with replacement. An
        object alone in its class has another view of itself first; a view that is all there is of its class, itself.
        """
        u = random.random((len(rows), keys + 1))
        of_class, block = self._class[rows], self._block[rows]
        others = self._blocks[of_class] - 1
        drawn = self._first_block[of_class] + _integer(u[:, 0], np.maximum(others, 1))
        drawn += drawn >= block  # the own object is passed over
        other = np.where(others > 0, drawn, block)
        of_other = self._block_start[other] + _integer(u[:, 1], self._block_size[other])
        size, within = self._block_size[block], self._within[rows]
        view = _integer(u[:, 1], np.maximum(size - 1, 1))
        view += (view >= within) & (size > 1)  # the view itself is passed over
        of_itself = self._block_start[block] + view
        first = np.where(others > 0, of_other, of_itself)
        rest = self._class_start[of_class][:, None] + _integer(u[:, 2:], self._class_size[of_class][:, None])
        return self._rows[np.concatenate([first[:, None], rest], 1)]


class KeyedOrder:
    """A `SampleOrder` of queries; a rank's share of a step is its b queries and then, query by query, their keys' rows.

    Keys are a function of (seed, epoch, step of the epoch): the same with any number of ranks, and after a stop.

    Args:
        queries: which views are queries when.
        choice: draws keys.
        keys: how many a query (P).
        seed: the run's seed.
    """

    def __init__(self, queries: SampleOrder, choice: ClassKeys, keys: int, seed: int) -> None:
        self._queries, self._choice, self._keys, self._seed = queries, choice, keys, seed
        self.steps_per_epoch, self.n_objects = queries.steps_per_epoch, queries.n_objects
        self.batch_size = queries.batch_size

    def batches(self, start: Place, epochs: int, *, rank: int = 0, world: int = 1) -> Iterator[list[int]]:
        """b + b * P rows: b = batch_size / world queries, then the P keys of the first, of the second, and so on.

        Raises:
            UsageError: the batch cannot be divided by `world`.
        """
        self._queries.batches(start, epochs, rank=rank, world=world)  # refuses what cannot be divided
        share = self.batch_size // world
        return self._shares(start, epochs, slice(rank * share, (rank + 1) * share))

    def after(self, place: Place) -> Place:
        """The place one step later."""
        return self._queries.after(place)

    def _shares(self, place: Place, epochs: int, mine: slice) -> Iterator[list[int]]:
        for batch in self._queries.batches(place, epochs):
            step = place.consumed // self.batch_size
            rows = np.array(batch, np.int64)
            keys = self._choice.draw(rows, self._keys, generator(self._seed, "class keys", place.epoch, step))
            yield [*batch[mine], *keys[mine].ravel().tolist()]
            place = self.after(place)


def _integer(u: NDArray[np.float64], below: NDArray[np.integer]) -> NDArray[np.int64]:
    """Numbers in [0, 1) as whole numbers in [0, below)."""
    return np.minimum((u * below).astype(np.int64), below - 1)
