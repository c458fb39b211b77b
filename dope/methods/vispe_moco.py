"""VISPE++ with MoCo v2 (He et al., CVPR 2020; Chen et al., 2020): two views of an object are the positive pair."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dope.batch import PairBatch
from dope.common.seeds import derive_seed
from dope.config import TrainConfig
from dope.distributed import Ranks
from dope.methods.base import Facts, MeanLoss
from dope.methods.pairs import PairMethod
from dope.methods.pooled import PooledNetwork
from dope.methods.queue import KeyEncoder, KeyQueue, UnitVectors, spread
from dope.queries import autocast


class ContrastNetwork(nn.Module):
    """An encoder of whole images and the head whose vectors are contrasted.

    Args:
        width: of the encoder.
        head: output widths of its two linear layers, with ReLU between; None: as many as the encoder gives.
    """

    def __init__(self, width: float, head: tuple[int | None, int]) -> None:
        super().__init__()
        self.encoder = PooledNetwork(width)
        hidden, out = head[0] or self.encoder.dim, head[1]
        self.head = nn.Sequential(nn.Linear(self.encoder.dim, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, out))

    def forward(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, D), not normalised."""
        vectors: Tensor = self.head(self.encoder(images))
        return vectors


class VispeMoCo(PairMethod):
    """Momentum contrast between two views of an object."""

    name = "vispe_moco"
    sections = ("moco",)
    own_classifier = "nearest"

    def new_network(self, facts: Facts) -> ContrastNetwork:
        return ContrastNetwork(self.config.network.width, self.config.moco.head)

    def new_companion(self, network: nn.Module) -> KeyEncoder:
        return new_key_encoder(self.config, network, self.config.moco.queue, self.config.moco.head[1])

    def online(self, network: nn.Module) -> UnitVectors:
        return UnitVectors(network, compiled=self.config.compile)

    def pooled_network(self, network: nn.Module) -> nn.Module:
        assert isinstance(network, ContrastNetwork)
        return network.encoder

    def losses(
        self, online: nn.Module, companion: KeyEncoder, batch: PairBatch, ranks: Ranks, *, step: int = 0,
        stop: bool = False,
    ) -> MeanLoss:  # fmt: skip
        with autocast(self.config.precision, batch.objects.device):
            keys = companion.keys_of_all(batch.images2, ranks, shuffle_seed(self.config, step))
            (queries,) = online(batch.images1)
        companion.remember(keys)
        loss = moco_loss(queries, ranks.share(keys), companion.queue.keys, self.config.moco.temperature)
        return MeanLoss.of(loss, ranks, stop, spread=spread(keys))

    def after_step(self, network: nn.Module, companion: Any) -> None:
        companion.update(network)


def new_key_encoder(config: TrainConfig, network: nn.Module, size: int, dim: int) -> KeyEncoder:
    """The momentum copy of a network, with a queue of `size` keys of length `dim` that the run's seed fills."""
    queue = KeyQueue(size, dim, derive_seed(config.seed, "queue"))
    return KeyEncoder(network, queue, config.momentum, compiled=config.compile)


def shuffle_seed(config: TrainConfig, step: int) -> int | None:
    """What orders the keys' images over ranks in a step; None where they stay (`DistributedConfig`)."""
    shuffles = config.distributed.shuffle_batchnorm and not config.distributed.sync_batchnorm
    return derive_seed(config.seed, "shuffle", step) if shuffles else None


def moco_loss(queries: Tensor, keys: Tensor, queue: Tensor, temperature: float) -> Tensor:
    """Cross entropy of each query's own key against it and the whole queue, mean over queries (MoCo, equation 1).

    Args:
        queries, keys: unit vectors (b, D), row by row of one object.
        queue: (K, D) unit vectors, keys of earlier steps; the query's own object may be among them, as in MoCo.
        temperature: divides the dot products.
    """
    positive = (queries * keys).sum(1, keepdim=True)
    logits = torch.cat([positive, queries @ queue.T.to(queries.dtype)], 1) / temperature
    return F.cross_entropy(logits, logits.new_zeros(len(logits), dtype=torch.long))
