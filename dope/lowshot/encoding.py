"""Views to cells: descriptors on the whole grid, computed once a view and only as far as they are needed.

A cell's descriptor is a unit vector times the soft mask, so the mask alone bounds how well a cell can match. The
projector, which costs more than the encoder on a whole grid, therefore runs on the object's cells first; the
others are projected when a search really comes to them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from dope.networks import NetworkOutput
from dope.networks.dope import CELLS_AT_ONCE

_CELLS_ON_CPU = 2048  # projected at once: 8 MiB of 1024 channels, so that less goes through memory
LIKELY_OBJECT = 0.3  # cells of at least this soft mask are projected when a view is encoded


class Encoder(Protocol):
    """What evaluation needs of a `DopeNetwork`."""

    def __call__(self, images: Tensor) -> NetworkOutput: ...

    def project(self, cell_features: Tensor) -> Tensor: ...


class ViewCells:
    """All M cells of one view, sorted by falling norm of their descriptors (ties by place in the grid).

    Attributes:
        grid: (h, w), h * w = M.
        cells: (M,) places in the flattened grid.
        norms: (M,) float32, the soft mask.
    """

    def __init__(
        self,
        grid: tuple[int, int],
        cells: NDArray[np.int64],
        norms: NDArray[np.float32],
        descriptors: Tensor,
        rest: Tensor,
        describe: Callable[[Tensor, NDArray[np.float32]], Tensor],
    ) -> None:
        self.grid, self.cells, self.norms = grid, cells, norms
        self._descriptors = descriptors  # (P, D) of the first P cells
        self._rest = rest  # (M - P, C) features of the others
        self._describe = describe

    def __len__(self) -> int:
        return len(self.norms)

    @property
    def dim(self) -> int:
        return self._descriptors.shape[1]

    @classmethod
    def of_grid(cls, descriptors: Tensor) -> ViewCells:
        """From the descriptors (h, w, D) of all cells, of any norm: what an encoder without a projector has."""
        height, width, dim = descriptors.shape
        flat = descriptors.reshape(height * width, dim).float()
        norms, order = flat.norm(dim=1).sort(descending=True, stable=True)
        return cls((height, width), order.cpu().numpy(), norms.cpu().numpy(), flat[order], flat[:0], _as_they_are)

    @property
    def nbytes(self) -> int:
        """Memory that it takes as it is: descriptors of some cells, features of the others."""
        tensors = self._descriptors.nbytes + self._rest.nbytes
        return tensors + self.cells.nbytes + self.norms.nbytes

    def packed(self) -> tuple[Callable[..., ViewCells], list[NDArray[Any]]]:
        """All numbers as arrays of 4 bytes each, and what makes the same view of them again, on the same device."""
        device, grid, describe = self._descriptors.device, self.grid, self._describe

        def rebuild(cells: NDArray[Any], norms: NDArray[Any], *parts: NDArray[Any]) -> ViewCells:
            descriptors, rest = (torch.from_numpy(part).to(device) for part in parts)
            return ViewCells(grid, cells.astype(np.int64), norms, descriptors, rest, describe)

        parts = (part.float().cpu().numpy() for part in (self._descriptors, self._rest))
        return rebuild, [self.cells.astype(np.int32), self.norms, *parts]

    @property
    def is_finite(self) -> bool:
        """Whether no number that is computed yet is NaN or infinite."""
        return bool(np.isfinite(self.norms).all() and self._descriptors.isfinite().all())

    @property
    def norm_map(self) -> NDArray[np.float32]:
        """Norms on the grid, (h, w)."""
        norms = np.empty(len(self), np.float32)
        norms[self.cells] = self.norms
        return norms.reshape(self.grid)

    def descriptors(self, start: int, end: int) -> Tensor:
        """Descriptors (end - start, D) of the cells from place `start` to `end` of the sorted order."""
        missing = end - len(self._descriptors)
        if missing > 0:
            norms = self.norms[len(self._descriptors) : end]
            self._descriptors = torch.cat([self._descriptors, self._describe(self._rest[:missing], norms)])
            self._rest = self._rest[missing:].clone()
        return self._descriptors[start:end]

    def at(self, cells: NDArray[np.int64]) -> Tensor:
        """Descriptors (N, D) of cells given by their places in the flattened grid."""
        places = np.empty(len(self), np.int64)
        places[self.cells] = np.arange(len(self))
        places = places[cells]
        known = len(self._descriptors)
        late = places >= known
        found = self._descriptors.new_empty(len(places), self.dim)
        found[~late] = self._descriptors[places[~late]]
        if late.any():
            found[late] = self._describe(self._rest[places[late] - known], self.norms[places[late]])
        return found


def to_tensor(images: NDArray[np.uint8], device: torch.device | str = "cpu") -> Tensor:
    """uint8 images (B, H, W, 3) as float (B, 3, H, W) in [0, 1]."""
    return torch.from_numpy(images).to(device).permute(0, 3, 1, 2).float() / 255


@torch.inference_mode()
def encode(network: Encoder, images: Tensor) -> list[ViewCells]:
    """Encode float images (B, 3, H, W) in [0, 1]; the object's cells are projected in one go."""
    # convolutions of a CPU are faster on it, and a cell's channels lie side by side for the projector
    features, mask_logits = network(images.contiguous(memory_format=torch.channels_last))
    height, width = features.shape[-2:]
    norms, order = mask_logits.float().sigmoid().flatten(1).sort(dim=1, descending=True, stable=True)
    features = features.permute(0, 2, 3, 1).flatten(1, 2)
    sorted_features = features.gather(1, order[..., None].expand_as(features))
    counts = [max(1, count) for count in (norms >= LIKELY_OBJECT).sum(1).tolist()]
    describe = _Describe(network)
    first = torch.cat([view[:count] for view, count in zip(sorted_features, counts, strict=True)])
    all_norms, all_cells = norms.cpu().numpy(), order.cpu().numpy()
    first_norms = np.concatenate([row[:count] for row, count in zip(all_norms, counts, strict=True)])
    described = describe(first, first_norms).split(counts)
    return [
        # clones, so that a kept view does not keep its whole batch
        ViewCells(
            (height, width),
            all_cells[i],
            all_norms[i],
            described[i].clone(),
            sorted_features[i, count:].clone(),
            describe,
        )
        for i, count in enumerate(counts)
    ]


def _as_they_are(features: Tensor, norms: NDArray[np.float32]) -> Tensor:
    return features


class _Describe:
    """Features (N, C) and norms (N,) to descriptors (N, D) float32."""

    def __init__(self, network: Encoder) -> None:
        self._network = network

    @torch.inference_mode()
    def __call__(self, features: Tensor, norms: NDArray[np.float32]) -> Tensor:
        step = _CELLS_ON_CPU if features.device.type == "cpu" else CELLS_AT_ONCE
        parts = [F.normalize(self._network.project(part).float(), dim=1) for part in features.split(step)]
        return torch.cat(parts) * torch.from_numpy(norms).to(features.device)[:, None]
