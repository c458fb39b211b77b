"""The descriptors of view 1 and the way of their gradients back to the weights, whole or in micro batches."""

from __future__ import annotations

from contextlib import nullcontext

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from dope.common.errors import UsageError
from dope.config import TrainConfig
from dope.losses import mask_loss
from dope.networks import DopeNetwork, compiling
from dope.networks.batchnorm import keeping_statistics, moving_statistics_once


class OnlineEncoder(nn.Module):
    """Image to descriptors at cells and mask logits, in one forward, which is what DistributedDataParallel wraps.

    Args:
        network: trained by whoever calls this.
        compiled: compile the network's forward pass (not the sampling of cells); names in the state dict stay.
    """

    def __init__(self, network: DopeNetwork, *, compiled: bool = False) -> None:
        super().__init__()
        self.network = network
        self._forward = compiling.compiled(network.forward) if compiled else network.forward

    def forward(self, images: Tensor, cells: Tensor) -> tuple[Tensor, Tensor]:
        """(B, 3, H, W), (B, P, 2) to descriptors (B, P, D) and mask logits (B, 1, h, w)."""
        output = self._forward(images)
        return self.network.sample(output, cells), output.mask_logits


class Queries:
    """Descriptors and mask loss of view 1 of a rank's pairs, of which `backward` gives the weights their gradients.

    In one part, that is an ordinary forward and backward pass. In several, activations of one part are in memory at a
    time and the loss still sees all descriptors (GradCache: Gao et al., Scaling Deep Contrastive Learning Batch Size
    under Memory Limited Setup, RepL4NLP 2021): a first pass without gradient leaves the descriptors, the loss gives
    their gradients, and a second pass takes these on to the weights part by part. The gradients are the whole batch's
    where BatchNorm is frozen; in training, its statistics are those of each part. Gradients are averaged over ranks
    once, after the last part.

    Args:
        online: an `OnlineEncoder`, wrapped in DistributedDataParallel where there are several ranks.
        images, cells, masks: view 1's (B, 3, H, W), (B, P, 2), (B, 1, H, W).
        config: precision, and whether there is a mask loss and with which weight.
        parts: equal slices of the B pairs.

    Attributes:
        descriptors: (B, P, D) float32 with gradient.
        mask: scalar, the mean mask loss; 0 where there is none.
    """

    def __init__(
        self,
        online: nn.Module,
        images: Tensor,
        cells: Tensor,
        masks: Tensor,
        config: TrainConfig,
        parts: list[slice],
    ) -> None:
        self._online, self._parts, self._config = online, parts, config
        self._images, self._cells, self._masks = images, cells, masks
        if len(parts) == 1:
            self.descriptors, self.mask = self._encode(online, parts[0])
            return
        bare = online.module if isinstance(online, DistributedDataParallel) else online
        with torch.no_grad():
            encoded = [self._encode(bare, rows) for rows in moving_statistics_once(bare, parts)]
        self.descriptors = torch.cat([descriptors for descriptors, _ in encoded]).requires_grad_()
        self.mask = torch.stack([mask for _, mask in encoded]).mean()

    def backward(self, contrastive: Tensor) -> None:
        """Back-propagate `contrastive`, a scalar made of `descriptors`, plus the weighted mask loss."""
        weight = self._config.loss.mask_weight
        if len(self._parts) == 1:
            (contrastive + weight * self.mask).backward()
            return
        contrastive.backward()
        gradient = self.descriptors.grad
        assert gradient is not None
        with keeping_statistics(self._online):  # the first pass has moved them
            for rows in self._parts:
                waits = isinstance(self._online, DistributedDataParallel) and rows is not self._parts[-1]
                with self._online.no_sync() if waits else nullcontext():  # type: ignore[operator]
                    descriptors, mask = self._encode(self._online, rows)
                    ((descriptors * gradient[rows]).sum() + weight / len(self._parts) * mask).backward()

    def _encode(self, online: nn.Module, rows: slice) -> tuple[Tensor, Tensor]:
        with autocast(self._config.precision, self._images.device):
            descriptors, mask_logits = online(self._images[rows], self._cells[rows])
        # without a mask head the logits are constant: they have no gradient and their loss says nothing
        if self._config.network.predict_mask and self._config.loss.mask_weight > 0:
            return descriptors, mask_loss(mask_logits, self._masks[rows])
        return descriptors, torch.zeros((), device=mask_logits.device)


def resolved_precision(precision: str, device: torch.device) -> str:
    """fp32 or bf16: what the setting `precision` means on a device."""
    if precision == "auto":
        return "bf16" if device.type == "cuda" else "fp32"
    return precision


def autocast(precision: str, device: torch.device) -> torch.autocast:
    """The context of the encoders' passes: bfloat16 where `precision` is bf16, or auto on a CUDA device."""
    half = resolved_precision(precision, device) == "bf16"
    return torch.autocast(device.type, torch.bfloat16, enabled=half)


def micro_batches(size: int, micro_batch: int) -> list[slice]:
    """The parts of a rank's `size` pairs that are encoded at a time: all in one where `micro_batch` is 0.

    Raises:
        UsageError: the parts would not be equal.
    """
    step = micro_batch or size
    if size % step:
        raise UsageError(
            f"a rank's {size} pairs of a batch cannot be divided into micro batches of {micro_batch}",
            where="data.micro_batch",
            remedy="Use a divisor of the batch size over the number of ranks, or 0 for no micro batches",
        )
    return [slice(start, start + step) for start in range(0, size, step)]
