from __future__ import annotations

import numpy as np

from pipeline.cameras import matching
from pipeline.cameras.colmap import MatchedPair


def test_neighbours_with_and_without_wrapping_around():
    assert matching.neighbour_pairs(5, (1, 2), wrap_around=False) == [
        (0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4),
    ]  # fmt: skip
    wrapped = matching.neighbour_pairs(5, (1,), wrap_around=True)
    assert wrapped == [(0, 1), (0, 4), (1, 2), (2, 3), (3, 4)]
    assert matching.neighbour_pairs(3, (1, 2, 4, 8), wrap_around=True) == matching.exhaustive_pairs(3)


def test_images_that_share_features_find_each_other():
    rng = np.random.default_rng(0)

    def unit(n: int) -> np.ndarray:
        values = np.abs(rng.normal(size=(n, 128)))
        return values * 512 / np.linalg.norm(values, axis=1, keepdims=True)

    common = unit(40)
    features = []
    for image in range(4):
        rows = unit(100)
        if image in (0, 2):  # these two see the same 40 things, at the largest scales
            rows[:40] = np.clip(common + rng.normal(size=common.shape) * 3, 0, 255)
        scales = np.where(np.arange(100) < 40, 9.0, 2.0).astype(np.float32)
        order = rng.permutation(100)
        features.append((scales[order], np.rint(rows).clip(0, 255).astype(np.uint8)[order]))
    votes = matching.similarity_votes(features, n_features=60)
    assert votes[0, 2] == votes[2, 0] >= 36
    assert votes.sum() - 2 * votes[0, 2] <= 8 and not votes.diagonal().any()
    assert (0, 2) in matching.most_similar_pairs(votes, 1)


def test_an_image_without_features_is_no_ones_neighbour():
    empty = (np.zeros(0, np.float32), np.zeros((0, 128), np.uint8))
    votes = matching.similarity_votes([empty] * 3, n_features=60)
    assert not votes.any() and matching.most_similar_pairs(votes, 2) == []


def test_largest_component():
    assert matching.largest_component(6, [(0, 1), (1, 2), (4, 5)]) == 3
    assert matching.largest_component(3, []) == 1
    assert matching.largest_component(0, []) == 0


def test_matches_that_move_together_against_the_geometry_are_a_second_motion():
    rng = np.random.default_rng(3)

    def pair(n_still: int) -> MatchedPair:
        first = rng.uniform(0, 640, (200, 2)).astype(np.float32)
        second = rng.uniform(0, 640, (200, 2)).astype(np.float32)  # 60 random errors among 200 matches
        second[:n_still] = first[:n_still] + np.float32(2)
        return MatchedPair(first, second, np.arange(200) >= 60)

    assert matching.second_motion_share([pair(0), pair(5), pair(40), pair(50)], 640) == 0.5
    assert matching.second_motion_share([], 640) == 0
