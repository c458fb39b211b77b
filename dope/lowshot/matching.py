"""Local matching: how alike two views are by their dense descriptors, and the nearest shot of every query.

Paper section 4 ("low-shot recognition"): k = 20 of the query's foreground cells, farthest from each other, each take
their best match among all cells of the support view; the sum of the k similarities is the score of the support view;
the query takes the class of the best one.

Each (query view, support view) pair is scored once for a whole evaluation, and no table of pairs is kept: support views
come one at a time, and every query remembers its best shot so far. Descriptors are unit vectors times the
soft mask, so a cell cannot match better than the product of the two norms: with the support's cells sorted by norm,
the search ends as soon as the best match found exceeds that bound. The maximum over all cells is the same.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dope.common.seeds import derive_seed
from dope.lowshot.episodes import Episodes, Indices
from dope.lowshot.screening import Screen

_LEVELS = (0.3, 0.05)  # norms at which the search for a better match may end: the object, its soft border, then all
_ROUNDING = 1e-5  # a bound must be exceeded by this share, more than float32 dot products of unit vectors err
_QUERIES = 512  # query views whose descriptors are gathered at once: 10 MiB of 256 floats
_SIMILARITIES = 1 << 19  # computed at once on a CPU: 2 MiB, so that the maximum is taken within the cache


@dataclass(frozen=True)
class MatchingConfig:
    """How two views are compared."""

    points: int = 20
    """k: cells of the query that look for a match."""
    foreground: float = 0.9
    """Cells of the query whose soft mask is at least this are the object."""
    seed: int = 0
    """Seed of the farthest point sampling's first cell."""


class SupportCells(Protocol):
    """The M cells of a support view, sorted by falling norm (`dope.lowshot.encoding.ViewCells`)."""

    norms: NDArray[np.float32]

    def descriptors(self, start: int, end: int) -> Tensor:
        """Descriptors (end - start, D) of the cells from place `start` to `end`."""


def query_cells(norms: NDArray[np.float32], key: str, config: MatchingConfig) -> NDArray[np.int64]:
    """The k cells of a query view that look for matches, as indices of the flattened grid.

    Farthest point sampling of the foreground from a random first cell; where the foreground has fewer than k cells, k
    random cells of the whole grid (as the released code does).

    Args:
        norms: (h, w) norms of the cells' descriptors.
        key: the view's key; with the seed it makes the draw independent of batches and of the other views.
        config: number of points, threshold, seed.
    """
    seed = derive_seed(config.seed, "query cells", key)
    foreground = np.flatnonzero(norms >= config.foreground)
    if len(foreground) < config.points:
        rng = np.random.default_rng(seed)
        return rng.choice(norms.size, config.points, replace=norms.size < config.points).astype(np.int64)
    start = float(torch.rand(1, generator=torch.Generator().manual_seed(seed)))
    return _farthest_cells(norms >= config.foreground, foreground[int(start * len(foreground))], config.points)


def _farthest_cells(foreground: NDArray[np.bool_], first: int, n: int) -> NDArray[np.int64]:
    """`n` cells of a foreground (h, w) that has as many, from `first` on each the farthest from those before.

    Of equally far ones the first: as `dope.farthest_points`, but on a grid, where all distances from a cell are a part
    of one table.
    """
    h, w = foreground.shape
    table = _squared_distances(h, w)
    nearest = np.where(foreground, np.int32(h * h + w * w), np.int32(-1))
    chosen = np.empty(n, np.int64)
    for i in range(n):
        chosen[i] = first if i == 0 else int(nearest.argmax())
        row, column = divmod(int(chosen[i]), w)
        from_cell = table[h - 1 - row : 2 * h - 1 - row, w - 1 - column : 2 * w - 1 - column]
        np.minimum(nearest, from_cell, out=nearest)
    return chosen


@functools.cache
def _squared_distances(h: int, w: int) -> NDArray[np.int32]:
    """(2h - 1, 2w - 1): squared distance of an offset, with no offset in the middle."""
    rows, columns = np.arange(1 - h, h, dtype=np.int32), np.arange(1 - w, w, dtype=np.int32)
    return rows[:, None] ** 2 + columns**2


def best_similarities(
    queries: Tensor, query_norms: Tensor, support: SupportCells, screening: tuple[Screen, Tensor] | None = None
) -> Tensor:
    """The greatest dot product (R,) of each query descriptor (R, D) with any cell of the support view.

    `screening`: a subspace and the queries' coordinates in it, which make the search faster.
    """
    best = queries.new_full((len(queries),), -torch.inf)
    rows: Tensor | None = None  # None: all
    start = 0
    ends = [int(np.searchsorted(-support.norms, -level, side="right")) for level in _LEVELS]
    for end in (*ends, len(support.norms)):
        if end == start:
            continue
        cells = support.descriptors(start, end)
        if rows is None and screening is not None:
            best = screening[0].row_maxima(queries, query_norms, screening[1], cells)
        elif rows is None:
            best = _row_maxima(queries, cells)
        else:
            best[rows] = torch.maximum(best[rows], _row_maxima(queries[rows], cells))
        if end == len(support.norms):
            break
        bound = query_norms * (float(support.norms[end]) * (1 + _ROUNDING))
        rows = torch.nonzero(best < bound)[:, 0]
        if not len(rows):
            break
        start = end
    return best


