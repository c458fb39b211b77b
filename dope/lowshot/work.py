"""What an evaluation works with: views in, features out, the memory and the disk it may take, and the time it took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from dope.common.errors import DopeError
from dope.common.progress import Progress
from dope.lowshot.embedding import Embedder
from dope.lowshot.encoding import ViewCells, to_tensor
from dope.lowshot.episodes import Indices
from dope.lowshot.matching import MatchingConfig
from dope.lowshot.views import ViewShards

Spill = Literal["auto", "always", "never"]


class NotFinite(DopeError):
    """Features that are NaN or infinite."""


@dataclass
class Work:
    """The views, how they are compared, and how much of what may be used for it."""

    views: ViewShards
    matching: MatchingConfig
    device: torch.device
    batch: int = 16
    """Views encoded at a time."""
    memory_gib: float = 4.0
    """Descriptors kept in memory (on the device where it is a GPU)."""
    cache: Path | None = None
    """Folder on whose disk those beyond it are kept; None: the system's temporary folder."""
    spill: Spill = "auto"
    """What becomes of those beyond it: kept on disk, or encoded again; auto: what takes less time."""
    image_size: int | None = None
    """Side in pixels that views are resized to; None: the embedder's."""
    progress: Progress | None = None
    source: str = "the network"
    """Where the weights come from, for errors."""
    encode_seconds: float = 0.0
    match_seconds: float = 0.0
    encoded: int = 0
    notes: list[str] = field(default_factory=list)
    """What the user should know of the results."""

    def images(self, embedder: Embedder, indices: Indices) -> Iterator[tuple[Indices, tuple[Tensor, ...]]]:
        """Views in batches: their indices, and what `embedder` is to be given: images, and their masks if it wants."""
        done, size = 0, self.image_size or embedder.image_size
        for images in self.views.batches(indices, self.batch, image_size=size):
            chunk = indices[done : done + len(images)]
            inputs = [to_tensor(images, self.device)]
            if embedder.wants_masks:
                inputs.append(torch.from_numpy(self.views.masks(chunk, image_size=size)).to(self.device))
            yield chunk, tuple(inputs)
            done += len(images)

    def cells(self, embedder: Embedder, indices: Indices, what: str = "encode") -> Iterator[tuple[int, ViewCells]]:
        """Encode views once each, in order: (index, cells).

        Raises:
            NotFinite: a descriptor is.
        """
        done = 0
        for chunk, inputs in self.images(embedder, indices):
            for index, cells in zip(chunk.tolist(), embedder.cells(*inputs), strict=True):
                if not cells.is_finite:
                    raise self.not_finite(index)
                yield index, cells
            done += len(chunk)
            self.encoded += len(chunk)
            self.tell(what, done, len(indices))

    def not_finite(self, index: int) -> NotFinite:
        """The error for a view whose features are NaN or infinite."""
        return NotFinite(
            f"the features of view {self.views.columns['key'][index]} of {self.views.folder} are NaN or infinite",
            where=self.source,
            remedy="Its weights are damaged or training diverged: evaluate an earlier checkpoint",
        )

    def tell(self, what: str, done: int, total: int) -> None:
        if self.progress is not None:
            self.progress(what, done, total)

    @contextmanager
    def encoding(self) -> Iterator[None]:
        """Time that counts as encoding."""
        started = time.perf_counter()
        yield
        self.encode_seconds += time.perf_counter() - started

    @contextmanager
    def matching_time(self) -> Iterator[None]:
        """Time that counts as matching."""
        started = time.perf_counter()
        yield
        self.match_seconds += time.perf_counter() - started
