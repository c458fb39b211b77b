"""Random numbers that are a function of the generator alone, wherever the images lie."""

from __future__ import annotations

import torch
from torch import Tensor


class Draws:
    """Columns of uniform numbers for `n` views, drawn in one call and moved to the images' device in one transfer."""

    def __init__(self, n: int, columns: int, generator: torch.Generator, device: torch.device) -> None:
        numbers = torch.rand(n, columns, generator=generator, device=generator.device).to(device)
        self._columns = iter(numbers.unbind(1))

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
