"""Batches of single views with their classes, for methods that learn from these instead of pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from dope.batch import DamagedSample
from dope.common.errors import BadInput
from dope.decoding import decode_view
from dope.storage import Shards
from dope.tar_samples import REMAKE, ShardReader
from dope.view_index import ViewIndex, read_view_index

TENSORS = ("images", "masks", "labels", "objects")


@dataclass(frozen=True)
class ImageBatch:
    """B views.

    Attributes:
        images: (B, 3, H, W); uint8 RGB from the loader, float RGB in [0, 1] after augmentation.
        masks: (B, 1, H, W) bool, True = object.
        labels: (B,) int64, the class; -1 in place of a damaged sample of a batch that has no good one.
        objects: (B,) int64, a stable number of the object (sequence).
        keys: the samples' keys, for error messages.
        damaged: samples that were to be in the batch, by their place; what lies there instead only fills the place.
    """

    images: Tensor
    masks: Tensor
    labels: Tensor
    objects: Tensor
    keys: tuple[str, ...]
    damaged: Mapping[int, DamagedSample] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.labels)

    def to(self, device: torch.device | str) -> ImageBatch:
        """The same batch on another device (asynchronous from pinned memory)."""
        return replace(self, **{n: getattr(self, n).to(device, non_blocking=True) for n in TENSORS})

    def pin_memory(self) -> ImageBatch:
        return replace(self, **{n: getattr(self, n).pin_memory() for n in TENSORS})

    def laid_out(self, *, channels_last: bool) -> ImageBatch:
        """The same batch with its images in one memory format: convolutions run in that of their input."""
        layout = torch.channels_last if channels_last else torch.contiguous_format
        return replace(self, images=self.images.contiguous(memory_format=layout))

    def without_damaged(self) -> ImageBatch:
        """The places that damaged samples left left out; maybe none remain."""
        return self.at([place for place in range(len(self)) if place not in self.damaged])

    def at(self, places: Sequence[int] | slice) -> ImageBatch:
        """Only the samples at these places, as if none were damaged."""
        numbers = list(range(len(self)))[places] if isinstance(places, slice) else list(places)
        tensors = {n: getattr(self, n)[places] for n in TENSORS}
        return replace(self, **tensors, keys=tuple(self.keys[i] for i in numbers), damaged={})


class ViewDataset(Dataset):
    """The single views of one split that have a class, decoded by row.

    Args:
        shards: the folder, or an fsspec URL of it.
        split: `train` or `val`.
        image_size: side of the decoded images; views of another size are resized.
        categories: only these classes; none given: all.

    Raises:
        BadInput, UsageError: as `read_view_index`.
    """

    def __init__(self, shards: Shards, split: str, *, image_size: int = 224, categories: Sequence[str] = ()) -> None:
        self.index: ViewIndex = read_view_index(shards, split, categories)
        self.image_size = image_size
        self._reader = ShardReader(self.index.storage)

    def __len__(self) -> int:
        return len(self.index)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the labels."""
        return self.index.classes

    def batch(self, rows: Sequence[int]) -> ImageBatch:
        """The samples of `rows`; a damaged one's place is taken by a copy of a good one (see `PairDataset.batch`)."""
        side, locations = self.image_size, [self.index.location(row) for row in rows]
        images, masks = np.zeros((len(rows), 3, side, side), np.uint8), np.zeros((len(rows), side, side), bool)
        damaged: dict[int, DamagedSample] = {}
        for place, (at, members) in enumerate(zip(locations, self._reader.samples(locations), strict=True)):
            try:
                if isinstance(members, BadInput):
                    raise members
                decode_view(members, image=images[place], mask=masks[place], where=at.shard)
            except BadInput as error:
                damaged[place] = DamagedSample(at.shard, at.key, error.what)
        labels, objects = self.index.labels[rows], self.index.objects[rows]
        good = [place for place in range(len(rows)) if place not in damaged]
        for number, place in enumerate(sorted(damaged)):
            if not good:
                images[place], masks[place], labels[place], objects[place] = 0, False, -1, -1
                continue
            other = good[number % len(good)]
            images[place], masks[place] = images[other], masks[other]
            labels[place], objects[place] = labels[other], objects[other]
        return ImageBatch(
            torch.from_numpy(images),
            torch.from_numpy(masks)[:, None],
            torch.from_numpy(labels),
            torch.from_numpy(objects),
            tuple(at.key for at in locations),
            damaged,
        )

    def error(self, sample: DamagedSample) -> BadInput:
        """A damaged sample as an error."""
        where = f"{self.index.storage.where(sample.shard)}, sample {sample.key}"
        return BadInput(sample.reason, where=where, remedy=REMAKE)
