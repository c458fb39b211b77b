"""The momentum encoder: a slow copy of the network that makes the keys (He et al., MoCo, CVPR 2020)."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from dope.networks import compiling
from dope.networks.dope import DopeNetwork, NetworkOutput


class MomentumEncoder(nn.Module):
    """A copy of `network` that follows its parameters as an exponential moving average and takes no gradient.

    BatchNorm stays in training mode with running statistics of its own, as in MoCo: keys are normalised with the
    statistics of their own batch.

    Args:
        network: what is copied.
        momentum: share of the copy that stays at each update.
        compiled: compile the copy's forward pass; names in the state dict stay.
    """

    def __init__(self, network: DopeNetwork, momentum: float = 0.999, *, compiled: bool = False) -> None:
        super().__init__()
        self.momentum = momentum
        self.network = copy.deepcopy(network).requires_grad_(False)
        self._forward = compiling.compiled(self.network.forward) if compiled else self.network.forward
        self.train()

    @torch.no_grad()
    def forward(self, images: Tensor) -> NetworkOutput:
        """As `DopeNetwork.forward`, without gradient."""
        return self._forward(images)

    @torch.no_grad()
    def sample(self, output: NetworkOutput, cells: Tensor) -> Tensor:
        """As `DopeNetwork.sample`, without gradient."""
        return self.network.sample(output, cells)

    @torch.no_grad()
    def update(self, network: DopeNetwork) -> None:
        """Move every parameter by 1 - momentum towards `network`'s; call it after the optimiser's step."""
        own: list[Tensor] = list(self.network.parameters())
        target: list[Tensor] = list(network.parameters())
        torch._foreach_lerp_(own, target, 1 - self.momentum)
