"""A batch of view pairs, the one thing that passes from the loader through augmentation to the loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class DamagedSample:
    """A sample that cannot be read or decoded: its shard's name, its key, and why."""

    shard: str
    key: str
    reason: str


@dataclass(frozen=True)
class PairBatch:
    """B pairs of views of B objects, with N correspondences each.

    Attributes:
        images1, images2: (B, 3, H, W); uint8 RGB from the loader, float RGB in [0, 1] after augmentation.
        masks1, masks2: (B, 1, H, W) bool, True = object.
        points: (B, N, 4) float32: x1, y1, x2, y2 in pixels of the images, pixel centres at +0.5.
        valid: (B, N) bool; False for padding and for points that augmentation moved out of an image.
        objects: (B,) int64, a stable number of the object (sequence); equal numbers are never each other's negatives.
        keys: the samples' keys, for error messages.
        damaged: samples that were to be in the batch, by their place; what lies there instead only fills the place.
    """

    images1: Tensor
    images2: Tensor
    masks1: Tensor
    masks2: Tensor
    points: Tensor
    valid: Tensor
    objects: Tensor
    keys: tuple[str, ...]
    damaged: Mapping[int, DamagedSample] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.objects)

    def to(self, device: torch.device | str) -> PairBatch:
        """The same batch on another device (asynchronous from pinned memory)."""
        return replace(self, **{n: getattr(self, n).to(device, non_blocking=True) for n in TENSORS})

    def pin_memory(self) -> PairBatch:
        return replace(self, **{n: getattr(self, n).pin_memory() for n in TENSORS})

    def laid_out(self, *, channels_last: bool) -> PairBatch:
        """The same batch with its images in one memory format: convolutions run in that of their input."""
        layout = torch.channels_last if channels_last else torch.contiguous_format
        return replace(self, **{n: getattr(self, n).contiguous(memory_format=layout) for n in ("images1", "images2")})

    def without_damaged(self) -> PairBatch:
        """The places that damaged samples left left out; maybe none remain."""
        whole = [place for place in range(len(self)) if place not in self.damaged]
        tensors = {n: getattr(self, n)[whole] for n in TENSORS}
        return replace(self, **tensors, keys=tuple(self.keys[place] for place in whole), damaged={})

    def swapped(self, swap: Tensor) -> PairBatch:
        """Exchange the two views of the pairs where `swap` (B,) bool is True."""
        points = torch.where(swap[:, None, None], self.points[..., [2, 3, 0, 1]], self.points)
        images1, images2 = _exchanged(self.images1, self.images2, swap)
        masks1, masks2 = _exchanged(self.masks1, self.masks2, swap)
        return replace(self, images1=images1, images2=images2, masks1=masks1, masks2=masks2, points=points)


def _exchanged(first: Tensor, second: Tensor, swap: Tensor) -> tuple[Tensor, Tensor]:
    """Both with the rows exchanged where `swap` (B,) is True."""
    if not swap.is_cuda:  # rows are copied once, not twice
        pairs = [(b, a) if s else (a, b) for a, b, s in zip(first, second, swap.tolist(), strict=True)]
        a, b = zip(*pairs, strict=True)
        return torch.stack(a), torch.stack(b)
    own = torch.arange(len(swap), device=swap.device)
    both, other = torch.cat([first, second]), own + len(swap)
    return both.index_select(0, torch.where(swap, other, own)), both.index_select(0, torch.where(swap, own, other))


TENSORS = ("images1", "images2", "masks1", "masks2", "points", "valid", "objects")
