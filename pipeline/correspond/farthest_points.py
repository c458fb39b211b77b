"""Farthest point ordering of pixels: any prefix of the order is spread evenly over the object.

The exact greedy algorithm (Gonzalez, 1985; Eldar et al., 1997). On a pixel grid the distances to one pixel are a window
of one constant table, and a new pixel can only bring nearer what lies within the current largest distance, so a step is
one `np.minimum` on a small window and one `argmax`. As that distance shrinks, so do the window and the type of integer
that holds it: most steps are made on bytes.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

STRIDE = 32  # rows are padded to a multiple of this, so that few tables serve objects of all widths


def farthest_points(pixels: NDArray[np.integer], n: int, start: int) -> NDArray[np.intp]:
    """Indices of up to n pixels, each the farthest from all before it, beginning with `start`.

    Args:
        pixels: (N, 2) whole numbers: column and row of distinct pixels.
        n: how many are wanted; all N in order where N is smaller.
        start: index of the first.

    Returns:
        (min(n, N),) indices into `pixels`. Ties go to the pixel that comes first in reading order.
    """
    n = min(n, len(pixels))
    if n == 0:
        return np.zeros(0, dtype=np.intp)
    columns, rows = (pixels - pixels.min(axis=0)).T
    width, height = int(columns.max()) + 1, int(rows.max()) + 1
    places = rows * width + columns
    dx, dy = columns - columns[start], rows - rows[start]
    # squared, to the nearest chosen pixel; 0: not to be chosen
    distance: NDArray[np.integer] = np.zeros((height, width), dtype=np.int32)
    distance.reshape(-1)[places] = dx * dx + dy * dy
    chosen = places[start : start + 1]
    while len(chosen) < n:
        more, distance = _choose(distance, n - len(chosen))
        chosen = np.concatenate([chosen, more])
    index = np.empty(height * width, dtype=np.intp)
    index[places] = np.arange(len(pixels))
    return index[chosen]


def _choose(distance: NDArray[np.integer], n: int) -> tuple[NDArray[np.intp], NDArray[np.integer]]:
    """Choose up to n pixels, until half the largest distance is reached: their places, and the distances then."""
    height, width = distance.shape
    farthest = int(distance.max())
    reach = max(4, 1 << (math.isqrt(farthest) - 1).bit_length())
    enough = (reach // 2) ** 2 + 1 if reach > 4 else 1
    stride = -(-max(width + reach, 2 * reach + 1) // STRIDE) * STRIDE
    padded = np.zeros((height + 2 * reach + 2, stride), _smallest_type(farthest))
    inner = padded[reach + 1 : reach + 1 + height, :width]
    inner[...] = distance
    flat = padded.reshape(-1)
    disc = _disc(reach, stride, flat.dtype)
    half = len(disc) // 2
    chosen: list[int] = []
    for _ in range(n):
        place = int(flat.argmax())
        if flat.item(place) < enough:
            break
        chosen.append(place)
        window = flat[place - half : place + half + 1]
        np.minimum(window, disc, out=window)
    row, column = np.divmod(np.array(chosen, dtype=np.intp), stride)
    return (row - reach - 1) * width + column, inner


def _smallest_type(largest: int) -> type[np.integer]:
    return np.uint8 if largest <= 0xFF else np.uint16 if largest <= 0xFFFF else np.int32


@functools.lru_cache(maxsize=128)
def _disc(reach: int, stride: int, dtype: np.dtype[np.integer]) -> NDArray[np.integer]:
    """dx^2 + dy^2 around a pixel, `reach` to each side, as one run of rows of `stride`; between them the type's most.

    A run makes a step a minimum of two contiguous arrays. What does not fit the type takes its largest value, too.
    """
    most = np.iinfo(dtype).max
    d = np.arange(-reach, reach + 1, dtype=np.int64) ** 2
    rows = np.full((2 * reach + 1, stride), most, dtype)
    rows[:, : 2 * reach + 1] = np.minimum(d[:, None] + d[None, :], most)
    return rows.reshape(-1)[: 2 * reach * (stride + 1) + 1]
