"""Where a point of one view is found again in others: maps of cosine similarity with the best place marked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from dope.common.errors import BadInput, UsageError
from dope.figures.drawing import Image, Row, contact_sheet, dimmed, heat, over, put_marker, write_png
from dope.figures.maps import Describer, DescriptorMap, describe

Point = tuple[float, float]


def similarity_heatmap(
    network: Describer,
    photos: Sequence[Image],
    point: Point | None,
    out: Path,
    *,
    masks: Sequence[NDArray[np.bool_]] | None = None,
    names: Sequence[str] = (),
    title: str = "Where is this point?",
    subtitle: str = "",
    image_size: int | None = None,
    device: torch.device | str = "cpu",
) -> list[Point]:
    """Mark a point in the first view, show how similar every pixel of all views is to it, and mark the best one.

    Args:
        network: in eval mode.
        photos: (H, W, 3) uint8 RGB, all of one size; the first holds the point.
        point: x, y in pixels of the first photo, pixel centres at +0.5; None takes the object's innermost pixel.
        out: the PNG to write.
        masks: (H, W) bool each; None uses the predicted soft masks.
        names: a label for each photo.
        title, subtitle: of the sheet.
        image_size: side in pixels that the network was trained with.
        device: where the network is.

    Returns:
        The point itself and the best place x, y in each other view.

    Raises:
        BadInput: no point was given and the first view shows no object.
        UsageError: the point is outside the photo, or `out` is no PNG.
    """
    maps = describe(network, photos, masks, image_size=image_size, device=device)
    point = innermost(maps[0], names[0] if names else "view 0") if point is None else _inside(point, photos[0])
    similarity = similarities(maps, point)
    best = [point, *(best_place(view) for view in similarity[1:])]
    heated, low, high = heat_maps(maps, similarity)
    found = [float(values[int(y), int(x)]) for values, (x, y) in zip(similarity, best, strict=True)]
    columns = [f"{name} {value:.2f}".strip() for name, value in zip(names or [""] * len(maps), found, strict=True)]
    columns[0] = f"{names[0] if names else ''} query".strip()
    rows = [
        Row(
            "point, and\nwhere it is\nfound", [put_marker(view.photo, xy) for view, xy in zip(maps, best, strict=True)]
        ),
        Row(
            f"similarity\n{low:.2f} (dark) to\n{high:.2f} (bright)",
            [put_marker(tile, xy) for tile, xy in zip(heated, best, strict=True)],
        ),
    ]
    write_png(out, contact_sheet(rows, title=title, subtitle=subtitle, columns=columns))
    return best


@torch.inference_mode()
def similarities(maps: Sequence[DescriptorMap], point: Point) -> list[NDArray[np.float32]]:
    """Cosine of every pixel's descriptor with that of `point` in the first view, times the mask: (H, W) each."""
    height, width = maps[0].photo.shape[:2]
    place = torch.tensor([[[[2 * point[0] / width - 1, 2 * point[1] / height - 1]]]], device=maps[0].units.device)
    sampled = F.grid_sample(maps[0].units[None], place.float(), padding_mode="border", align_corners=False)
    query = F.normalize(sampled[0, :, 0, 0], dim=0)
    return [(view.upsampled(*view.mask.shape) @ query).cpu().numpy() * view.mask for view in maps]


def heat_maps(
    maps: Sequence[DescriptorMap], similarity: Sequence[NDArray[np.floating]]
) -> tuple[list[Image], float, float]:
    """Similarities (H, W) in colours over the dimmed photos, on one scale, and the ends of that scale."""
    on_object = np.concatenate([values[view.object] for values, view in zip(similarity, maps, strict=True)])
    low, high = np.percentile(on_object, [2, 100]).tolist() if len(on_object) else (0.0, 1.0)
    heated = [
        over(dimmed(view.photo), heat((values - low) / max(high - low, 1e-6)), 0.9 * view.mask)
        for view, values in zip(maps, similarity, strict=True)
    ]
    return heated, low, high


def innermost(view: DescriptorMap, name: str) -> Point:
    """The object's pixel farthest from its border. Raises `BadInput` where there is no object."""
    if not view.object.any():
        remedy = "Give --point, choose another view, or --masks given"
        raise BadInput("no object is seen in the view that should hold the point", where=name, remedy=remedy)
    padded = np.pad(view.object.astype(np.uint8), 1)
    return best_place(cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1])


def best_place(values: NDArray[Any]) -> Point:
    """x, y of the highest of the values (H, W), pixel centres at +0.5."""
    row, column = np.unravel_index(int(values.argmax()), values.shape)
    return float(column) + 0.5, float(row) + 0.5


def _inside(point: Point, photo: Image) -> Point:
    height, width = photo.shape[:2]
    if not (0 <= point[0] < width and 0 <= point[1] < height):
        raise UsageError(f"{point[0]:g},{point[1]:g} lies outside the view of {width}x{height} px", where="--point")
    return point
