"""PCK and mask IoU on held-out pairs: does a descriptor find its own point in the other view?"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dope.augmentation import no_augmentation
from dope.batch import PairBatch
from dope.distributed import Ranks
from dope.networks import STRIDE, DopeNetwork

TOLERANCE = 0.05  # of the image's side


@torch.no_grad()
def pck(network: DopeNetwork, loader: Iterable[PairBatch], *, points: int = 32, ranks: Ranks | None = None) -> dict:
    """Percentage of correct keypoints: a point of view 1 is a hit if its best match in view 2 is near the true one.

    The best match is the arg max of the dot product over the whole grid of view 2 (its cell's centre); near means that
    the errors in x and in y are both less than round(0.05 * image side) pixels, 11 px at 224.

    Args:
        network: evaluated in eval mode; its mode is restored.
        loader: batches as the loader makes them; with several ranks, this rank's share.
        points: of each pair, its first valid ones.
        ranks: counts are summed over them.

    Returns:
        `pck` in [0, 1], `points` counted, `mask_iou` (mean over pairs of view 1's masks) and `pairs`. Without any point
        or pair the shares are NaN.
    """
    device = next(network.parameters()).device
    totals = torch.zeros(4, dtype=torch.float64, device=device)  # hits, points, sum of IoU, pairs
    with evaluating(network):
        for loaded in loader:
            batch = no_augmentation(loaded.to(device))
            first, second = network(batch.images1), network.descriptors(batch.images2)
            valid = batch.valid & (batch.valid.cumsum(1) <= points)
            hits = match_hits(network.sample(first, cells_of(batch.points[..., :2])), second, batch.points[..., 2:])
            iou = mask_iou(first.mask_logits, batch.masks1)
            totals += torch.stack([(hits & valid).sum(), valid.sum(), iou.sum(), torch.tensor(len(iou))]).to(totals)
    if ranks is not None:
        totals = ranks.sum(totals)
    n_hits, n_points, iou_sum, n_pairs = totals.tolist()
    return {
        "pck": n_hits / n_points if n_points else float("nan"),
        "points": int(n_points),
        "mask_iou": iou_sum / n_pairs if n_pairs else float("nan"),
        "pairs": int(n_pairs),
    }


def match_hits(queries: Tensor, grid: Tensor, targets: Tensor) -> Tensor:
    """Which queries (B, P, D) find their targets x, y (B, P, 2) in px in the grid (B, D, h, w): (B, P) bool."""
    width = grid.shape[-1]
    best = torch.einsum("bpd,bdn->bpn", queries, grid.flatten(2)).argmax(-1)
    x, y = (best % width + 0.5) * STRIDE, (best // width + 0.5) * STRIDE
    tolerance = round(TOLERANCE * width * STRIDE)
    return ((x - targets[..., 0]).abs() < tolerance) & ((y - targets[..., 1]).abs() < tolerance)


def cells_of(points: Tensor) -> Tensor:
    """The feature cell, row and column, of pixels x, y: floor(pixel / stride); (..., 2) float -> (..., 2) long."""
    return (points / STRIDE).floor().long().flip(-1)


def mask_iou(mask_logits: Tensor, masks: Tensor) -> Tensor:
    """Intersection over union (B,) of predicted masks and masks shrunk to the grid (any coverage counts)."""
    truth = F.adaptive_max_pool2d(masks.float(), mask_logits.shape[-2:]) > 0
    predicted = mask_logits > 0
    intersection, union = (predicted & truth).sum((1, 2, 3)), (predicted | truth).sum((1, 2, 3))
    return torch.where(union > 0, intersection / union.clamp(min=1), 1.0)


@contextmanager
def evaluating(network: nn.Module) -> Iterator[None]:
    """The network in eval mode; its mode is restored."""
    training = network.training
    network.eval()
    try:
        yield
    finally:
        network.train(training)
