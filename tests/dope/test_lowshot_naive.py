"""Equality with the evaluation as it is written down, to the last prediction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import naive_lowshot
import numpy as np
import pytest
import torch
from tiny_views import write_views

from dope.lowshot.embedding import DopeEmbedder
from dope.lowshot.episodes import EpisodeConfig, sample_episodes
from dope.lowshot.local import classify_locally
from dope.lowshot.matching import MatchingConfig
from dope.lowshot.screening import Screen
from dope.lowshot.views import ViewShards
from dope.lowshot.work import Spill, Work
from dope.networks import DopeNetwork, NetworkConfig
from dope.networks.untrained import untrained_network

NETWORK = NetworkConfig(width=0.125, pyramid=16, projector=(24, 64))
ONE = EpisodeConfig(ways=3, shots=1, queries=2, episodes=8)
PROTOCOLS = (ONE, replace(ONE, shots=2, episodes=5), replace(ONE, ways=2, shots=3, queries=1, episodes=5, seed=4))
CONFIG = MatchingConfig(points=6)


def network_with_masks(sharpness: float = 60.0) -> DopeNetwork:
    """Random weights whose masks are near 0 in some cells and near 1 in others."""
    network = untrained_network(NETWORK, seed=2)
    with torch.no_grad():
        network.mask_head.weight.mul_(sharpness)  # type: ignore[union-attr]
    return network


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> ViewShards:
    return ViewShards(write_views(tmp_path_factory.mktemp("shards"), views=2))


@pytest.fixture(scope="module")
def expected(views: ViewShards) -> list[np.ndarray]:
    drawn = [sample_episodes(views.population(views.select()), protocol) for protocol in PROTOCOLS]
    return [naive_lowshot.classify(network_with_masks(), views, episodes, CONFIG) for episodes in drawn]


@pytest.mark.parametrize(
    ("batch", "memory_gib", "spill"),
    [(16, 4.0, "auto"), (3, 0.0, "always"), (5, 0.0, "never"), (16, 1e-4, "always"), (7, 1e-4, "never")],
)
def test_predictions_equal_the_naive_ones_whatever_memory_and_batch(
    views: ViewShards, expected: list[np.ndarray], tmp_path: Path, batch: int, memory_gib: float, spill: Spill
) -> None:
    drawn = [sample_episodes(views.population(views.select()), protocol) for protocol in PROTOCOLS]
    work = Work(views, CONFIG, torch.device("cpu"), batch, memory_gib, tmp_path, spill)
    predicted = classify_locally(DopeEmbedder(network_with_masks(), None), drawn, work)
    for ours, naive in zip(predicted, expected, strict=True):
        np.testing.assert_array_equal(ours, naive)
    needed = np.unique(np.concatenate([part.ravel() for d in drawn for part in (d.query, d.support)]))
    shots = np.unique(np.concatenate([d.support.ravel() for d in drawn]))
    if spill == "never":  # what memory has no room for is encoded once more
        assert len(needed) < work.encoded <= len(needed) + len(shots)
    else:
        assert work.encoded == len(needed)
    assert list(tmp_path.iterdir()) == []


def test_the_naive_predictions_are_not_all_the_same_and_have_both_kinds_of_queries(
    views: ViewShards, expected: list[np.ndarray]
) -> None:
    """Else the equality above would say little."""
    assert all(len(np.unique(predicted)) > 1 for predicted in expected)
    grids = [naive_lowshot.descriptors(network_with_masks(), views, i).norm(dim=-1) for i in range(len(views))]
    foregrounds = np.array([int((grid >= CONFIG.foreground).sum()) for grid in grids])
    assert (foregrounds >= CONFIG.points).sum() > 4
    described = torch.cat([naive_lowshot.descriptors(network_with_masks(), views, i).flatten(0, 1) for i in range(3)])
    assert Screen.of(described) is not None  # and the search for the best match is by a subspace
    assert any(0.0 < float(level) < 0.3 for grid in grids for level in grid.ravel())


def test_queries_without_predicted_foreground_are_compared_by_random_cells_and_counted(views: ViewShards) -> None:
    drawn = sample_episodes(views.population(views.select()), ONE)
    network = network_with_masks(1e-3)  # every mask is near 0.5
    work = Work(views, CONFIG, torch.device("cpu"), source="random weights")
    (predicted,) = classify_locally(DopeEmbedder(network, None), [drawn], work)
    np.testing.assert_array_equal(predicted, naive_lowshot.classify(network, views, drawn, CONFIG))
    n = len(np.unique(drawn.query))
    (note,) = work.notes
    assert note.startswith(f"random weights: {n} of {n} query views have fewer than 6 cells")
