"""Farthest point ordering against the textbook loop."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.correspond.farthest_points import farthest_points


def naive(pixels: NDArray, n: int, start: int) -> list[int]:
    distance, chosen = np.full(len(pixels), np.inf), [start]
    while len(chosen) < min(n, len(pixels)):
        distance = np.minimum(distance, ((pixels - pixels[chosen[-1]]) ** 2).sum(axis=1))
        distance[chosen[-1]] = -1
        chosen.append(int(distance.argmax()))
    return chosen


def blob(kind: str) -> NDArray:
    y, x = np.mgrid[:120, :140]
    shapes = {
        "disc": np.hypot(x - 70, y - 60) < 50,
        "ring": np.abs(np.hypot(x - 70, y - 60) - 50) < 4,
        "two parts": (np.hypot(x - 20, y - 20) < 12) | (np.hypot(x - 120, y - 100) < 9),
        "sparse": np.random.default_rng(3).random((120, 140)) < 0.01,
        "line": (y == 60) & (x > 5),
        "far corners": (np.abs(np.subtract.outer(np.arange(300), np.arange(400))) < 2),
        "column": np.ones((300, 1), dtype=bool),
    }
    rows, columns = np.nonzero(shapes[kind])
    return np.stack([columns + 37, rows + 1000], axis=1)  # where the pixels lie does not matter


@pytest.mark.parametrize("kind", ["disc", "ring", "two parts", "sparse", "line", "far corners", "column"])
def test_same_indices_as_the_loop(kind: str) -> None:
    pixels = blob(kind)
    for start in (0, len(pixels) // 3, len(pixels) - 1):
        assert farthest_points(pixels, 100, start).tolist() == naive(pixels, 100, start)


def test_any_prefix_is_the_shorter_order() -> None:
    pixels = blob("disc")
    assert farthest_points(pixels, 300, 7)[:32].tolist() == farthest_points(pixels, 32, 7).tolist()


def test_fewer_pixels_than_wanted_give_each_once() -> None:
    pixels = blob("sparse")
    assert sorted(farthest_points(pixels, 10_000, 5).tolist()) == list(range(len(pixels)))
    assert farthest_points(np.array([[4, 9]]), 32, 0).tolist() == [0]
    assert farthest_points(np.zeros((0, 2), int), 32, 0).tolist() == []
    assert farthest_points(pixels, 0, 0).tolist() == []
