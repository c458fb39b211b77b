"""What momentum contrast keeps besides the network: a slow copy that makes keys, and a queue of the newest ones."""

from __future__ import annotations

import copy

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dope.distributed import Ranks
from dope.networks import compiling

NO_CLASS = -1
"""Label of a key without a class: nobody's positive."""


class KeyQueue(nn.Module):
    """The newest `size` keys with their labels, first in first out (He et al., MoCo, CVPR 2020, algorithm 1).

    It begins full of random unit vectors without a class, as MoCo's does: they are negatives until they are replaced.
    A buffer each, so that checkpoints hold all of it.

    Args:
        size: keys that are kept (K).
        dim: length of a key (D).
        seed: of the random vectors.

    Attributes:
        keys: (K, D) float32 unit vectors.
        labels: (K,) int64; `NO_CLASS` where there is none.
        place: scalar int64, where the next key goes.
    """

    keys: Tensor
    labels: Tensor
    place: Tensor

    def __init__(self, size: int, dim: int, seed: int) -> None:
        super().__init__()
        start = torch.randn(size, dim, generator=torch.Generator().manual_seed(seed))
        self.register_buffer("keys", F.normalize(start, dim=1))
        self.register_buffer("labels", torch.full((size,), NO_CLASS))
        self.register_buffer("place", torch.zeros((), dtype=torch.int64))

    @torch.no_grad()
    def enqueue(self, keys: Tensor, labels: Tensor | None = None) -> None:
        """Put keys (n, D), with labels (n,), in place of the oldest n; of more than K, only the last K stay."""
        size, n = len(self.keys), len(keys)
        places = (self.place + torch.arange(n, device=keys.device)) % size
        newest = slice(max(0, n - size), n)
        self.keys[places[newest]] = keys[newest].to(self.keys.dtype)
        self.labels[places[newest]] = NO_CLASS if labels is None else labels[newest]
        self.place.copy_((self.place + n) % size)


class KeyEncoder(nn.Module):
    """A copy of a network that follows it as an exponential moving average, without gradient, and its queue of keys.

    BatchNorm stays in training mode: keys are normalised with the statistics of their own batch, as in MoCo.

    A step first makes keys (`keys_of_all`), contrasts with the queue as it is, and says what is to be remembered
    (`remember`). The queue and the copy move when the optimiser has stepped (`update`): a step that is broken off
    leaves both as they were. That gives the numbers of MoCo, whose copy moves before it makes keys: before the first
    step network and copy are equal, so that a move would change nothing.

    Args:
        network: what is copied; maps images (B, 3, H, W) to vectors (B, D).
        queue: the keys' queue.
        momentum: share of the copy that stays at each update.
        compiled: compile the copy's forward pass; names in the state dict stay.
    """

    def __init__(self, network: nn.Module, queue: KeyQueue, momentum: float, *, compiled: bool = False) -> None:
        super().__init__()
        self.momentum, self.queue = momentum, queue
        self.network = copy.deepcopy(network).requires_grad_(False)
        self._forward = compiling.compiled(self.network.forward) if compiled else self.network.forward
        self._remembered: tuple[Tensor, Tensor | None] | None = None
        self.train()

    @torch.no_grad()
    def forward(self, images: Tensor) -> Tensor:
        """Keys (B, D), unit vectors float32 at least, of images (B, 3, H, W)."""
        return unit(self._forward(images))

    def keys_of_all(self, images: Tensor, ranks: Ranks, shuffle_seed: int | None) -> Tensor:
        """Keys (world * B, D) of the images (B, 3, H, W) of all ranks, in the order of ranks.

        With a seed, images are shuffled over the ranks before they are encoded and keys unshuffled after, so that a
        key's BatchNorm statistics say nothing of its query (MoCo, section 3.3).
        """
        if ranks.world == 1 or shuffle_seed is None:
            return ranks.gather(self(images))
        order = torch.randperm(len(images) * ranks.world, generator=torch.Generator().manual_seed(shuffle_seed))
        order = order.to(images.device)
        keys = ranks.gather(self(ranks.share(ranks.gather(images)[order])))
        return keys[order.argsort()]

    def remember(self, keys: Tensor, labels: Tensor | None = None) -> None:
        """What `update` will put into the queue: keys (n, D) of all ranks and their labels (n,)."""
        self._remembered = keys, labels

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Remember the step's keys, and move every parameter by 1 - momentum towards `network`'s; call it after the
        optimiser's step."""
        if self._remembered is not None:
            self.queue.enqueue(*self._remembered)
            self._remembered = None
        own: list[Tensor] = list(self.network.parameters())
        target: list[Tensor] = list(network.parameters())
        torch._foreach_lerp_(own, target, 1 - self.momentum)


class UnitVectors(nn.Module):
    """What DistributedDataParallel wraps: images of a network to unit vectors (B, D), float32 at least.

    Args:
        network: trained by whoever calls this.
        compiled: compile its forward pass.
    """

    def __init__(self, network: nn.Module, *, compiled: bool = False) -> None:
        super().__init__()
        self.network = network
        self._forward = compiling.compiled(network.forward) if compiled else network.forward

    def forward(self, *images: Tensor) -> tuple[Tensor, ...]:
        """Unit vectors of each of the batches of images, which are normalised by BatchNorm each for itself."""
        return tuple(unit(self._forward(some)) for some in images)


def unit(vectors: Tensor) -> Tensor:
    """Vectors (B, D) at length 1, float32 at least."""
    return F.normalize(vectors.to(torch.promote_types(vectors.dtype, torch.float32)), dim=1)


def spread(vectors: Tensor) -> Tensor:
    """How far vectors (B, D) differ in direction: the mean over dimensions of the deviation of unit vectors over the
    batch, times the root of D; 1 where they are spread evenly, 0 where all are one, the collapse to look out for
    (SimSiam, section 4.1)."""
    directions = unit(vectors)
    return directions.std(0, correction=0).mean() * directions.shape[1] ** 0.5
