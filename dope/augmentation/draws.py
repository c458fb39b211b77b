"""Random numbers that are a function of the generator alone: whatever the device, and whatever the number of ranks."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Share:
    """Which of the `world` equal, contiguous parts of a global batch is meant: part `rank`, counted from 0."""

    rank: int = 0
    world: int = 1


WHOLE = Share()


def uniform_rows(n: int, columns: int, generator: torch.Generator, device: torch.device, share: Share) -> Tensor:
    """(n, columns) float32 in [0, 1) on `device`: this share's rows of those of the whole global batch.

    Every rank draws the rows of all ranks and keeps its own, so that N ranks get the numbers that one process gets.
    They are few: some dozens a pair.
    """
    rows = torch.rand(share.world * n, columns, generator=generator, device=generator.device)
    return rows[share.rank * n : (share.rank + 1) * n].to(device, non_blocking=True)


class Draws:
    """The columns of uniform numbers (n, columns), handed out one after the other as what n views need."""

    def __init__(self, uniform: Tensor) -> None:
        self._columns = iter(uniform.unbind(1))

    def chance(self, p: float) -> Tensor:
        """(n,) bool, True with probability `p`."""
        return next(self._columns) < p

    def uniform(self, bounds: tuple[float, float]) -> Tensor:
        """(n,) float32 between the bounds."""
        low, high = bounds
        return low + (high - low) * next(self._columns)

    def integer(self, bounds: tuple[int, int]) -> Tensor:
        """(n,) long, both bounds included."""
        low, high = bounds
        return low + (next(self._columns) * (high - low + 1)).long().clamp(max=high - low)


def on_device(generator: torch.Generator, device: torch.device) -> torch.Generator:
    """The generator itself where it lives on `device`, else one there that is seeded by a draw from it."""
    if generator.device == device:
        return generator
    seed = torch.randint(2**62, (), generator=generator, device=generator.device)
    return torch.Generator(device).manual_seed(int(seed))


Rows = slice | Tensor


def rows_where(flags: Tensor) -> Rows | None:
    """The rows where `flags` (n,) bool is True, to index with: a slice where all are, so that nothing is copied."""
    rows = flags.nonzero()[:, 0]
    if len(rows) == 0:
        return None
    return slice(None) if len(rows) == len(flags) else rows
