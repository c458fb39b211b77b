"""Which pairs of frames are matched: neighbours in time, all of them, or those that look alike."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pipeline.cameras.colmap import MatchedPair

Pair = tuple[int, int]
"""Positions of two frames, the smaller first."""

SIFT_NORM = 512.0  # COLMAP's 8-bit SIFT descriptors have about this length


def exhaustive_pairs(n: int) -> list[Pair]:
    """All pairs of `n` frames."""
    return list(combinations(range(n), 2))


def neighbour_pairs(n: int, gaps: Iterable[int], *, wrap_around: bool) -> list[Pair]:
    """Pairs of frames that lie a gap apart; with `wrap_around` the last frame is followed by the first again."""
    pairs = set()
    for gap in gaps:
        for first in range(n if wrap_around else n - gap):
            second = (first + gap) % n
            if first != second:
                pairs.add((min(first, second), max(first, second)))
    return sorted(pairs)


def similarity_votes(
    features: Sequence[tuple[NDArray[np.float32], NDArray[np.uint8]]], n_features: int, max_ratio: float = 0.8
) -> NDArray[np.int64]:
    """How many of their largest features two images share, for all pairs: cheap enough for hundreds of images.

    The `n_features` of largest scale are mutual nearest neighbours and pass Lowe's ratio test (IJCV 2004). Products of
    8-bit descriptors are whole numbers below 2^24, exact in float32: the result does not depend on the BLAS.

    Args:
        features: for each image the scales (N,) and descriptors (N, 128) of its features.

    Returns:
        symmetric (n, n) counts, 0 on the diagonal.
    """
    largest = []
    for scales, descriptors in features:
        order = np.argsort(-scales, kind="stable")[:n_features]
        largest.append(descriptors[order].astype(np.float32))
    votes = np.zeros((len(features), len(features)), dtype=np.int64)
    for i, j in exhaustive_pairs(len(features)):
        if min(len(largest[i]), len(largest[j])) < 2:
            continue
        products = largest[i] @ largest[j].T
        rows = np.arange(len(products))
        nearest = products.argmax(axis=1)
        best = products[rows, nearest].copy()
        mutual = products.argmax(axis=0)[nearest] == rows
        products[rows, nearest] = -1
        # squared distances of vectors of one length; descriptors are not exactly that long, hence the lower bound
        first, second = (np.maximum(2 - 2 * p / SIFT_NORM**2, 0) for p in (best, products.max(axis=1)))
        votes[i, j] = votes[j, i] = np.count_nonzero(mutual & (first < max_ratio**2 * second))
    return votes


def most_similar_pairs(votes: NDArray[np.int64], neighbours: int) -> list[Pair]:
    """Each frame with the `neighbours` frames that share most with it; frames that share nothing are no pair."""
    pairs = set()
    for i, row in enumerate(votes):
        for j in np.argsort(-row, kind="stable")[:neighbours]:
            if row[j] > 0:
                pairs.add((min(i, int(j)), max(i, int(j))))
    return sorted(pairs)


def largest_component(n: int, pairs: Iterable[Pair]) -> int:
    """Number of frames in the largest connected component of the graph of pairs: no model can have more."""
    parent = list(range(n))

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for first, second in pairs:
        parent[root(first)] = root(second)
    return int(np.bincount([root(node) for node in range(n)]).max(initial=0)) if n else 0


def second_motion_share(pairs: Iterable[MatchedPair], size_px: float) -> float:
    """Share of image pairs that show two motions: one geometry, and matches against it that move together.

    In a still scene, matches that break the geometry of two views are errors and point anywhere. Behind a turntable
    stands a background that has another motion, often none: its matches share one shift.

    Args:
        pairs: verified pairs with all their matches.
        size_px: longer side of the images; a shift is shared within 0.4% of it.
    """
    double = []
    for pair in pairs:
        shift = (pair.second_px - pair.first_px)[~pair.verified]
        shift = shift[:: -(-len(shift) // 500) or 1]  # a sample is enough, and the table of all pairs stays small
        together = 0
        if len(shift):
            apart = np.linalg.norm(shift[:, None] - shift[None], axis=-1)
            together = int((apart < 0.004 * size_px).sum(axis=1).max())
        double.append(together >= 10 and together > 0.1 * len(pair.verified))
    return float(np.mean(double)) if double else 0.0
