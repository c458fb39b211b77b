"""What a network in training makes of a few held-out pairs: a point of view 1 found in view 2, and both masks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray

from dope.batch import PairBatch
from dope.figures.drawing import Image, Row, contact_sheet, over, put_marker
from dope.figures.heatmap import Point, best_place, heat_maps, similarities
from dope.figures.maps import Describer, describe

COLUMNS = ("view 1: a point", "view 2: its true place", "similarity, best place", "mask of view 1", "mask of view 2")
LABEL = 24  # characters of a sample's key that are shown


def held_out_sheet(
    network: Describer,
    batches: Iterable[PairBatch],
    pairs: int,
    *,
    title: str = "",
    device: torch.device | str = "cpu",
) -> Image | None:
    """Draw the first pairs that have a correspondence, always at their first point, so that sheets can be compared.

    Args:
        network: in eval mode.
        batches: as the loader makes them: uint8 images, points in pixels.
        pairs: how many.
        title: of the sheet.
        device: where the network is.

    Returns:
        (H, W, 3) uint8 RGB, or None where there is no such pair.
    """
    rows = [_row(network, *pair, device) for pair in islice(_pairs(batches), pairs)]
    return contact_sheet(rows, title=title, columns=COLUMNS) if rows else None


def _pairs(batches: Iterable[PairBatch]) -> Iterator[tuple[str, list[Image], Point, Point]]:
    """Key, both photos, and the places in both of the first correspondence."""
    for batch in batches:
        for i in range(len(batch)):
            if batch.valid[i].any():
                x1, y1, x2, y2 = batch.points[i][batch.valid[i]][0].tolist()
                yield batch.keys[i], [_photo(batch.images1[i]), _photo(batch.images2[i])], (x1, y1), (x2, y2)


def _photo(image: torch.Tensor) -> Image:
    return np.ascontiguousarray(image.permute(1, 2, 0).cpu().numpy())


def _row(
    network: Describer, key: str, photos: list[Image], point: Point, truth: Point, device: torch.device | str
) -> Row:
    maps = describe(network, photos, device=device)
    similarity = similarities(maps, point)
    found = best_place(similarity[1])
    tiles = [
        put_marker(photos[0], point),
        put_marker(photos[1], truth),
        put_marker(heat_maps(maps, similarity)[0][1], found),
        *(_cut_out(view.photo, view.mask) for view in maps),
    ]
    return Row(f"{key[-LABEL:]}\noff by {math.dist(found, truth):.0f} px", tiles)


def _cut_out(photo: Image, mask: NDArray[np.floating]) -> Image:
    """The photo where the soft mask (H, W) in [0, 1] says object, white elsewhere."""
    return over(np.full_like(photo, 255), photo / 255, mask)
