"""The plain way to do what training does, as the released code of the paper does it: what benchmarks compare with.

Written anew from its description: a loss that looks its negatives up in index tables, farthest point sampling in a loop
over NumPy norms, and a training step in PyTorch's defaults.
"""

from __future__ import annotations

import copy

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from dope.networks import STRIDE, DopeNetwork, NetworkConfig


class TableLoss:
    """InfoNCE over B pairs of P points; negatives by index tables, made once for a batch size.

    Args:
        pairs: B.
        points: P.
        temperature: similarities are divided by it.
    """

    def __init__(self, pairs: int, points: int, temperature: float = 0.1) -> None:
        n = pairs * points
        place = np.arange(n)
        own = place // points
        same = [np.flatnonzero((own == own[i]) & (place != i)) for i in place]
        other = [np.flatnonzero(own != own[i]) for i in place]
        self.same, self.other = torch.from_numpy(np.stack(same)), torch.from_numpy(np.stack(other))
        self.temperature = temperature

    def __call__(self, queries: Tensor, keys: Tensor) -> Tensor:
        """Mean loss of queries (B*P, D) whose positives are the keys (B*P, D) in the same rows."""
        similarity = queries @ keys.t()
        positive = similarity.diagonal()[:, None]
        logits = torch.cat([positive, similarity.gather(1, self.same), similarity.gather(1, self.other)], 1)
        return F.cross_entropy(logits / self.temperature, torch.zeros(len(logits), dtype=torch.long))


def farthest_points(points: NDArray[np.float32], n: int, start: int = 0) -> NDArray[np.int64]:
    """Indices of `n` of the points (N, 2), each the farthest from those before."""
    chosen = [start]
    distance = np.full(len(points), np.inf)
    for _ in range(n - 1):
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)


class PlainStep:
    """A training step in PyTorch's defaults: no fused or batched operations, no memory layout but the default."""

    def __init__(self, pairs: int, points: int) -> None:
        torch.manual_seed(0)
        self.network = DopeNetwork(NetworkConfig())
        self.momentum = copy.deepcopy(self.network).requires_grad_(False)
        self.optimiser = torch.optim.AdamW(self.network.parameters(), 1e-4, weight_decay=1e-2, foreach=False)
        self.loss = TableLoss(pairs, points)

    def __call__(self, images1: Tensor, images2: Tensor, masks1: Tensor, points: Tensor) -> float:
        """Images (B, 3, H, W) float, masks (B, 1, H, W) float, points (B, P, 4) px: one step, and its loss."""
        cells = (points / STRIDE).long()
        first = self.network(images1)
        queries = self.network.sample(first, cells[..., [1, 0]]).flatten(0, 1)
        with torch.no_grad():
            keys = self.momentum.sample(self.momentum(images2), cells[..., [3, 2]]).flatten(0, 1)
        target = (F.interpolate(masks1, first.mask_logits.shape[-2:], mode="area") > 0).float()
        loss = self.loss(queries, keys) + F.binary_cross_entropy(first.mask_logits.sigmoid(), target)
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        with torch.no_grad():
            for own, new in zip(self.momentum.parameters(), self.network.parameters(), strict=True):
                own.data = own.data * 0.999 + new.data * 0.001
        return loss.item()
