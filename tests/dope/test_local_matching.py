from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from dope.lowshot.encoding import ViewCells, encode
from dope.lowshot.episodes import EpisodeConfig, Episodes, sample_episodes
from dope.lowshot.matching import (
    BestShots,
    MatchingConfig,
    QueryDescriptors,
    best_similarities,
    query_cells,
)
from dope.networks import DopeNetwork, NetworkConfig

CONFIG = MatchingConfig(points=5)
NETWORK = NetworkConfig(width=0.125, pyramid=16, projector=(24, 12))


def random_view(generator: torch.Generator, kind: str, grid: tuple[int, int] = (6, 7), dim: int = 8) -> Tensor:
    """Descriptors (h, w, D): an object with a soft border, one that is tiny, or a mask that is unsure everywhere."""
    unit = torch.nn.functional.normalize(torch.randn(*grid, dim, generator=generator), dim=-1)
    mask = torch.rand(*grid, generator=generator)
    if kind == "object":
        mask = torch.where(mask < 0.5, 0.9 + 0.2 * mask, (mask - 0.5) ** 3)
    elif kind == "tiny":
        mask = torch.where(mask < 0.05, 0.95, 0.02 * mask)
    return unit * mask[..., None]


def as_cells(descriptors: Tensor, known: int = 3) -> ViewCells:
    """A view of which only the first few cells are projected yet."""
    h, w, dim = descriptors.shape
    flat = descriptors.reshape(h * w, dim)
    norms, order = flat.norm(dim=1).sort(descending=True, stable=True)
    return ViewCells((h, w), order.numpy(), norms.numpy(), flat[order[:known]], flat[order[known:]], lambda f, _: f)


def naive_score(query: Tensor, cells: NDArray[np.int64], support: Tensor) -> float:
    """The paper's score, in loops."""
    dim = query.shape[-1]
    total = 0.0
    for cell in cells:
        descriptor = query.reshape(-1, dim)[cell]
        total += max(float(descriptor @ other) for other in support.reshape(-1, dim))
    return total


def test_query_cells_are_the_farthest_points_of_the_foreground() -> None:
    norms = np.full((8, 8), 0.3, np.float32)
    norms[2:7, 1:6] = 0.95
    cells = query_cells(norms, "a", CONFIG)
    rows, columns = np.unravel_index(cells, norms.shape)
    assert len(set(cells.tolist())) == 5 and (norms[rows, columns] >= 0.9).all()
    places = np.stack([rows, columns], 1).astype(float)
    foreground = np.argwhere(norms >= 0.9).astype(float)
    for i in range(1, 5):  # each is as far from those before it as any foreground cell is
        distances = np.linalg.norm(foreground[:, None] - places[None, :i], axis=-1).min(1)
        assert np.linalg.norm(places[:i] - places[i], axis=1).min() == pytest.approx(distances.max())


def test_query_cells_depend_on_seed_and_view_alone_and_fall_back_to_the_whole_grid() -> None:
    norms = np.full((8, 8), 0.95, np.float32)
    np.testing.assert_array_equal(query_cells(norms, "a", CONFIG), query_cells(norms, "a", CONFIG))
    drawn = {tuple(query_cells(norms, key, CONFIG)) for key in "abcdefgh"}
    assert len(drawn) > 4
    assert any((query_cells(norms, k, replace(CONFIG, seed=1)) != query_cells(norms, k, CONFIG)).any() for k in "abc")
    norms[1:] = 0.1
    norms[0, 4:] = 0.2  # four foreground cells are fewer than five
    cells = [query_cells(norms, key, CONFIG) for key in "abcdefghij"]
    assert all(len(set(chosen.tolist())) == 5 for chosen in cells)
    assert np.concatenate(cells).max() > 8 and len({tuple(chosen) for chosen in cells}) > 8
    assert len(query_cells(np.ones((2, 2), np.float32), "a", CONFIG)) == 4 + 1  # smaller than k: with repetition


@pytest.mark.parametrize("query_kind", ["object", "tiny", "unsure"])
@pytest.mark.parametrize("support_kind", ["object", "tiny", "unsure"])
def test_best_similarity_is_the_maximum_over_all_cells(query_kind: str, support_kind: str) -> None:
    generator = torch.Generator().manual_seed(3)
    for _ in range(20):
        query, support = random_view(generator, query_kind), random_view(generator, support_kind)
        queries = query.reshape(-1, 8)
        best = best_similarities(queries, queries.norm(dim=1), as_cells(support))
        torch.testing.assert_close(best, (queries @ support.reshape(-1, 8).T).amax(1), rtol=0, atol=1e-6)


def test_similarities_of_opposite_descriptors_come_from_the_background() -> None:
    """The best match of a descriptor that opposes the whole object is a background cell, of similarity near 0."""
    direction = torch.zeros(8)
    direction[0] = 1.0
    support = (-0.95 * direction).repeat(4, 4, 1)
    support[0, 0] = 0.01 * direction
    best = best_similarities(direction[None], torch.ones(1), as_cells(support))
    assert best.item() == pytest.approx(0.01)


