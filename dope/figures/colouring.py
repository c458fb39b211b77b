"""Colours carried from view to view by the descriptors: the same part keeps its colour where they have learnt it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dope.common.errors import BadInput
from dope.figures.drawing import Image, Row, contact_sheet, dimmed, over, write_png
from dope.figures.maps import Describer, DescriptorMap, describe

Colours = Literal["position", "pca"]

_CORNERS = np.array([[0.10, 0.45, 0.95], [0.95, 0.20, 0.55], [0.05, 0.80, 0.45], [1.00, 0.80, 0.10]])
_SIMILARITIES = 1 << 19  # computed at once: 2 MiB, so that the maximum is taken within a CPU's cache
_PER_CELL = 2  # reference points in each direction of a feature cell: finer ones change no colour that an eye can tell


def correspondence_colouring(
    network: Describer,
    photos: Sequence[Image],
    out: Path,
    *,
    masks: Sequence[NDArray[np.bool_]] | None = None,
    reference: int = 0,
    colours: Colours = "position",
    names: Sequence[str] = (),
    title: str = "Dense correspondences",
    subtitle: str = "",
    image_size: int | None = None,
    device: torch.device | str = "cpu",
) -> list[NDArray[np.float32]]:
    """Colour the object in one view, carry the colours to the others by nearest descriptor, and write a sheet.

    Rows: the photos; the first three principal components of the descriptors; the carried colours.

    Args:
        network: in eval mode.
        photos: (H, W, 3) uint8 RGB, all of one size.
        out: the PNG to write.
        masks: (H, W) bool each; None uses the predicted soft masks.
        reference: which photo the colours come from.
        colours: of the reference, by position in the view or by principal components.
        names: a label for each photo.
        title, subtitle: of the sheet.
        image_size: side in pixels that the network was trained with.
        device: where the network is.

    Returns:
        The carried colours of each view, (H, W, 3) in [0, 1]; those of the reference are its own.

    Raises:
        BadInput: there is no object in the reference view.
        UsageError: `out` is no PNG.
    """
    maps = describe(network, photos, masks, image_size=image_size, device=device)
    if not maps[reference].object.any():
        name = names[reference] if names else f"view {reference}"
        what = "the network sees no object in the reference view" if masks is None else "the reference mask is empty"
        raise BadInput(what, where=name, remedy="Choose another view, or --masks given")
    components = principal_components(maps)
    own = components[reference] if colours == "pca" else position_colours(maps[reference].object)
    carried = carry_colours(maps, reference, own)
    marked = ["reference" if i == reference else "" for i in range(len(maps))]
    columns = [" ".join(filter(None, parts)) for parts in zip(names or [""] * len(maps), marked, strict=True)]
    rows = [
        Row("photos", [view.photo for view in maps]),
        Row("descriptors\n(principal\ncomponents)", _painted(maps, components)),
        Row("colours of\nthe reference,\ncarried over", _painted(maps, carried)),
    ]
    write_png(out, contact_sheet(rows, title=title, subtitle=subtitle, columns=columns))
    return carried


def principal_components(maps: Sequence[DescriptorMap]) -> list[NDArray[np.float32]]:
    """The first three principal components of all objects' descriptors as colours (H, W, 3) in [0, 1]; 0 elsewhere.

    Components are fitted to the object's cells of all views together, so that colours compare across views.
    """
    fitted = torch.cat([view.at_pixels(_on_grid(view.object, *view.units.shape[1:])) for view in maps])
    mean = fitted.mean(0)
    # at least three rows and columns, so that three components exist
    padded = torch.nn.functional.pad(fitted - mean, (0, max(0, 3 - fitted.shape[1]), 0, max(0, 3 - len(fitted))))
    basis = torch.linalg.svd(padded.double(), full_matrices=False)[2][:3, : fitted.shape[1]].to(fitted.dtype)
    largest = basis.gather(1, basis.abs().argmax(1, keepdim=True))
    basis = basis * torch.where(largest < 0, -1.0, 1.0)  # a sign that does not depend on the solver
    projected = ((fitted - mean) @ basis.T).cpu().numpy()
    low, high = np.percentile(projected, [2, 98], axis=0).astype(np.float32)
    result = []
    for view in maps:
        image = np.zeros((*view.mask.shape, 3), np.float32)
        values = ((view.at_pixels(view.mask > 0) - mean) @ basis.T).cpu().numpy()
        image[view.mask > 0] = np.clip((values - low) / np.maximum(high - low, 1e-6), 0, 1)
        result.append(image)
    return result


def position_colours(where: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Colours (H, W, 3) in [0, 1] that change smoothly over the bounding box of `where`, no two places alike."""
    rows, columns = np.nonzero(where.any(1))[0], np.nonzero(where.any(0))[0]
    y = np.interp(np.arange(where.shape[0]), [rows[0], rows[-1] + 1e-3], [0, 1])[:, None, None]
    x = np.interp(np.arange(where.shape[1]), [columns[0], columns[-1] + 1e-3], [0, 1])[None, :, None]
    top_left, top_right, bottom_left, bottom_right = _CORNERS
    top, bottom = (1 - x) * top_left + x * top_right, (1 - x) * bottom_left + x * bottom_right
    return ((1 - y) * top + y * bottom).astype(np.float32)


@torch.inference_mode()
def carry_colours(
    maps: Sequence[DescriptorMap], reference: int, colours: NDArray[np.float32]
) -> list[NDArray[np.float32]]:
    """Each view's pixels take the colour of the nearest descriptor of the reference's object: (H, W, 3) each."""
    source = maps[reference]
    height, width = (_PER_CELL * side for side in source.units.shape[1:])
    where = _on_grid(source.object, height, width)
    palette = torch.from_numpy(cv2.resize(colours, (width, height), interpolation=cv2.INTER_AREA)[where])
    known = source.at_pixels(where)
    result = []
    for i, view in enumerate(maps):
        image = np.zeros_like(colours)
        if i == reference:
            image = colours.copy()
        elif (view.mask > 0).any():
            image[view.mask > 0] = palette[nearest(view.at_pixels(view.mask > 0), known).cpu()].numpy()
        result.append(image)
    return result


def nearest(descriptors: Tensor, known: Tensor) -> Tensor:
    """For each unit descriptor (N, D) the index (N,) of the one of `known` (M, D) with the greatest cosine."""
    step = max(1, _SIMILARITIES // len(known))
    buffer = known.new_empty(step, len(known))
    parts = descriptors.split(step)
    return torch.cat([torch.mm(part, known.T, out=buffer[: len(part)]).argmax(1) for part in parts])


def _on_grid(where: NDArray[np.bool_], height: int, width: int) -> NDArray[np.bool_]:
    """A mask on a coarser grid: cells mostly covered, or else (a very small object) touched at all."""
    share = cv2.resize(where.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return share >= 0.5 if (share >= 0.5).any() else share > 0


def _painted(maps: Sequence[DescriptorMap], colours: Sequence[NDArray[np.float32]]) -> list[Image]:
    return [over(dimmed(view.photo), image, view.mask) for view, image in zip(maps, colours, strict=True)]
