"""From shards to batches of view pairs. The workers only decode; augmentation is batched on the device."""

from __future__ import annotations

import signal
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import cycle
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dope.batch import DamagedSample, PairBatch
from dope.common.errors import BadInput, DopeError
from dope.decoding import DecodedPair, decode_pair
from dope.shard_index import SampleIndex, read_index
from dope.storage import Shards
from dope.tar_samples import REMAKE, Location, ShardReader

ALL_FOUR = 0x01010101
"""Four bools that are True, as one number: NumPy's `all` over so short an axis takes twenty times as long."""


class PairDataset(Dataset):
    """The view pairs of one split of a folder of shards, decoded by row.

    Args:
        shards: the folder, or an fsspec URL of it.
        split: `train` or `val`.
        image_size: side of the decoded images; views of another size are resized and their points scaled.
        max_points: correspondences read of a pair.
        min_correspondences: pairs with fewer are left out.

    Raises:
        BadInput: the shards are not those that the index describes (see `read_index`), or no pair has enough
            correspondences.
    """

    def __init__(
        self,
        shards: Shards,
        split: str,
        *,
        image_size: int = 224,
        max_points: int = 4096,
        min_correspondences: int = 0,
    ) -> None:
        self.index: SampleIndex = read_index(shards, split).with_correspondences(min_correspondences)
        self.image_size, self.max_points = image_size, max_points
        self._reader = ShardReader(self.index.storage)

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, row: int) -> DecodedPair:
        (pair,) = self.read([row])
        if isinstance(pair, DamagedSample):
            raise self.error(pair)
        return pair

    def read(self, rows: Sequence[int]) -> list[DecodedPair | DamagedSample]:
        """Read the samples of `rows` together, in few long reads, and decode each."""
        locations = [self.index.location(row) for row in rows]
        return [
            self._decoded(row, at, members)
            for row, at, members in zip(rows, locations, self._reader.samples(locations), strict=True)
        ]

    def batch(self, rows: Sequence[int]) -> PairBatch:
        """The samples of `rows` as a batch, damaged ones filled in for.

        A rank's share must keep its size, or the ranks' collectives would not fit. So a damaged sample's place is taken
        by a good sample of the same share, all its points invalid: it has no part in the contrastive loss, and its
        image counts once more in BatchNorm and in the mask loss. `damaged` of the batch says which. Without any good
        sample, the images are black and the objects -1.
        """
        pairs = self.read(rows)
        good = [pair for pair in pairs if isinstance(pair, DecodedPair)]
        fill = cycle([replace(pair, points=pair.points[:0]) for pair in good] or [self._black()])
        filled = [pair if isinstance(pair, DecodedPair) else next(fill) for pair in pairs]
        damaged = {place: pair for place, pair in enumerate(pairs) if isinstance(pair, DamagedSample)}
        return replace(collate(filled), damaged=damaged)

    def error(self, sample: DamagedSample) -> BadInput:
        """A damaged sample as an error."""
        where = f"{self.index.storage.where(sample.shard)}, sample {sample.key}"
        return BadInput(sample.reason, where=where, remedy=REMAKE)

    def _decoded(self, row: int, at: Location, members: dict[str, bytes] | BadInput) -> DecodedPair | DamagedSample:
        try:
            if isinstance(members, BadInput):
                raise members
            sizes = {"image_size": self.image_size, "max_points": self.max_points}
            return decode_pair(members, int(self.index.objects[row]), at.key, where=at.shard, **sizes)
        except BadInput as error:
            return DamagedSample(at.shard, at.key, error.what)

    def _black(self) -> DecodedPair:
        image = np.zeros((3, self.image_size, self.image_size), np.uint8)
        mask = np.zeros(image.shape[1:], bool)
        return DecodedPair((image, image), (mask, mask), np.zeros((0, 4), np.float32), -1, "")


def collate(pairs: Sequence[DecodedPair]) -> PairBatch:
    """Stack decoded pairs; points are padded to the largest number in the batch (at least one row)."""
    size = pairs[0].images[0].shape[-1]
    # released data sets pad with -1: whatever lies outside an image is no correspondence
    points = np.full((len(pairs), max(1, *(len(pair.points) for pair in pairs)), 4), -1, np.float32)
    for row, pair in zip(points, pairs, strict=True):
        row[: len(pair.points)] = pair.points
    inside = (points >= 0) & (points < size)  # NaN is neither
    valid = inside.view(np.uint32)[..., 0] == ALL_FOUR
    points[~valid] = 0
    return PairBatch(
        images1=_stacked([pair.images[0] for pair in pairs]),
        images2=_stacked([pair.images[1] for pair in pairs]),
        masks1=_stacked([pair.masks[0] for pair in pairs])[:, None],
        masks2=_stacked([pair.masks[1] for pair in pairs])[:, None],
        points=torch.from_numpy(points),
        valid=torch.from_numpy(valid),
        objects=torch.tensor([pair.object for pair in pairs], dtype=torch.int64),
        keys=tuple(pair.key for pair in pairs),
    )


class PairLoader:
    """Iterates over the batches of `rows`, in that order, whatever the number of workers.

    Args:
        dataset: what is decoded; a worker reads and decodes a whole batch at a time.
        rows: the sample rows of each batch; read lazily, a few batches ahead.
        workers: decoding processes; 0 decodes here.
        pin_memory: True for a CUDA device.
        fill_damaged: hand out batches with damaged samples filled in for (see `PairDataset.batch`), for the caller to
            look at; else the first damaged sample is an error.
    """

    def __init__(
        self,
        dataset: PairDataset,
        rows: Iterable[list[int]],
        *,
        workers: int = 0,
        pin_memory: bool = False,
        fill_damaged: bool = False,
    ) -> None:
        self._dataset, self._fill_damaged = dataset, fill_damaged
        self._loader = DataLoader(
            _Batches(dataset),
            batch_sampler=rows,
            num_workers=workers,
            collate_fn=_as_it_is,
            pin_memory=pin_memory,
            worker_init_fn=_quiet_worker,
            prefetch_factor=3 if workers else None,
            generator=torch.Generator(),  # leaves the global random state alone
        )

    def __iter__(self) -> Iterator[PairBatch]:
        try:
            for batch in self._loader:
                if isinstance(batch, DopeError):
                    raise batch
                if batch.damaged and not self._fill_damaged:
                    raise self._dataset.error(next(iter(batch.damaged.values())))
                yield batch
        except RuntimeError as error:
            if "DataLoader worker" not in str(error):
                raise
            raise DopeError(
                f"a process that decodes samples died ({error})",
                where=self._dataset.index.storage.address,
                remedy="Memory or shared memory ran out: use --set data.workers=1, or in a container give "
                "more shared memory (docker run --shm-size=4g)",
            ) from error


class _Batches(Dataset):
    """A batch for a list of rows. Errors are handed over as values: DataLoader would turn them into a traceback."""

    def __init__(self, dataset: PairDataset) -> None:
        self.dataset = dataset

    def __getitem__(self, row: int) -> PairBatch | DopeError:
        return self.__getitems__([row])

    def __getitems__(self, rows: list[int]) -> PairBatch | DopeError:
        try:
            return self.dataset.batch(rows)
        except DopeError as error:
            return error


def _as_it_is(batch: Any) -> Any:
    return batch


def _quiet_worker(_: int) -> None:
    cv2.setNumThreads(0)  # the workers are the parallelism
    # a SIGTERM or Ctrl-C to the whole process group must leave time for the trainer's checkpoint; workers end when
    # the loader says so or when their parent is gone
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _stacked(arrays: Sequence[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(arrays))