def test_background_is_not_projected_where_it_cannot_matter() -> None:
    direction = torch.nn.functional.normalize(torch.ones(8), dim=0)
    support = (0.98 * direction).repeat(6, 6, 1)
    support[3:] = 0.2 * direction

    def refuse(features: Tensor, norms: NDArray[np.float32]) -> Tensor:
        raise AssertionError("projected the background")

    flat = support.reshape(36, 8)
    cells = ViewCells((6, 6), np.arange(36), flat.norm(dim=1).numpy(), flat[:18], flat[18:], refuse)
    assert best_similarities(direction[None], torch.ones(1), cells).item() == pytest.approx(0.98)
    with pytest.raises(AssertionError, match="background"):
        best_similarities(-direction[None], torch.ones(1), cells)


def drawn_and_views() -> tuple[Episodes, list[Tensor]]:
    generator = torch.Generator().manual_seed(0)
    kinds = ("object", "object", "tiny", "unsure")
    views = [random_view(generator, kinds[i % 4]) for i in range(4 * 5 * 3)]
    population = {f"c{c}": {f"o{o}": [(c * 5 + o) * 3 + v for v in range(3)] for o in range(5)} for c in range(4)}
    return sample_episodes(population, EpisodeConfig(ways=3, shots=2, queries=3, episodes=12)), views


def test_predictions_equal_a_naive_implementation() -> None:
    episodes, views = drawn_and_views()
    cells = {i: query_cells(as_cells(view).norm_map, str(i), CONFIG) for i, view in enumerate(views)}

    best = BestShots([episodes])
    for s in best.support_views.tolist():
        queries = best.queries_of(s)
        descriptors = torch.stack([as_cells(views[q]).at(cells[q]) for q in queries.tolist()])
        best.add(s, queries, QueryDescriptors(descriptors, descriptors.norm(dim=2)).scores(as_cells(views[s])))
    (predicted,) = best.predictions()

    for e in range(len(episodes)):
        for way in range(3):
            for i, q in enumerate(episodes.query[e, way].tolist()):
                scores = {
                    (w, j): naive_score(views[q], cells[q], views[episodes.support[e, w, j]])
                    for w in range(3)
                    for j in range(2)
                }
                assert predicted[e, way, i] == max(scores, key=lambda place: scores[place])[0]


def test_each_pair_is_asked_for_once_and_in_any_order_the_first_of_the_best_wins() -> None:
    episodes, _ = drawn_and_views()
    needed = {
        (int(s), int(q)) for e in range(12) for s in episodes.support[e].ravel() for q in episodes.query[e].ravel()
    }
    score = {pair: (7 * pair[0] + 3 * pair[1]) % 4 for pair in needed}  # many are equal
    expected = np.empty(episodes.query.shape, np.int64)
    for e, way, i in np.ndindex(*expected.shape):
        scores = [[score[int(s), int(episodes.query[e, way, i])] for s in shots] for shots in episodes.support[e]]
        expected[e, way, i] = int(np.argmax(scores)) // 2
    for order in (1, -1):
        best = BestShots([episodes, episodes])
        asked: list[tuple[int, int]] = []
        for s in best.support_views[::order].tolist():
            queries = best.queries_of(s)
            assert (np.diff(queries) > 0).all()
            asked += [(s, int(q)) for q in queries]
            best.add(s, queries, np.array([score[s, int(q)] for q in queries], np.float32))
        assert len(asked) == len(needed) and set(asked) == needed
        for predicted in best.predictions():
            np.testing.assert_array_equal(predicted, expected)


def test_encoded_cells_are_the_networks_descriptors() -> None:
    torch.manual_seed(0)
    network = DopeNetwork(NETWORK).eval()
    with torch.no_grad():  # masks from 0 to 1, so that some cells are projected late
        network.mask_head.weight.mul_(3)  # type: ignore[union-attr]
    images = torch.rand(3, 3, 64, 96)
    with torch.inference_mode():
        expected = network.descriptors(images).flatten(2).transpose(1, 2)  # (B, M, D)
    for view, cells in zip(expected, encode(network, images), strict=True):
        assert cells.grid == (16, 24) and (np.diff(cells.norms) <= 0).all()
        torch.testing.assert_close(torch.from_numpy(cells.norm_map.ravel()), view.norm(dim=1), rtol=1e-4, atol=1e-6)
        chosen = np.array([5, 0, 383, 200, 17])
        torch.testing.assert_close(cells.at(chosen), view[chosen], rtol=1e-4, atol=1e-6)
        sorted_view = view[torch.from_numpy(cells.cells)]
        for start, end in ((0, 10), (5, 300), (100, 384), (0, 384)):
            torch.testing.assert_close(cells.descriptors(start, end), sorted_view[start:end], rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(cells.at(chosen), view[chosen], rtol=1e-4, atol=1e-6)
