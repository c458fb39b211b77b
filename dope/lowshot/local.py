"""Classification by local matching (the paper's): 1-NN over all shots by dense descriptors.

All episodes of all protocols are classified at once, so that a view is encoded once and a pair of views scored once.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dope.lowshot.cell_store import GIB, CellStore, SpillFile
from dope.lowshot.embedding import Embedder
from dope.lowshot.encoding import ViewCells
from dope.lowshot.episodes import Episodes, Indices
from dope.lowshot.matching import BestShots, QueryDescriptors, query_cells
from dope.lowshot.work import Work

_TRIED = 32  # views written to the disk between judgements whether that is still the thing to do
_LEAVE_FREE = GIB  # bytes of the disk that are left to others


def classify_locally(embedder: Embedder, episodes: Sequence[Episodes], work: Work) -> list[Indices]:
    """The predicted way (E, ways, queries) of each protocol's queries by local matching.

    Every view is encoded once. The cells of support views wait in memory, up to `work.memory_gib`, then on the disk,
    until all query views are encoded; each support view is then scored against the queries that need it.

    Raises:
        UsageError: the embedder has no dense features, or the folder for the disk cache cannot be used.
        DiskFull: no space left for what memory has no room for.
        DopeError: features are not finite.
    """
    best = BestShots(episodes)
    query_views = np.unique(np.concatenate([drawn.query.ravel() for drawn in episodes]))
    needed = np.union1d(query_views, best.support_views)
    is_query, is_support = np.isin(needed, query_views), np.isin(needed, best.support_views)
    spill = SpillFile(work.cache)
    try:
        queries = _QueryCells(work, query_views, spill)
        store = CellStore(None if work.spill == "never" else spill)
        again: list[int] = []
        judged = 0
        started = time.perf_counter()
        with work.encoding():
            for i, (view, cells) in enumerate(work.cells(embedder, needed)):
                if is_query[i]:
                    queries.add(view, cells)
                if is_support[i] and not store.put(view, cells, queries.room_left):
                    again.append(view)
                if work.spill == "auto" and store.spilled == judged + _TRIED:
                    judged = store.spilled
                    encoding = (time.perf_counter() - started - store.spill_seconds) / (i + 1)
                    if reason := _why_not_spill(store.spill_seconds / judged, encoding, spill.free):
                        store.stop_spilling()
                        work.notes.append(f"{reason}: views that --memory has no room for were encoded twice")
        done, total = 0, len(best.support_views)
        with work.matching_time():
            for view, cells in store.take_all():
                queries.score(view, cells, best)
                work.tell("match", done := done + 1, total)
            for view, cells in work.cells(embedder, np.array(again, np.int64), "encode again"):
                queries.score(view, cells, best)
                work.tell("match", done := done + 1, total)
    finally:
        spill.close()
    queries.say_fallbacks()
    return best.predictions()


def _why_not_spill(spill_seconds: float, encode_seconds: float, free: int) -> str:
    """Why views should no longer wait on the disk, or nothing.

    Args:
        spill_seconds: wall time of writing a view to the disk.
        encode_seconds: of encoding it again.
        free: bytes that the disk has left.
    """
    if free < _LEAVE_FREE:
        return "the disk of --cache is nearly full"
    if 2 * spill_seconds > encode_seconds:  # written once and read once
        return "the disk of --cache is slower than the network"
    return ""


class _QueryCells:
    """The k chosen cells of every query view: descriptors (Q, k, D) and norms (Q, k); on the disk where they take more
    than half of the memory."""

    def __init__(self, work: Work, views: Indices, spill: SpillFile) -> None:
        self._work, self._views, self._spill = work, views, spill
        self._keys = work.views.columns["key"]
        self._norms = torch.empty(len(views), work.matching.points)
        self._descriptors: Tensor | None = None  # allocated with the first view, which tells D
        self._ready: QueryDescriptors | None = None  # once all are added
        self._fallbacks = 0
        self.room_left = work.memory_gib * GIB

    def add(self, view: int, cells: ViewCells) -> None:
        norm_map, config = cells.norm_map, self._work.matching
        self._fallbacks += int(np.count_nonzero(norm_map >= config.foreground) < config.points)
        chosen = query_cells(norm_map, self._keys[view], config)
        if self._descriptors is None:
            self._descriptors = self._allocate(cells.dim)
        row = int(np.searchsorted(self._views, view))
        descriptors = cells.at(chosen)
        if not descriptors.isfinite().all():  # of cells that were projected only now
            raise self._work.not_finite(view)
        self._descriptors[row] = descriptors.to(self._descriptors.device)
        self._norms[row] = torch.from_numpy(norm_map.ravel()[chosen])

    def score(self, view: int, cells: ViewCells, best: BestShots) -> None:
        """Score a support view against the query views that need it."""
        if self._ready is None:
            assert self._descriptors is not None, "queries are added before anything is scored"
            self._ready = QueryDescriptors(self._descriptors, self._norms)
        needing = best.queries_of(view)
        scores = self._ready.scores(cells, np.searchsorted(self._views, needing))
        if not np.isfinite(scores).all():  # of cells that were projected only now
            raise self._work.not_finite(view)
        best.add(view, needing, scores)

    def say_fallbacks(self) -> None:
        """Note how many queries were compared by random cells."""
        if self._fallbacks:
            points, of = self._work.matching.points, f"{self._fallbacks:,} of {len(self._views):,}"
            self._work.notes.append(
                f"{self._work.source}: {of} query views have fewer than {points} cells of foreground: "
                "random cells of the whole view were compared instead"
            )

    def _allocate(self, dim: int) -> Tensor:
        shape = (*self._norms.shape, dim)
        size = 4 * self._norms.numel() * dim
        if 2 * size <= self.room_left:
            self.room_left -= size
            return torch.empty(shape, device=self._work.device)
        return torch.from_numpy(self._spill.reserve(shape))