def _row_maxima(queries: Tensor, cells: Tensor) -> Tensor:
    """max over M of queries (R, D) @ cells (M, D)^T."""
    if queries.device.type != "cpu":
        return (queries @ cells.T).amax(1)
    # NumPy's matrix products are the faster ones on CPUs for which PyTorch's library was not made
    rows, columns = queries.numpy(), cells.numpy().T
    step = max(1, _SIMILARITIES // len(cells))
    buffer = np.empty((min(step, len(rows)), len(cells)), np.float32)
    best = np.empty(len(rows), np.float32)
    for start in range(0, len(rows), step):
        part = rows[start : start + step]
        similarities = np.matmul(part, columns, out=buffer[: len(part)])
        np.max(similarities, axis=1, out=best[start : start + step])
    return torch.from_numpy(best)


class QueryDescriptors:
    """The k chosen cells of Q query views, ready to be compared with support views.

    Args:
        descriptors: (Q, k, D), on the support views' device or on the CPU.
        norms: (Q, k), on the CPU or there as well.
    """

    def __init__(self, descriptors: Tensor, norms: Tensor) -> None:
        self.descriptors, self.norms = descriptors, norms
        # of views spread over all, so that nothing depends on their number but the subspace
        some = descriptors[:: max(1, len(descriptors) // 512)].flatten(0, 1)
        self._screen = Screen.of(some)
        self._coordinates: Tensor | None = None
        if self._screen is not None:
            coordinates = [self._screen.coordinates(part.flatten(0, 1)) for part in descriptors.split(_QUERIES)]
            self._coordinates = torch.cat(coordinates).view(*descriptors.shape[:2], -1)

    @torch.inference_mode()
    def scores(self, support: SupportCells, rows: NDArray[np.integer] | None = None) -> NDArray[np.float32]:
        """Scores (R,) of the query views `rows` (R,) against one support view; None: of all."""
        chosen = np.arange(len(self.descriptors)) if rows is None else rows
        scores = np.empty(len(chosen), np.float32)
        device = support.descriptors(0, 1).device
        for start in range(0, len(chosen), _QUERIES):
            part = torch.from_numpy(chosen[start : start + _QUERIES]).to(self.descriptors.device)
            descriptors = self.descriptors[part].to(device).flatten(0, 1)
            norms = self.norms[part.to(self.norms.device)].to(device).flatten()
            screening = None
            if self._screen is not None and self._coordinates is not None and device.type == "cpu":
                screening = self._screen, self._coordinates[part].flatten(0, 1)
            best = best_similarities(descriptors, norms, support, screening)
            scores[start : start + _QUERIES] = best.view(len(part), -1).sum(1).cpu().numpy()
        return scores


class BestShots:
    """The best support view of every query of some episodes, among those that were scored so far.

    Its size is that of the episodes: as many numbers as they have queries and shots.

    Args:
        episodes: of any number of protocols over the same views.
    """

    def __init__(self, episodes: Sequence[Episodes]) -> None:
        self._episodes = episodes
        self._queries = [drawn.query.reshape(len(drawn), -1) for drawn in episodes]  # (E, ways * queries)
        self._scores = [np.full(queries.shape, -np.inf, np.float32) for queries in self._queries]
        self._places = [np.full(queries.shape, np.iinfo(np.int32).max, np.int32) for queries in self._queries]
        # where each support view occurs: protocol, episode and place among the shots, sorted by view
        views = np.concatenate([drawn.support.ravel() for drawn in episodes])
        order = np.argsort(views, kind="stable")
        sizes = [drawn.support[0].size for drawn in episodes]
        slots = [
            (np.full(len(drawn) * n, t), np.repeat(np.arange(len(drawn)), n), np.tile(np.arange(n), len(drawn)))
            for t, (drawn, n) in enumerate(zip(episodes, sizes, strict=True))
        ]
        self._protocol, self._episode, self._place = (
            np.concatenate(column).astype(np.int32)[order] for column in zip(*slots, strict=True)
        )
        self.support_views, starts = np.unique(views[order], return_index=True)
        self._ends = np.append(starts, len(order))

    def queries_of(self, support_view: int) -> Indices:
        """The query views, sorted, that are to be scored against a support view."""
        needed = [self._queries[t][episodes].ravel() for t, episodes, _ in self._slots(support_view)]
        return np.unique(np.concatenate(needed))

    def add(self, support_view: int, queries: Indices, scores: NDArray[np.float32]) -> None:
        """Take in the scores (Q,) of `queries_of` a support view; of equal scores the first shot of an episode wins."""
        for t, episodes, places in self._slots(support_view):
            new = scores[np.searchsorted(queries, self._queries[t][episodes])]
            place = places[:, None]
            old, old_place = self._scores[t][episodes], self._places[t][episodes]
            better = (new > old) | ((new == old) & (place < old_place))
            self._scores[t][episodes] = np.where(better, new, old)
            self._places[t][episodes] = np.where(better, place, old_place)

    def predictions(self) -> list[Indices]:
        """The way (E, ways, queries) of every query's best shot, for each protocol; 1-NN over all shots."""
        return [
            (places // drawn.config.shots).astype(np.int64).reshape(drawn.query.shape)
            for drawn, places in zip(self._episodes, self._places, strict=True)
        ]

    def _slots(self, support_view: int) -> list[tuple[int, Indices, Indices]]:
        """(protocol, episodes, places) in which a view is a shot; an episode holds it once."""
        i = int(np.searchsorted(self.support_views, support_view))
        part = slice(int(self._ends[i]), int(self._ends[i + 1]))
        protocols, episodes, places = self._protocol[part], self._episode[part], self._place[part]
        return [(int(t), episodes[protocols == t], places[protocols == t]) for t in np.unique(protocols)]
