"""VISPE++ with SimSiam (Chen and He, CVPR 2021): each view of an object predicts the other one, and
nothing is pushed apart."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from dope.batch import PairBatch
from dope.common.errors import UsageError
from dope.distributed import Ranks
from dope.methods.base import Facts, MeanLoss
from dope.methods.configs import SimSiamConfig
from dope.methods.pairs import PairMethod
from dope.methods.pooled import PooledNetwork
from dope.methods.queue import spread, unit
from dope.networks import compiling
from dope.queries import autocast


class SimSiamNetwork(nn.Module):
    """An encoder of whole images, a projector of three layers and a predictor of two (SimSiam, section 3)."""

    def __init__(self, width: float, config: SimSiamConfig) -> None:
        super().__init__()
        self.encoder = PooledNetwork(width)
        inner, hidden = config.projector, config.predictor
        self.projector = nn.Sequential(
            *_layer(self.encoder.dim, inner),
            *_layer(inner, inner),
            nn.Linear(inner, inner, bias=False),
            nn.BatchNorm1d(inner, affine=False),
        )
        self.predictor = nn.Sequential(*_layer(inner, hidden), nn.Linear(hidden, inner))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """(B, 3, H, W) to projections z and predictions p, (B, projector) each, not normalised."""
        projections = self.projector(self.encoder(images))
        return projections, self.predictor(projections)


class Siamese(nn.Module):
    """What DistributedDataParallel wraps: both views through one network, each with BatchNorm statistics of its own."""

    def __init__(self, network: SimSiamNetwork, *, compiled: bool = False) -> None:
        super().__init__()
        self.network = network
        self._forward: Any = compiling.compiled(network.forward) if compiled else network.forward

    def forward(self, images1: Tensor, images2: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """z1, p1, z2, p2."""
        return (*self._forward(images1), *self._forward(images2))


class VispeSimSiam(PairMethod):
    """Siamese prediction between two views of an object."""

    name = "vispe_simsiam"
    sections = ("simsiam",)
    own_classifier = "nearest"

    def new_network(self, facts: Facts) -> SimSiamNetwork:
        return SimSiamNetwork(self.config.network.width, self.config.simsiam)

    def online(self, network: nn.Module) -> Siamese:
        assert isinstance(network, SimSiamNetwork)
        return Siamese(network, compiled=self.config.compile)

    def pooled_network(self, network: nn.Module) -> nn.Module:
        assert isinstance(network, SimSiamNetwork)
        return network.encoder

    def parameter_groups(self, network: nn.Module) -> list[dict[str, Any]]:
        assert isinstance(network, SimSiamNetwork)
        predictor = list(network.predictor.parameters())
        others = [*network.encoder.parameters(), *network.projector.parameters()]
        return [{"params": others}, {"params": predictor, "lr_constant": self.config.simsiam.constant_predictor_lr}]

    def losses(
        self, online: nn.Module, companion: Any, batch: PairBatch, ranks: Ranks, *, step: int = 0, stop: bool = False
    ) -> MeanLoss:
        if len(batch) < 2 and not (self.config.distributed.sync_batchnorm and ranks.world > 1):
            what = f"leaves one pair for each of {ranks.world} ranks, of which BatchNorm has no variance"
            remedy = "Use twice as much, fewer ranks, or --set distributed.sync_batchnorm=true"
            raise UsageError(what, where="data.batch_size", remedy=remedy)
        with autocast(self.config.precision, batch.objects.device):
            z1, p1, z2, p2 = online(batch.images1, batch.images2)
        loss = (negative_cosine(p1, z2) + negative_cosine(p2, z1)) / 2
        spreads = [spread(ranks.gather(z.detach())) for z in (z1, z2)]
        return MeanLoss.of(loss, ranks, stop, spread=torch.stack(spreads).mean())


def negative_cosine(predictions: Tensor, projections: Tensor) -> Tensor:
    """-cosine, mean over rows (B, D); no gradient goes to the projections (SimSiam, equations 1 and 3)."""
    return -(unit(predictions) * unit(projections.detach())).sum(1).mean()


def _layer(inputs: int, outputs: int) -> list[nn.Module]:
    return [nn.Linear(inputs, outputs, bias=False), nn.BatchNorm1d(outputs), nn.ReLU(inplace=True)]
