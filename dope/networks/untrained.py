"""A network of random weights, as something to compare a trained one with."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from dope.common.seeds import derive_seed
from dope.networks.batchnorm import batchnorms

if TYPE_CHECKING:
    from collections.abc import Iterator

    from dope.networks.dope import DopeNetwork, NetworkConfig


def untrained_network(config: NetworkConfig, seed: int) -> DopeNetwork:
    """A network in eval mode with random weights that are a function of the seed."""
    from dope.networks.dope import DopeNetwork

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(seed, "untrained network"))
        return DopeNetwork(config).eval()


@torch.no_grad()
def settle_batchnorm(network: nn.Module, images: Iterable[Tensor]) -> None:
    """Set BatchNorm's running statistics to the mean over batches of images (B, 3, H, W), float in [0, 1].

    Random weights with the statistics that PyTorch starts from (mean 0, variance 1) blow the features up from layer to
    layer until every sigmoid is saturated: such a network scores nothing, and beating it would prove nothing. With
    the statistics of real images it is the fair baseline of random weights. The network's mode is restored.
    """
    with _averaging(network):
        for batch in images:
            network(batch)


@contextmanager
def _averaging(network: nn.Module) -> Iterator[None]:
    was_training = network.training
    norms = batchnorms(network)
    momenta = [norm.momentum for norm in norms]
    try:
        network.eval()
        for norm in norms:
            norm.reset_running_stats()
            norm.momentum = None  # a plain average over the batches
            norm.train()
        yield
    finally:
        for norm, momentum in zip(norms, momenta, strict=True):
            norm.momentum = momentum
        network.train(was_training)
