"""Farthest point ordering of pixels: any prefix of the order is spread evenly over the object.

The exact greedy algorithm (Gonzalez, 1985; Eldar et al., 1997). On a pixel grid the distances to one pixel are a window
of one constant table, and a new pixel can only bring nearer what lies within the current largest distance, so a step is
one `np.minimum` on a small window and one `argmax`.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray


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
    flat = rows * width + columns
    distance = np.full((height, width), -1, dtype=np.int32)  # squared, to the nearest chosen pixel; -1: not a candidate
    by_place = distance.reshape(-1)
    by_place[flat] = farthest = np.iinfo(np.int32).max
    origin = 1 << max(width, height, 2).bit_length()
    table = _squared_distances(origin)

    chosen = np.empty(n, dtype=np.intp)
    place = int(flat[start])
    for k in range(n):
        chosen[k] = place
        y, x = divmod(place, width)
        reach = math.isqrt(min(int(farthest), origin * origin * 2)) + 1
        top, bottom = max(0, y - reach), min(height, y + reach + 1)
        left, right = max(0, x - reach), min(width, x + reach + 1)
        window = distance[top:bottom, left:right]
        np.minimum(
            window, table[origin + top - y : origin + bottom - y, origin + left - x : origin + right - x], out=window
        )
        by_place[place] = -1  # never again
        place = int(by_place.argmax())
        farthest = by_place[place]
    index = np.empty(height * width, dtype=np.intp)
    index[flat] = np.arange(len(pixels))
    return index[chosen]


@functools.lru_cache(maxsize=4)
def _squared_distances(reach: int) -> NDArray[np.int32]:
    """(2 reach + 1, 2 reach + 1): dx^2 + dy^2 from the centre [reach, reach]."""
    d = np.arange(-reach, reach + 1, dtype=np.int32) ** 2
    return d[:, None] + d[None, :]
