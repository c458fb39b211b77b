"""Augmented copies of the labelled views, for classifiers that are fitted in every episode (RFS's option)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from dope.augmentation import AugmentationConfig, augment_images
from dope.common.errors import UsageError
from dope.common.seeds import derive_seed
from dope.lowshot.embedding import Embedder
from dope.lowshot.episodes import Episodes
from dope.lowshot.work import Work


@dataclass(frozen=True)
class SupportCopies:
    """How many copies of a shot beyond itself, and how they are made."""

    count: int
    """N: copies of each shot."""
    seed: int = 0
    """With the view's key and the copy's number, what the copy looks like."""
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    """The transform of training."""

    def vectors(self, embedder: Embedder, episodes: Sequence[Episodes], work: Work) -> NDArray[np.float32]:
        """Vectors (V, N, D) of the copies of every view that is a shot; other rows are zero.

        A copy is a function of the view's key, its number and the seed, not of batches.

        Raises:
            UsageError: the embedder wants the views' masks, which the copies have only roughly.
            DopeError: a vector is not finite.
        """
        if embedder.wants_masks:
            raise UsageError("cannot be had with given masks", where="--support-copies", remedy="Leave one of them out")
        shots = np.unique(np.concatenate([drawn.support.ravel() for drawn in episodes]))
        size = work.image_size or embedder.image_size
        vectors: NDArray[np.float32] | None = None
        done = 0
        for images in work.views.batches(shots, work.batch, image_size=size):
            chunk = shots[done : done + len(images)]
            masks = work.views.masks(chunk, image_size=size)
            for number in range(self.count):
                copies = [
                    self._copy(image, mask, work.views.columns["key"][view], number)
                    for image, mask, view in zip(images, masks, chunk.tolist(), strict=True)
                ]
                with torch.inference_mode():
                    pooled = embedder.pooled(torch.cat(copies).to(work.device)).float().cpu().numpy()
                bad = np.flatnonzero(~np.isfinite(pooled).all(1))
                if len(bad):
                    raise work.not_finite(int(chunk[bad[0]]))
                if vectors is None:
                    vectors = np.zeros((len(work.views), self.count, pooled.shape[1]), np.float32)
                vectors[chunk, number] = pooled
            done += len(chunk)
            work.encoded += self.count * len(chunk)
            work.tell("encode copies", done, len(shots))
        assert vectors is not None, "episodes have shots"
        return vectors

    def _copy(self, image: NDArray[np.uint8], mask: NDArray[np.bool_], key: str, number: int) -> torch.Tensor:
        """Copy `number` of one view as float (1, 3, H, W) in [0, 1]."""
        generator = torch.Generator().manual_seed(derive_seed(self.seed, "support copy", key, number))
        planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]
        copy, _ = augment_images(planes, torch.from_numpy(mask)[None, None], self.augmentation, generator)
        return copy
