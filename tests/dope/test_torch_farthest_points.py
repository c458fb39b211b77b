"""Batched farthest point sampling against the naive loop."""

from __future__ import annotations

import torch
from torch import Tensor

from dope.farthest_points import farthest_points


def naive(points: Tensor, valid: Tensor, start: int, n: int) -> list[int]:
    chosen, left = [start], [i for i in range(len(points)) if valid[i] and i != start]
    while left and len(chosen) < n:
        distances = [min(float(((points[i] - points[j]) ** 2).sum()) for j in chosen) for i in left]
        chosen.append(left[max(range(len(left)), key=lambda i: distances[i])])
        left.remove(chosen[-1])
    return chosen


def test_equals_naive_loop_with_padding_anywhere() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(8, 60, 2, generator=generator) * 224
    valid = torch.rand(8, 60, generator=generator) < 0.6
    points[~valid] = torch.tensor([float("nan"), 1e9])
    index, ok = farthest_points(points, valid, 16, torch.rand(8, generator=generator))
    assert ok.all()
    for b in range(8):
        assert index[b].tolist() == naive(points[b], valid[b], int(index[b, 0]), 16)


def test_too_few_points_are_each_taken_once_and_the_rest_marked() -> None:
    points = torch.zeros(3, 6, 2)  # identical points: a second choice of the same one would be as "far"
    points[1] = torch.rand(6, 2)
    valid = torch.tensor([[0, 1, 0, 1, 1, 0], [1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 0]], dtype=torch.bool)
    index, ok = farthest_points(points, valid, 5, torch.rand(3))
    assert ok.tolist() == [[True] * 3 + [False] * 2, [True] * 5, [False] * 5]
    assert sorted(index[0, :3].tolist()) == [1, 3, 4]
    assert len(set(index[1].tolist())) == 5
    assert valid[0][index[0]].all()  # the surplus repeats a valid point


def test_start_is_uniform_over_the_valid_points() -> None:
    valid = torch.tensor([False, True, True, False, True]).expand(3000, 5)
    points = torch.rand(3000, 5, 2)
    index, _ = farthest_points(points, valid, 1, torch.rand(3000, generator=torch.Generator().manual_seed(3)))
    share = torch.bincount(index[:, 0], minlength=5) / 3000
    torch.testing.assert_close(share, torch.tensor([0, 1 / 3, 1 / 3, 0, 1 / 3]), atol=0.04, rtol=0)
    assert (farthest_points(points, valid, 1)[0] == 1).all()  # without a draw, the first valid point


def test_no_points_at_all() -> None:
    index, ok = farthest_points(torch.zeros(2, 0, 2), torch.zeros(2, 0, dtype=torch.bool), 4)
    assert index.shape == (2, 4) and not ok.any()
