"""VISPE (Ho et al., Exploit Clues from Views, NeurIPS 2020): two views of an object are alike, and alike in what they
are like.

No memory and no head: the pooled features themselves are contrasted, within the batch.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from dope.batch import PairBatch
from dope.distributed import Ranks
from dope.methods.base import Facts, MeanLoss
from dope.methods.pairs import PairMethod
from dope.methods.pooled import PooledNetwork
from dope.methods.queue import UnitVectors
from dope.queries import autocast


class Vispe(PairMethod):
    """View-invariant features by instance discrimination and a divergence between views."""

    name = "vispe"
    sections = ("vispe",)
    own_classifier = "centroid"

    def new_network(self, facts: Facts) -> PooledNetwork:
        return PooledNetwork(self.config.network.width)

    def online(self, network: nn.Module) -> UnitVectors:
        return UnitVectors(network, compiled=self.config.compile)

    def pooled_network(self, network: nn.Module) -> nn.Module:
        return network

    def losses(
        self, online: nn.Module, companion: Any, batch: PairBatch, ranks: Ranks, *, step: int = 0, stop: bool = False
    ) -> MeanLoss:
        settings = self.config.vispe
        with autocast(self.config.precision, batch.objects.device):
            first, second = online(batch.images1, batch.images2)
        places = torch.arange(len(batch), device=first.device) + ranks.rank * len(batch)
        every, objects = ranks.gather_with_gradient(second), ranks.gather(batch.objects)
        likelihood, divergence = vispe_losses(first, second, places, every, objects, settings.temperature)
        total = likelihood + settings.alpha * divergence
        return MeanLoss.of(total, ranks, stop, likelihood=likelihood, divergence=divergence)


def vispe_losses(
    first: Tensor, second: Tensor, places: Tensor, every: Tensor, objects: Tensor, temperature: float
) -> tuple[Tensor, Tensor]:
    """The two parts of the loss, each a mean over b pairs of the N of all ranks.

    P1 = softmax of the rows of Z1 Z2^T / temperature; P2 = softmax of the rows of Z2 Z2^T / temperature with the
    diagonal of Z1 Z2^T / temperature in place of its own. Pairs of the same object, which a batch holds only where
    there are fewer objects than places in it, are left out of each other's rows.

    Args:
        first, second: unit vectors (b, D) of both views.
        places: (b,) where they are among all.
        every: (N, D) unit vectors of the second views of all.
        objects: (N,) the objects of all.
        temperature: divides the similarities.

    Returns:
        -mean(log P1_ii + log P2_ii), and KL(P2 || P1) = mean over i of the sum over j of P2_ij log(P2_ij / P1_ij).
    """
    own = places[:, None]
    left_out = (objects[places][:, None] == objects).scatter(1, own, False)
    across = first @ every.T / temperature
    within = (second @ every.T / temperature).scatter(1, own, across.gather(1, own))
    log1, log2 = (logits.masked_fill(left_out, -torch.inf).log_softmax(1) for logits in (across, within))
    likelihood = -(log1 + log2).gather(1, own).mean()
    # where both are 0 there is nothing to compare, not the infinity less infinity that the logarithms make of it
    ratio = (log2 - log1).masked_fill(left_out, 0)
    return likelihood, (log2.exp() * ratio).sum(1).mean()
