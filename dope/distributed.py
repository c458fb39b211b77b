"""Ranks: one process, or one of several that `torchrun` started. The same code path for both."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.distributed.rendezvous import rendezvous

from dope.common.errors import UsageError

TIMEOUT = timedelta(minutes=20)  # of a collective: validation and checkpoints make ranks wait for each other


@dataclass(frozen=True)
class Ranks:
    """This process among all of a run.

    Attributes:
        rank, world: number of this process and how many there are.
        device: where this process computes.
    """

    rank: int
    world: int
    device: torch.device

    @property
    def is_first(self) -> bool:
        """True on the rank that writes files and talks."""
        return self.rank == 0

    def gather(self, tensor: Tensor) -> Tensor:
        """Concatenate equal-shaped (b, ...) tensors of all ranks, in the order of ranks; no gradient."""
        if self.world == 1:
            return tensor
        tensor = tensor.contiguous()
        raw = tensor.view(torch.uint8) if tensor.dtype == torch.bool else tensor  # gloo and nccl lack bool
        parts = [torch.empty_like(raw) for _ in range(self.world)]
        dist.all_gather(parts, raw)
        return torch.cat(parts).view(tensor.dtype)

    def gather_with_gradient(self, tensor: Tensor) -> Tensor:
        """As `gather`, and gradients flow back: each rank's part gets the sum of those of all ranks' losses.

        With DistributedDataParallel, which averages gradients over ranks, the weights get the gradient of the mean of
        the ranks' losses.
        """
        if self.world == 1:
            return tensor
        gathered: Tensor = _Gather.apply(tensor, self)
        return gathered

    def sum(self, tensor: Tensor) -> Tensor:
        """Sum over ranks, a new tensor; no gradient."""
        tensor = tensor.detach().clone()
        if self.world > 1:
            dist.all_reduce(tensor)
        return tensor

    def share(self, tensor: Tensor) -> Tensor:
        """This rank's part of a tensor that holds equal parts of all ranks."""
        return tensor.chunk(self.world)[self.rank] if self.world > 1 else tensor

    def copy_from_first(self, module: nn.Module) -> None:
        """Give every rank the first rank's parameters and buffers."""
        if self.world > 1:
            for tensor in module.state_dict().values():
                dist.broadcast(tensor, 0)

    def collect(self, value: Any) -> list[Any]:
        """The values of all ranks, in the order of ranks."""
        values: list[Any] = [value] * self.world
        if self.world > 1:
            dist.all_gather_object(values, value)
        return values

    def wait(self) -> None:
        """Return when all ranks are here."""
        if self.world > 1:
            dist.barrier()


class _Gather(torch.autograd.Function):
    """`Ranks.gather`, differentiable."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, ranks: Ranks) -> Tensor:
        ctx.ranks = ranks
        return ranks.gather(tensor)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.ranks.share(ctx.ranks.sum(gradient.contiguous())), None


@contextmanager
def ranks_of(device: str) -> Iterator[Ranks]:
    """Join the run that torchrun's environment describes, or be the only rank; leave it at the end.

    Args:
        device: auto, cpu, cuda or cuda:N; with several ranks, cuda means the GPU of the local rank.

    Raises:
        UsageError: an unknown or absent device, or an environment that describes no run.
    """
    world = world_size()
    chosen = pick_device(device, int(os.environ.get("LOCAL_RANK", "0")) if world > 1 else 0)
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    if world == 1:
        yield Ranks(0, 1, chosen)
        return
    backend = "nccl" if chosen.type == "cuda" else "gloo"
    # after a restart, torchrun's store still holds the addresses of the ranks before, which would be tried in vain
    store, rank, world = next(rendezvous("env://", timeout=TIMEOUT))
    store = dist.PrefixStore(f"start {restarts()}", store)
    dist.init_process_group(backend, store=store, rank=rank, world_size=world, timeout=TIMEOUT)
    try:
        yield Ranks(rank, world, chosen)
    finally:
        gc.collect()  # what DistributedDataParallel holds of the group must go before the group's threads do
        dist.destroy_process_group()


def world_size() -> int:
    """How many ranks the environment says there are. Raises `UsageError` where it says more than one and no more."""
    world = os.environ.get("WORLD_SIZE", "1")
    absent = [name for name in ("RANK", "MASTER_ADDR", "MASTER_PORT") if name not in os.environ]
    if world != "1" and (absent or not world.isdecimal()):
        raise UsageError(
            f"the environment has WORLD_SIZE={world}" + (f", but no {' and no '.join(absent)}" if absent else ""),
            where="WORLD_SIZE",
            remedy="Start the processes by --nproc or torchrun, or unset it",
        )
    return int(world)


def restarts() -> int:
    """How often torchrun has started the ranks again, in this call, because one died."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))


def started_by() -> str:
    """Names the call of torchrun that started the ranks, the same after it started them again."""
    return os.environ.get("TORCHELASTIC_RUN_ID", "")


def pick_device(name: str, local_rank: int = 0, *, flag: str = "--set device=") -> torch.device:
    """The torch device that a setting means. Raises `UsageError`, naming `flag`, where there is no such device."""
    where = flag.rstrip(" =")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise UsageError(f"'{name}' is no device", where=where, remedy="Use auto, cpu, cuda or cuda:N") from None
    if device.type != "cuda":
        return device
    device = torch.device("cuda", local_rank if device.index is None else device.index)
    if not torch.cuda.is_available() or device.index >= torch.cuda.device_count():
        found = torch.cuda.device_count() if torch.cuda.is_available() else 0
        raise UsageError(
            f"there is no {device}: PyTorch sees {found} GPUs",
            where=where,
            remedy=f"Use {flag}cpu, fewer processes, or the CUDA build of PyTorch",
        )
    return device
