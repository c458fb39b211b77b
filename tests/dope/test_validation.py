import math
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor, nn

from dope.batch import PairBatch
from dope.distributed import Ranks
from dope.networks import DopeNetwork, NetworkConfig, NetworkOutput
from dope.validation import cells_of, mask_iou, match_hits, pck

SIZE = 64


class Identity(nn.Module):
    """Perfect descriptors: the images' three channels carry a unit vector that is unique for each cell."""

    def __init__(self, mask_logit: float = 50.0) -> None:
        super().__init__()
        self.anchor = nn.Parameter(torch.zeros(1))
        self.mask_logit = mask_logit

    def forward(self, images: Tensor) -> NetworkOutput:
        features = images[:, :, 2::4, 2::4]
        return NetworkOutput(features, torch.full_like(features[:, :1], self.mask_logit))

    def descriptors(self, images: Tensor) -> Tensor:
        return self(images).features

    def sample(self, output: NetworkOutput, cells: Tensor) -> Tensor:
        image = torch.arange(len(cells))[:, None]
        return output.features.permute(0, 2, 3, 1)[image, cells[..., 0], cells[..., 1]]


def batch(shift: int = 0, n_points: int = 40, pairs: int = 2) -> PairBatch:
    """Images of unit vectors; view 2 is view 1 moved by `shift` cells to the right (wrapping round)."""
    generator = torch.Generator().manual_seed(1)
    cells = nn.functional.normalize(torch.randn(pairs, 3, SIZE // 4, SIZE // 4, generator=generator), dim=1)
    first = cells.repeat_interleave(4, 2).repeat_interleave(4, 3)
    second = first.roll(4 * shift, 3)
    points = torch.rand(pairs, n_points, 2, generator=generator) * torch.tensor([SIZE - 4.0 * shift, SIZE])
    points = torch.cat([points, points + torch.tensor([4.0 * shift, 0])], -1)
    masks = torch.ones(pairs, 1, SIZE, SIZE, dtype=torch.bool)
    valid = torch.ones(pairs, n_points, dtype=torch.bool)
    return PairBatch(first, second, masks, masks, points, valid, torch.arange(pairs), ("a", "b")[:pairs])


def test_perfect_descriptors_find_every_point() -> None:
    for shift in (0, 3):
        result = pck(Identity(), [batch(shift), batch(shift)], points=32)  # type: ignore[arg-type]
        assert result == {"pck": 1.0, "points": 128, "mask_iou": 1.0, "pairs": 4}


def test_descriptors_of_the_wrong_place_find_none() -> None:
    good = batch(0)
    moved = good.points.clone()
    moved[..., 2] = (moved[..., 2] + SIZE / 2) % SIZE
    wrong = PairBatch(good.images1, good.images2, good.masks1, good.masks2, moved, good.valid, good.objects, good.keys)
    assert pck(Identity(), [wrong])["pck"] == 0.0  # type: ignore[arg-type]


def test_hits_equal_a_naive_loop() -> None:
    generator = torch.Generator().manual_seed(0)
    queries, grid = torch.randn(3, 7, 5, generator=generator), torch.randn(3, 5, 8, 12, generator=generator)
    targets = torch.rand(3, 7, 2, generator=generator) * torch.tensor([48.0, 32.0])
    hits = match_hits(queries, grid, targets)
    tolerance = round(0.05 * 48)
    for b in range(3):
        for p in range(7):
            scores = [[float(queries[b, p] @ grid[b, :, r, c]) for c in range(12)] for r in range(8)]
            _, row, column = max((scores[r][c], r, c) for r in range(8) for c in range(12))
            dx, dy = abs(column * 4 + 2 - targets[b, p, 0]), abs(row * 4 + 2 - targets[b, p, 1])
            assert bool(hits[b, p]) == bool(dx < tolerance and dy < tolerance)


@pytest.mark.parametrize(("error", "hit"), [(10.9, True), (11.0, False)])
def test_the_tolerance_at_224_is_less_than_11_px_in_each_direction(error: float, hit: bool) -> None:
    grid = torch.zeros(1, 1, 56, 56)
    grid[0, 0, 20, 30] = 1.0
    for axis in (0, 1):
        target = torch.tensor([[[30 * 4 + 2.0, 20 * 4 + 2.0]]])
        target[..., axis] += error
        assert bool(match_hits(torch.ones(1, 1, 1), grid, target)) == hit


def test_only_the_first_valid_points_count() -> None:
    some = batch(0, n_points=10)
    some.valid[0] = torch.tensor([False] * 6 + [True] * 4)
    assert pck(Identity(), [some], points=3)["points"] == 6  # type: ignore[arg-type]
    assert pck(Identity(), [some], points=32)["points"] == 14  # type: ignore[arg-type]


def test_nothing_to_evaluate_is_nan_not_an_error() -> None:
    assert math.isnan(pck(Identity(), [])["pck"])  # type: ignore[arg-type]


def test_mask_iou_counts_any_coverage() -> None:
    masks = torch.zeros(2, 1, 8, 8, dtype=torch.bool)
    masks[0, 0, 0, 0] = masks[0, 0, 7, 7] = True  # one pixel covers two of the four cells
    logits = torch.full((2, 1, 2, 2), -1.0)
    logits[0, 0, 0] = 1.0  # the upper two cells
    assert mask_iou(logits, masks).tolist() == [pytest.approx(1 / 3), 1.0]


def test_cells_are_row_and_column() -> None:
    assert cells_of(torch.tensor([[7.9, 12.0]])).tolist() == [[3, 1]]


def test_the_network_is_evaluated_in_eval_mode_and_left_as_it_was() -> None:
    network = DopeNetwork(NetworkConfig(width=0.125, pyramid=8, projector=(8, 4))).train()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    first = pck(network, [batch(0)])
    assert network.training
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    assert first == pck(network, [batch(0)])


def test_ranks_add_their_counts() -> None:
    def sums() -> Iterator[Tensor]:
        yield torch.tensor([3.0, 4.0, 1.0, 2.0])

    ranks = SimpleNamespace(sum=lambda _: next(sums()))
    result = pck(Identity(), [batch(0)], ranks=ranks)  # type: ignore[arg-type]
    assert result == {"pck": 0.75, "points": 4, "mask_iou": 0.5, "pairs": 2}
    assert Ranks(0, 1, torch.device("cpu")).sum(torch.ones(2)).tolist() == [1.0, 1.0]
