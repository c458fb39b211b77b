"""BatchNorm over several processes, and what its running statistics do when a batch passes in parts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
import torch.distributed as dist
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

Part = TypeVar("Part")
Network = TypeVar("Network", bound=nn.Module)


class _SyncBatchNorm(nn.modules.batchnorm._BatchNorm):
    """BatchNorm whose statistics in training are those of all processes' batches together, on any device.

    `torch.nn.SyncBatchNorm` is for CUDA alone. State-dict keys and, up to rounding, results are those of plain
    BatchNorm on one process with all the images. Statistics are float32 at least, also where the input is of half
    precision.

    The gradient of an input is that of the SUM of all processes' losses: the two sums over a channel which it needs
    are added up over the processes in the backward pass. Gradients of weight and bias stay this process's own. So
    everything behaves as if the processes' losses were one sum, of which each holds the gradients that come from its
    images; DistributedDataParallel, which divides by the number of processes, makes the gradient of their mean of it.
    """

    def forward(self, x: Tensor) -> Tensor:
        """(B, C) or (B, C, H, W) to the same shape and type."""
        if not self.training or not dist.is_initialized() or dist.get_world_size() == 1:
            return super().forward(x)
        normalised, mean, variance, count = _Synchronised.apply(x, self.weight, self.bias, self.eps)
        if self.running_mean is None or self.running_var is None or self.num_batches_tracked is None:
            return normalised  # made without running statistics
        with torch.no_grad():
            self.num_batches_tracked.add_(1)
            share = 1 / int(self.num_batches_tracked) if self.momentum is None else self.momentum
            self.running_mean.lerp_(mean, share)
            self.running_var.lerp_(variance * (count / (count - 1)), share)  # without bias, as BatchNorm
        return normalised


class SyncBatchNorm1d(_SyncBatchNorm, nn.BatchNorm1d):
    """BatchNorm1d over all processes, of vectors (B, C)."""


class SyncBatchNorm2d(_SyncBatchNorm, nn.BatchNorm2d):
    """BatchNorm2d over all processes, of maps (B, C, H, W)."""


SYNCHRONISED: dict[type[nn.Module], type[_SyncBatchNorm]] = {
    nn.BatchNorm1d: SyncBatchNorm1d,
    nn.BatchNorm2d: SyncBatchNorm2d,
}


class _Synchronised(torch.autograd.Function):
    """Normalise by the mean and variance of all processes; weight and bias may be None."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor | None, bias: Tensor | None, eps: float) -> tuple[Tensor, ...]:
        wide = x.to(torch.promote_types(x.dtype, torch.float32))
        own_variance, own_mean = torch.var_mean(wide, _apart(x), correction=0)
        sent = torch.cat([own_mean, own_variance, own_mean.new_tensor([x.numel() / x.shape[1]])])
        received = [torch.empty_like(sent) for _ in range(dist.get_world_size())]
        dist.all_gather(received, sent)
        means, variances, counts = torch.stack(received).split([len(own_mean), len(own_mean), 1], 1)
        # merged as Chan et al. (1979) do: nothing cancels as it does between a sum of squares and a squared sum
        count = counts.sum()
        mean = (means * counts).sum(0) / count
        variance = ((variances + (means - mean).square()) * counts).sum(0) / count
        ctx.save_for_backward(x, weight, mean, (variance + eps).rsqrt(), count)
        ctx.mark_non_differentiable(mean, variance, count)
        scale, shift = (None if values is None else values.to(wide.dtype) for values in (weight, bias))
        normalised = F.batch_norm(wide, mean, variance, scale, shift, eps=eps)
        return normalised.to(x.dtype), mean, variance, count

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        x, weight, mean, inverse, count = ctx.saved_tensors
        apart = _apart(x)
        each = (None, slice(None), *(None for _ in apart[1:]))  # a value for each channel, against x
        gradient = gradient.to(mean.dtype)
        standard = (x.to(mean.dtype) - mean[each]).mul_(inverse[each])
        own = torch.stack([gradient.sum(apart), (gradient * standard).sum(apart)])
        if weight is not None:
            inverse = inverse * weight
        everywhere = own.clone()
        dist.all_reduce(everywhere)
        by_mean, by_variance = everywhere / count
        x_gradient = gradient - standard.mul_(by_variance[each]).add_(by_mean[each])
        x_gradient.mul_(inverse[each])
        if weight is None:
            return x_gradient.to(x.dtype), None, None, None
        return x_gradient.to(x.dtype), own[1].to(weight.dtype), own[0].to(weight.dtype), None


def _apart(x: Tensor) -> tuple[int, ...]:
    """The dimensions of (B, C) or (B, C, H, W) that a channel's statistics are taken over."""
    return (0, *range(2, x.dim()))


def synchronise_batchnorm(network: Network, device: torch.device) -> Network:
    """The network with every BatchNorm1d and BatchNorm2d synchronised over processes; parameters and state-dict keys
    stay."""
    if device.type == "cuda":
        return nn.SyncBatchNorm.convert_sync_batchnorm(network)
    for module in list(network.modules()):
        for name, child in module.named_children():
            if type(child) in SYNCHRONISED:
                assert isinstance(child, nn.modules.batchnorm._BatchNorm)
                kind = SYNCHRONISED[type(child)]
                synchronised = kind(
                    child.num_features, child.eps, child.momentum, child.affine, child.track_running_stats
                )
                synchronised.load_state_dict(child.state_dict(), assign=True)
                setattr(module, name, synchronised)
    return network


def batchnorms(network: nn.Module) -> list[nn.modules.batchnorm._BatchNorm]:
    """Every BatchNorm layer, synchronised or not."""
    return [module for module in network.modules() if isinstance(module, nn.modules.batchnorm._BatchNorm)]


def moving_statistics_once(network: nn.Module, parts: Sequence[Part]) -> Iterator[Part]:
    """Yield the parts of a batch, each of which the caller then passes through `network` without gradient.

    The running statistics of BatchNorm layers in training mode move once for all parts, to the mean of where each part
    alone would have moved them; one part is a plain pass.
    """
    if len(parts) == 1:
        yield parts[0]
        return
    moving = _moving_statistics(network)
    before = [tensor.clone() for tensor in moving]
    total: list[Tensor] = []
    for part in parts:
        if total:
            _put(moving, before)
        yield part
        total = [a + b for a, b in zip(total, moving, strict=True)] if total else [tensor.clone() for tensor in moving]
    _put(moving, [tensor // len(parts) if tensor.dtype == torch.long else tensor / len(parts) for tensor in total])


@contextmanager
def keeping_statistics(network: nn.Module) -> Iterator[None]:
    """Put the running statistics back to what they were."""
    moving = _moving_statistics(network)
    before = [tensor.clone() for tensor in moving]
    try:
        yield
    finally:
        _put(moving, before)


def _moving_statistics(network: nn.Module) -> list[Tensor]:
    return [buffer for norm in batchnorms(network) if norm.training for buffer in norm.buffers()]


@torch.no_grad()
def _put(targets: list[Tensor], values: list[Tensor]) -> None:
    for target, value in zip(targets, values, strict=True):
        target.copy_(value)
