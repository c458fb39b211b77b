"""Local matching: how alike two views are by their dense descriptors, and the nearest shot of every query.

Paper section 4 ("low-shot recognition"): k = 20 of the query's foreground cells, farthest from each other, each take
their best match among all cells of the support view; the sum of the k similarities is the score of the support view;
the query takes the class of the best one.

Each (query view, support view) pair is scored once for a whole evaluation. Descriptors are unit vectors times the
soft mask, so a cell cannot match better than the product of the two norms: with the support's cells sorted by norm,
the search ends as soon as the best match found exceeds that bound. The maximum over all cells is the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dope.common.seeds import derive_seed
from dope.farthest_points import farthest_points
from dope.lowshot.episodes import Episodes, Indices

_LEVELS = (0.3, 0.05)  # norms at which the search for a better match may end: the object, its soft border, then all
_ROUNDING = 1e-5  # a bound must be exceeded by this share, more than float32 dot products of unit vectors err
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
    cells = torch.from_numpy(np.stack(np.unravel_index(foreground, norms.shape), axis=1)).float()
    valid = torch.ones(1, len(cells), dtype=torch.bool)
    start = torch.rand(1, generator=torch.Generator().manual_seed(seed))
    chosen, _ = farthest_points(cells[None], valid, config.points, start)
    return foreground[chosen[0].numpy()]


def best_similarities(queries: Tensor, query_norms: Tensor, support: SupportCells) -> Tensor:
    """The greatest dot product (R,) of each query descriptor (R, D) with any cell of the support view."""
    best = queries.new_full((len(queries),), -torch.inf)
    rows: Tensor | None = None  # None: all
    start = 0
    ends = [int(np.searchsorted(-support.norms, -level, side="right")) for level in _LEVELS]
    for end in (*ends, len(support.norms)):
        if end == start:
            continue
        cells = support.descriptors(start, end).T
        if rows is None:
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
    """max over M of queries (R, D) @ cells (D, M)."""
    step = max(1, _SIMILARITIES // cells.shape[1]) if queries.device.type == "cpu" else len(queries)
    if len(queries) <= step:
        return (queries @ cells).amax(1)
    best = queries.new_empty(len(queries))
    buffer = queries.new_empty(step, cells.shape[1])
    for start in range(0, len(queries), step):
        part = queries[start : start + step]
        torch.amax(torch.mm(part, cells, out=buffer[: len(part)]), 1, out=best[start : start + step])
    return best


class PairScores:
    """The scores of all (query view, support view) pairs that some episodes need, each computed once."""

    def __init__(self, episodes: Iterable[Episodes], n_views: int) -> None:
        self._n_views = n_views
        needed = [np.unique(_pair_codes(part, n_views)) for batch in episodes for part in _parts(batch)]
        self._codes = np.unique(np.concatenate(needed))  # sorted by support view, then query view
        self._scores = np.full(len(self._codes), np.nan, np.float32)

    def __len__(self) -> int:
        return len(self._codes)

    @property
    def support_views(self) -> Indices:
        return np.unique(self._codes // self._n_views)

    def queries_of(self, support_view: int) -> Indices:
        """The query views that are to be scored against a support view, sorted."""
        return self._codes[self._range(support_view)] % self._n_views

    def set(self, support_view: int, scores: NDArray[np.float32]) -> None:
        """Scores in the order of `queries_of`."""
        self._scores[self._range(support_view)] = scores

    def of(self, episodes: Episodes) -> NDArray[np.float32]:
        """Scores (E, ways * queries, ways * shots)."""
        codes = _pair_codes(episodes, self._n_views)
        return self._scores[np.searchsorted(self._codes, codes)]

    def _range(self, support_view: int) -> slice:
        low, high = np.searchsorted(self._codes, [support_view * self._n_views, (support_view + 1) * self._n_views])
        return slice(int(low), int(high))


def score_support(queries: Tensor, query_norms: Tensor, support: SupportCells) -> NDArray[np.float32]:
    """Scores (Q,) of Q query views against one support view.

    Args:
        queries: (Q, k, D) descriptors of the query views' cells.
        query_norms: (Q, k).
        support: the support view.
    """
    n, k, dim = queries.shape
    best = best_similarities(queries.reshape(n * k, dim), query_norms.reshape(n * k), support)
    return best.view(n, k).sum(1).cpu().numpy()


def nearest_shot(episodes: Episodes, scores: PairScores) -> NDArray[np.int64]:
    """The way (E, ways, queries) of the best support view of each query; of equal ones, the first."""
    predicted = np.empty(episodes.query.shape, np.int64)
    start = 0
    for part in _parts(episodes):
        best = scores.of(part).argmax(2) // part.config.shots
        predicted[start : start + len(part)] = best.reshape(part.query.shape)
        start += len(part)
    return predicted


def _pair_codes(episodes: Episodes, n_views: int) -> Indices:
    """support view * n_views + query view: (E, ways * queries, ways * shots)."""
    e = len(episodes)
    return episodes.support.reshape(e, 1, -1) * n_views + episodes.query.reshape(e, -1, 1)


def _parts(episodes: Episodes, n: int = 256) -> Iterator[Episodes]:
    """The episodes in chunks, so that tables of pairs stay small."""
    for start in range(0, len(episodes), n):
        part = slice(start, start + n)
        yield Episodes(
            episodes.support[part], episodes.query[part], episodes.classes[part], episodes.names, episodes.config
        )
