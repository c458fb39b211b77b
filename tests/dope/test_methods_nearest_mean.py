"""SimpleShot: the nearest class mean of transformed features."""

from __future__ import annotations

import math

import numpy as np
import pytest
from episodes_of_rows import episodes_of
from numpy.typing import NDArray

from dope.methods.simpleshot import nearest_mean


@pytest.mark.parametrize("transform", ["cl2n", "l2n", "un"])
def test_the_nearest_mean_is_the_naive_one(transform: str) -> None:
    random = np.random.default_rng(5)
    vectors, mean = random.gamma(1, 1, (60, 6)).astype(np.float32), np.full(6, 0.9, np.float32)
    rows = np.stack([random.permutation(60)[:30] for _ in range(40)]).reshape(40, 3, 10)
    drawn = episodes_of(rows[:, :, :3], rows[:, :, 3:])

    def changed(index: int) -> NDArray[np.float64]:
        x = vectors[index].astype(np.float64) - (mean if transform == "cl2n" else 0)
        return x if transform == "un" else x / math.sqrt(sum(x * x))

    found = nearest_mean(vectors, drawn, transform, mean)
    for e, way, i in np.ndindex(*drawn.query.shape):
        means = [sum(changed(s) for s in shots) / 3 for shots in drawn.support[e]]
        query = changed(drawn.query[e, way, i])
        assert found[e, way, i] == int(np.argmin([sum((query - m) ** 2) for m in means]))


def test_class_means_are_not_scaled_to_unit_length_again() -> None:
    # the first class's shots point in opposite ways but for a little: its mean is short, and far from every unit vector
    at = np.deg2rad([80, -80, 60, 60, 25])
    vectors = np.stack([np.cos(at), np.sin(at)], 1).astype(np.float32)
    drawn = episodes_of([[[0, 1], [2, 3]]], [[[4], [4]]])
    # to the mean (0.17, 0) it is 0.85, to (0.5, 0.87) 0.60; by angle it is nearer to the first
    assert nearest_mean(vectors, drawn, "l2n", np.zeros(2)).ravel().tolist() == [1, 1]
