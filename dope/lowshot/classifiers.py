"""The two classifiers: local matching (the paper's) and the nearest mean of pooled descriptors.

Both see all episodes of all protocols at once, so that a view is encoded once and a pair of views scored once.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dope.common.progress import Progress
from dope.lowshot.encoding import ViewCells, encode_views, to_tensor
from dope.lowshot.episodes import Episodes, Indices
from dope.lowshot.matching import MatchingConfig, PairScores, nearest_shot, query_cells, score_support
from dope.lowshot.views import ViewShards
from dope.networks import DopeNetwork


@dataclass
class Work:
    """What the classifiers work with, and the wall time they took."""

    views: ViewShards
    matching: MatchingConfig
    device: torch.device
    batch: int
    memory_gb: float
    image_size: int | None = None
    progress: Progress | None = None
    encode_seconds: float = 0.0
    match_seconds: float = 0.0
    encoded: int = 0

    def encode(
        self, network: DopeNetwork, views: Indices, progress: Progress | None = None
    ) -> Iterator[tuple[int, ViewCells]]:
        return encode_views(
            network,
            self.views,
            views,
            device=self.device,
            batch=self.batch,
            image_size=self.image_size,
            progress=progress,
        )

    def tell(self, what: str, done: int, total: int) -> None:
        if self.progress is not None:
            self.progress(what, done, total)


def classify_locally(network: DopeNetwork, episodes: Sequence[Episodes], work: Work) -> list[Indices]:
    """The predicted way (E, ways, queries) of each protocol's queries by local matching, 1-NN over all shots."""
    pairs = PairScores(episodes, len(work.views))
    query_views = np.unique(np.concatenate([drawn.query.ravel() for drawn in episodes]))
    support_views = pairs.support_views
    needed = np.union1d(query_views, support_views)
    queries = _QueryCells(work, query_views)
    kept: dict[int, ViewCells] = {}
    room = work.memory_gb * 1e9
    is_query, is_support = np.isin(needed, query_views), np.isin(needed, support_views)

    started = time.perf_counter()
    for i, (view, cells) in enumerate(work.encode(network, needed, work.progress)):
        if is_query[i]:
            queries.add(view, cells)
        if is_support[i] and room >= (size := cells.largest_nbytes):
            kept[view] = cells
            room -= size
    work.encode_seconds += time.perf_counter() - started
    work.encoded += len(needed)

    started = time.perf_counter()
    for done, (view, cells) in enumerate(kept.items(), start=1):
        queries.score(view, cells, pairs)
        work.tell("match", done, len(support_views))
    done = len(kept)
    beyond = np.setdiff1d(support_views, np.fromiter(kept, np.int64))
    kept.clear()
    for view, cells in work.encode(network, beyond):
        queries.score(view, cells, pairs)
        work.tell("match", done := done + 1, len(support_views))
    predictions = [nearest_shot(drawn, pairs) for drawn in episodes]
    work.match_seconds += time.perf_counter() - started
    return predictions


class _QueryCells:
    """The k chosen cells of every query view: descriptors (Q, k, D) and norms (Q, k)."""

    def __init__(self, work: Work, views: Indices) -> None:
        self._keys, self._config, self._views = work.views.columns["key"], work.matching, views
        self._norms = torch.empty(len(views), work.matching.points, device=work.device)
        self._descriptors: Tensor | None = None  # allocated with the first view, which tells D

    def add(self, view: int, cells: ViewCells) -> None:
        norm_map = cells.norm_map
        chosen = query_cells(norm_map, self._keys[view], self._config)
        if self._descriptors is None:
            self._descriptors = torch.empty(*self._norms.shape, cells.dim, device=self._norms.device)
        row = int(np.searchsorted(self._views, view))
        self._descriptors[row] = cells.at(chosen)
        self._norms[row] = torch.from_numpy(norm_map.ravel()[chosen])

    @torch.inference_mode()
    def score(self, view: int, cells: ViewCells, pairs: PairScores) -> None:
        """Score a support view against the query views that need it."""
        assert self._descriptors is not None, "queries are added before anything is scored"
        rows = torch.from_numpy(np.searchsorted(self._views, pairs.queries_of(view))).to(self._norms.device)
        pairs.set(view, score_support(self._descriptors[rows], self._norms[rows], cells))


def classify_by_centroid(network: DopeNetwork, episodes: Sequence[Episodes], work: Work) -> list[Indices]:
    """The predicted way (E, ways, queries) of each protocol's queries by the nearest mean of pooled descriptors."""
    started = time.perf_counter()
    needed = np.unique(np.concatenate([part.ravel() for drawn in episodes for part in (drawn.query, drawn.support)]))
    pooled: list[NDArray[np.float32]] = []
    for images in work.views.batches(needed, work.batch, image_size=work.image_size):
        with torch.inference_mode():
            pooled.append(pool(network.descriptors(to_tensor(images, work.device))).cpu().numpy())
        work.tell("encode", min(len(pooled) * work.batch, len(needed)), len(needed))
    vectors = np.zeros((len(work.views), pooled[0].shape[1]), np.float32)
    vectors[needed] = np.concatenate(pooled)
    work.encode_seconds += time.perf_counter() - started
    work.encoded += len(needed)

    started = time.perf_counter()
    predictions = [nearest_centroid(vectors, drawn) for drawn in episodes]
    work.match_seconds += time.perf_counter() - started
    return predictions


def pool(descriptors: Tensor) -> Tensor:
    """The direction (B, D) of the mask-weighted mean of unit descriptors; `descriptors` (B, D, h, w) carry the mask."""
    return torch.nn.functional.normalize(descriptors.mean((2, 3)), dim=1)


def nearest_centroid(vectors: NDArray[np.float32], episodes: Episodes) -> Indices:
    """The way (E, ways, queries) whose mean of shots has the greatest cosine with the query; of equal ones, the first.

    Args:
        vectors: (V, D) unit vectors of all views.
        episodes: indices into them.
    """
    predicted = np.empty(episodes.query.shape, np.int64)
    for e, (support, query) in enumerate(zip(episodes.support, episodes.query, strict=True)):
        centroids = vectors[support].mean(1)
        centroids /= np.maximum(np.linalg.norm(centroids, axis=1, keepdims=True), 1e-12)
        predicted[e] = (vectors[query] @ centroids.T).argmax(-1)
    return predicted
