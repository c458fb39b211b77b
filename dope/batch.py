"""A batch of view pairs, the one thing that passes from the loader through augmentation to the loss."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor


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
    """

    images1: Tensor
    images2: Tensor
    masks1: Tensor
    masks2: Tensor
    points: Tensor
    valid: Tensor
    objects: Tensor
    keys: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.objects)

    def to(self, device: torch.device | str) -> PairBatch:
        """The same batch on another device (asynchronous from pinned memory)."""
        return replace(self, **{n: getattr(self, n).to(device, non_blocking=True) for n in TENSORS})

    def pin_memory(self) -> PairBatch:
        return replace(self, **{n: getattr(self, n).pin_memory() for n in TENSORS})

    def swapped(self, swap: Tensor) -> PairBatch:
        """Exchange the two views of the pairs where `swap` (B,) bool is True."""
        wide = swap[:, None, None, None]
        return replace(
            self,
            images1=torch.where(wide, self.images2, self.images1),
            images2=torch.where(wide, self.images1, self.images2),
            masks1=torch.where(wide, self.masks2, self.masks1),
            masks2=torch.where(wide, self.masks1, self.masks2),
            points=torch.where(swap[:, None, None], self.points[..., [2, 3, 0, 1]], self.points),
        )


TENSORS = ("images1", "images2", "masks1", "masks2", "points", "valid", "objects")
