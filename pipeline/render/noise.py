"""Noise that wraps around at the edges of its picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def wrapping_noise(
    rng: np.random.Generator, height: int, width: int, coarsest: int, octaves: int, fade: float = 0.6
) -> NDArray[np.float32]:
    """Fractal noise (H, W), mean 0, deviation 1, that goes on over its edges; H and W are multiples of `coarsest`'s.

    Args:
        coarsest: pixels of a cell of the first octave, a power of two; halved for each that follows.
        fade: strength of an octave by that of the one before.
    """
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        cell = coarsest >> octave
        if cell < 1:
            break
        rows, columns = max(1, height // cell), max(1, width // cell)
        grid = rng.standard_normal((rows, columns), dtype=np.float32)
        total += fade**octave * enlarged(grid, height, width)
    return (total - total.mean()) / max(float(total.std()), 1e-6)


def enlarged(grid: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """A small picture that wraps around as a large one that does, by bicubic interpolation."""
    margin = 3
    y, x = margin * height // grid.shape[0], margin * width // grid.shape[1]
    wide = np.pad(grid, margin, mode="wrap")
    large = cv2.resize(wide, (width + 2 * x, height + 2 * y), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(large[y : y + height, x : x + width])


def smooth_step(low: float, high: float, x: NDArray[Any]) -> NDArray[Any]:
    """0 below `low`, 1 above `high` (or the other way round), smooth between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)
