"""From shards to batches of view pairs. The workers only decode; augmentation is batched on the device."""

from __future__ import annotations

import signal
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import cycle
from typing import Any, Generic, Protocol, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from dope.batch import DamagedSample, PairBatch
from dope.common.errors import BadInput, DopeError, WorkerDied
from dope.decoding import DecodedPair, decode_pair
from dope.shard_index import SampleIndex, read_index
from dope.stop_signals import STOP_SIGNALS
from dope.storage import Shards
from dope.tar_samples import REMAKE, ShardReader

ALL_FOUR = 0x01010101
"""Four bools that are True, as one number: NumPy's `all` over so short an axis takes twenty times as long."""


class LoadedBatch(Protocol):
    """What a loader needs of a batch."""

    @property
    def damaged(self) -> Mapping[int, DamagedSample]: ...


BatchOf = TypeVar("BatchOf", bound=LoadedBatch, covariant=True)


class BatchSource(Protocol[BatchOf]):
    """Samples that come in batches (`PairDataset`, `dope.single_views.ViewDataset`)."""

    @property
    def index(self) -> Any: ...

    def batch(self, rows: Sequence[int]) -> BatchOf:
        """The samples of `rows`, damaged ones filled in for."""

    def error(self, sample: DamagedSample) -> BadInput:
        """A damaged sample as an error."""


class PairDataset(Dataset):
    """The view pairs of one split of a folder of shards, decoded by row.

    Args:
        shards: the folder, or an fsspec URL of it.
        split: `train` or `val`.
        image_size: side of the decoded images; views of another size are resized and their points scaled.
        max_points: correspondences read of a pair.
        min_correspondences: pairs with fewer are left out.
        categories: only pairs of objects of these; none given: all.

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
        categories: Sequence[str] = (),
    ) -> None:
        index: SampleIndex = read_index(shards, split).of_categories(categories)
        self.index = index.with_correspondences(min_correspondences)
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
        return self._read(rows, *self._arrays(len(rows)))

    def batch(self, rows: Sequence[int]) -> PairBatch:
        """The samples of `rows` as a batch, damaged ones filled in for.

        A rank's share must keep its size, or the ranks' collectives would not fit. So a damaged sample's place is taken
        by a good sample of the same share, all its points invalid: it has no part in the contrastive loss, and its
        image counts once more in BatchNorm and in the mask loss. `damaged` of the batch says which. Without any good
        sample, the images are black and the objects -1.
        """
        images, masks = self._arrays(len(rows))
        pairs = self._read(rows, images, masks)
        damaged = {place: pair for place, pair in enumerate(pairs) if isinstance(pair, DamagedSample)}
        if len(damaged) == len(pairs):
            images[:], masks[:] = 0, False
        black = DecodedPair(
            (images[0, 0], images[1, 0]), (masks[0, 0], masks[1, 0]), np.zeros((0, 4), np.float32), -1, ""
        )
        fill = cycle([pair for pair in pairs if isinstance(pair, DecodedPair)] or [black])
        filled = []
        for place, pair in enumerate(pairs):
            if isinstance(pair, DamagedSample):
                good = next(fill)
                images[:, place], masks[:, place] = good.images, good.masks
                pair = replace(good, points=good.points[:0])
            filled.append(pair)
        return replace(_batch_of(filled, images, masks), damaged=damaged)

    def error(self, sample: DamagedSample) -> BadInput:
        """A damaged sample as an error."""
        where = f"{self.index.storage.where(sample.shard)}, sample {sample.key}"
        return BadInput(sample.reason, where=where, remedy=REMAKE)

    def _arrays(self, n: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        side = self.image_size
        return np.empty((2, n, 3, side, side), np.uint8), np.empty((2, n, side, side), bool)

    def _read(
        self, rows: Sequence[int], images: NDArray[np.uint8], masks: NDArray[np.bool_]
    ) -> list[DecodedPair | DamagedSample]:
        """Decode into arrays (2, B, 3, S, S) and (2, B, S, S): a batch needs no copy of what was decoded."""
        locations = [self.index.location(row) for row in rows]
        pairs: list[DecodedPair | DamagedSample] = []
        for place, (at, members) in enumerate(zip(locations, self._reader.samples(locations), strict=True)):
            try:
                if isinstance(members, BadInput):
                    raise members
                out: dict[str, Any] = {"images": images[:, place], "masks": masks[:, place]}
                number = int(self.index.objects[rows[place]])
                pairs.append(decode_pair(members, number, at.key, max_points=self.max_points, where=at.shard, **out))
            except BadInput as error:
                pairs.append(DamagedSample(at.shard, at.key, error.what))
        return pairs


def collate(pairs: Sequence[DecodedPair]) -> PairBatch:
    """Stack decoded pairs; points are padded to the largest number in the batch (at least one row)."""
    images = np.stack([np.stack(pair.images) for pair in pairs], axis=1)
    masks = np.stack([np.stack(pair.masks) for pair in pairs], axis=1)
    return _batch_of(pairs, images, masks)


def _batch_of(pairs: Sequence[DecodedPair], images: NDArray[np.uint8], masks: NDArray[np.bool_]) -> PairBatch:
    size = images.shape[-1]
    # released data sets pad with -1: whatever lies outside an image is no correspondence
    points = np.full((len(pairs), max(1, *(len(pair.points) for pair in pairs)), 4), -1, np.float32)
    for row, pair in zip(points, pairs, strict=True):
        row[: len(pair.points)] = pair.points
    inside = (points >= 0) & (points < size)  # NaN is neither
    valid = inside.view(np.uint32)[..., 0] == ALL_FOUR
    points[~valid] = 0
    return PairBatch(
        images1=torch.from_numpy(images[0]),
        images2=torch.from_numpy(images[1]),
        masks1=torch.from_numpy(masks[0])[:, None],
        masks2=torch.from_numpy(masks[1])[:, None],
        points=torch.from_numpy(points),
        valid=torch.from_numpy(valid),
        objects=torch.tensor([pair.object for pair in pairs], dtype=torch.int64),
        keys=tuple(pair.key for pair in pairs),
    )


class PairLoader(Generic[BatchOf]):
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
        dataset: BatchSource[BatchOf],
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

    def __iter__(self) -> Iterator[BatchOf]:
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
            raise WorkerDied(
                f"a process that decodes samples died ({error})",
                where=self._dataset.index.storage.address,
                remedy="Memory or shared memory ran out: use --set data.workers=1, or in a container give "
                "more shared memory (docker run --shm-size=4g)",
            ) from error


class _Batches(Dataset):
    """A batch for a list of rows. Errors are handed over as values: DataLoader would turn them into a traceback."""

    def __init__(self, dataset: BatchSource[Any]) -> None:
        self.dataset = dataset

    def __getitem__(self, row: int) -> Any:
        return self.__getitems__([row])

    def __getitems__(self, rows: list[int]) -> Any:
        try:
            return self.dataset.batch(rows)
        except DopeError as error:
            return error


def _as_it_is(batch: Any) -> Any:
    return batch


def _quiet_worker(_: int) -> None:
    cv2.setNumThreads(0)  # the workers are the parallelism
    # a signal to the whole process group must leave time for the trainer's checkpoint; workers end when the loader
    # says so or when their parent is gone
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
