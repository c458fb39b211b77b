"""The paper's evaluation by local matching as it is written down: every episode encodes its views anew, one at a time,
and compares whole grids. Slow, and independent of everything but the draw of episodes and of random numbers."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dope.common.seeds import derive_seed
from dope.lowshot.encoding import to_tensor
from dope.lowshot.episodes import Episodes
from dope.lowshot.matching import MatchingConfig
from dope.lowshot.views import ViewShards
from dope.networks import DopeNetwork


def descriptors(network: DopeNetwork, views: ViewShards, index: int) -> Tensor:
    """The whole grid (h, w, D) of one view."""
    with torch.inference_mode():
        return network.descriptors(to_tensor(views.image(index)[None]))[0].permute(1, 2, 0)


def query_cells(grid: Tensor, key: str, config: MatchingConfig) -> list[tuple[int, int]]:
    """k cells of the foreground, each the farthest from those before; or of the whole grid, where there are fewer."""
    norms = grid.norm(dim=-1)
    h, w = norms.shape
    foreground = [(r, c) for r in range(h) for c in range(w) if norms[r, c] >= config.foreground]
    seed = derive_seed(config.seed, "query cells", key)
    if len(foreground) < config.points:
        drawn = np.random.default_rng(seed).choice(h * w, config.points, replace=False)
        return [(int(i) // w, int(i) % w) for i in drawn]
    start = float(torch.rand(1, generator=torch.Generator().manual_seed(seed)))
    chosen = [foreground[int(start * len(foreground))]]
    while len(chosen) < config.points:
        distance = [min((r - y) ** 2 + (c - x) ** 2 for y, x in chosen) for r, c in foreground]
        chosen.append(foreground[int(np.argmax(distance))])
    return chosen


def classify(network: DopeNetwork, views: ViewShards, episodes: Episodes, config: MatchingConfig) -> NDArray[np.int64]:
    """The predicted way (E, ways, queries) of every query."""
    predicted = np.empty(episodes.query.shape, np.int64)
    for e in range(len(episodes)):
        shots = [[descriptors(network, views, int(i)) for i in way] for way in episodes.support[e]]
        for way, i in np.ndindex(*predicted.shape[1:]):
            index = int(episodes.query[e, way, i])
            grid = descriptors(network, views, index)
            cells = query_cells(grid, views.columns["key"][index], config)
            scores = [[sum(float((shot @ grid[r, c]).max()) for r, c in cells) for shot in of_way] for of_way in shots]
            predicted[e, way, i] = int(np.argmax(np.max(scores, axis=1)))
    return predicted
