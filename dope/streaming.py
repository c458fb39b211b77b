"""From shards to batches of view pairs. The workers only decode; augmentation is batched on the device."""

from __future__ import annotations

import io
import signal
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from dope.batch import PairBatch
from dope.common.errors import BadInput, DopeError
from dope.shard_index import SampleIndex, read_index
from dope.stop_signals import STOP_SIGNALS
from dope.tar_samples import REMAKE, ShardReader


@dataclass(frozen=True)
class DecodedPair:
    """One sample: images (S, S, 3) uint8 RGB, masks (S, S) bool, points (N, 4) float32, its object's number and key."""

    images: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    masks: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    points: NDArray[np.float32]
    object: int
    key: str


class PairDataset(Dataset):
    """The view pairs of one split of a folder of shards, decoded by row.

    Args:
        shards: the folder.
        split: `train` or `val`.
        image_size: side of the decoded images; views of another size are resized and their points scaled.
        max_points: correspondences read of a pair.

    Raises:
        BadInput: the shards are not those that the index describes (see `read_index`).
    """

    def __init__(self, shards: Path, split: str, *, image_size: int = 224, max_points: int = 4096) -> None:
        self.index: SampleIndex = read_index(shards, split)
        self.image_size, self.max_points = image_size, max_points
        self._reader = ShardReader(shards)

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, row: int) -> DecodedPair:
        index, shard = self.index, str(self.index.shards[row])
        key = str(index.keys[row])
        members = self._reader.sample(shard, int(index.offsets[row]), int(index.sizes[row]), key)
        where = f"{index.folder / shard}, sample {key}"
        image1, scale1 = self._image(members, "1.jpg", where)
        image2, scale2 = self._image(members, "2.jpg", where)
        points = _points(members, self.max_points, where) * np.concatenate([scale1, scale2])
        masks = (self._mask(members, "1.png", where), self._mask(members, "2.png", where))
        return DecodedPair((image1, image2), masks, points, int(index.objects[row]), key)

    def _image(self, members: dict[str, bytes], name: str, where: str) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        image = _decoded(members, name, cv2.IMREAD_COLOR, where)
        height, width = image.shape[:2]
        scale = np.array([self.image_size / width, self.image_size / height], np.float32)
        return np.asarray(cv2.cvtColor(resized(image, self.image_size), cv2.COLOR_BGR2RGB), np.uint8), scale

    def _mask(self, members: dict[str, bytes], name: str, where: str) -> NDArray[np.bool_]:
        return resized(_decoded(members, name, cv2.IMREAD_GRAYSCALE, where), self.image_size) > 127


def resized(image: NDArray[Any], size: int | None) -> NDArray[Any]:
    """The image as a square of `size` pixels, the same in training, evaluation and figures; as it is where None."""
    if size is None or image.shape[:2] == (size, size):
        return image
    shrinks = min(image.shape[:2]) >= size
    return cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def collate(pairs: Sequence[DecodedPair]) -> PairBatch:
    """Stack decoded pairs; points are padded to the largest number in the batch (at least one row)."""
    n_points = max(1, max(len(pair.points) for pair in pairs))
    size = pairs[0].images[0].shape[0]
    points = np.zeros((len(pairs), n_points, 4), np.float32)
    valid = np.zeros((len(pairs), n_points), bool)
    for row, pair in enumerate(pairs):
        n = len(pair.points)
        points[row, :n] = pair.points
        # released data sets pad with -1: whatever lies outside an image is no correspondence
        valid[row, :n] = (np.isfinite(pair.points) & (pair.points >= 0) & (pair.points < size)).all(axis=1)
    points[~valid] = 0
    images = [torch.from_numpy(np.stack([p.images[view] for p in pairs])).permute(0, 3, 1, 2) for view in (0, 1)]
    masks = [torch.from_numpy(np.stack([p.masks[view] for p in pairs]))[:, None] for view in (0, 1)]
    return PairBatch(
        images1=images[0].contiguous(),
        images2=images[1].contiguous(),
        masks1=masks[0],
        masks2=masks[1],
        points=torch.from_numpy(points),
        valid=torch.from_numpy(valid),
        objects=torch.tensor([pair.object for pair in pairs], dtype=torch.int64),
        keys=tuple(pair.key for pair in pairs),
    )


class PairLoader:
    """Iterates over the batches of `rows`, in that order, whatever the number of workers.

    Args:
        dataset: what is decoded.
        rows: the sample rows of each batch; read lazily, a few batches ahead.
        workers: decoding processes; 0 decodes here.
        pin_memory: True for a CUDA device.
    """

    def __init__(
        self, dataset: PairDataset, rows: Iterable[list[int]], *, workers: int = 0, pin_memory: bool = False
    ) -> None:
        self._folder = dataset.index.folder
        self._loader = DataLoader(
            _Explaining(dataset),
            batch_sampler=rows,
            num_workers=workers,
            collate_fn=_collate_or_error,
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
                yield batch
        except RuntimeError as error:
            if "DataLoader worker" not in str(error):
                raise
            raise DopeError(
                f"a process that decodes samples died ({error})",
                where=self._folder,
                remedy="Memory or shared memory ran out: use --set data.workers=1, or in a container give "
                "more shared memory (docker run --shm-size=4g)",
            ) from error


class _Explaining(Dataset):
    """Hands errors over as values: DataLoader would turn them into a traceback text."""

    def __init__(self, dataset: PairDataset) -> None:
        self.dataset = dataset

    def __getitem__(self, row: int) -> DecodedPair | DopeError:
        try:
            return self.dataset[row]
        except DopeError as error:
            return error


def _collate_or_error(pairs: list[DecodedPair | DopeError]) -> PairBatch | DopeError:
    decoded = []
    for pair in pairs:
        if isinstance(pair, DopeError):
            return pair
        decoded.append(pair)
    return collate(decoded)


def _quiet_worker(_: int) -> None:
    cv2.setNumThreads(0)  # the workers are the parallelism
    # a signal to the whole process group must leave time for the trainer's checkpoint; workers end when the loader
    # says so or when their parent is gone
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _decoded(members: dict[str, bytes], name: str, flags: int, where: str) -> NDArray[np.uint8]:
    if name not in members:
        raise BadInput(f"has no {name}", where=where, remedy=REMAKE)
    image = cv2.imdecode(np.frombuffer(members[name], np.uint8), flags) if members[name] else None
    if image is None:
        raise BadInput(f"{name} cannot be decoded", where=where, remedy=REMAKE)
    return image  # type: ignore[return-value]


def _points(members: dict[str, bytes], max_points: int, where: str) -> NDArray[np.float32]:
    try:
        points = np.load(io.BytesIO(members["corr.npy"]), allow_pickle=False)
    except KeyError:
        raise BadInput("has no corr.npy", where=where, remedy=REMAKE) from None
    except (ValueError, EOFError, OSError) as error:
        raise BadInput(f"corr.npy cannot be read ({error})", where=where, remedy=REMAKE) from error
    if points.ndim != 2 or points.shape[1] != 4 or points.dtype.kind != "f":
        raise BadInput(f"corr.npy is {points.dtype} {points.shape}, not float32 (N, 4)", where=where, remedy=REMAKE)
    return points[:max_points].astype(np.float32)
