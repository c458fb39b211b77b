"""All augmentation of single views; pairs are two lists of them."""

from __future__ import annotations

import torch
from torch import Tensor

from dope.augmentation import background, colour, geometry
from dope.augmentation.config import AugmentationConfig
from dope.augmentation.draws import WHOLE, Draws, rows_where, uniform_rows

PIXELS_AT_ONCE = 1 << 16  # on CPUs: so few views at a time stay in the cache between operations, one of 224 px
COLUMNS = 1 + colour.COLUMNS + geometry.COLUMNS + background.COLUMNS


@torch.no_grad()
def augment_images(
    images: Tensor, masks: Tensor, config: AugmentationConfig, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Augment views that come alone: each loses its background with `config.single_background_p`.

    Args:
        images: (B, 3, H, W) uint8, or float in [0, 1].
        masks: (B, 1, H, W) bool. A view with an empty mask keeps its background.
        config: probabilities and ranges; `background_removal` "off" keeps every background.
        generator: the result is a function of it and of the inputs.

    Returns:
        images (B, 3, H, W) float32 in [0, 1] and masks (B, 1, H, W) bool.
    """
    draws = Draws(uniform_rows(len(images), 1 + COLUMNS, generator, images.device, WHOLE))
    remove = draws.chance(config.single_background_p) & (config.background_removal != "off")
    new_images, new_masks, _ = augment_views(images, masks, remove, config, draws, generator)
    return new_images, new_masks


@torch.no_grad()
def augment_views(
    images: Tensor,
    masks: Tensor,
    remove: Tensor,
    config: AugmentationConfig,
    draws: Draws,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Change colours, flip, and where `remove` (n,): move the object and paint a new background.

    Args:
        draws: holds `COLUMNS` numbers a view; all that is drawn for a view comes from them.
        generator: of the noise that all views share.

    Returns:
        images (n, 3, H, W) float32, masks (n, 1, H, W) bool, and the matrices (n, 3, 3) that map points of the old
        views to the new ones.
    """
    n, _, height, width = images.shape
    flip = draws.chance(config.flip_p)
    colours = colour.draw_colour(draws, config)
    backgrounds = background.draw_backgrounds(draws, config)
    noise = None
    if config.noise > 0 and config.noise_p > 0 and config.background_removal != "off":
        noise = background.noise_field(config.noise, height, width, generator, images.device)

    masks = mirrored(masks, flip)
    boxes, present = geometry.bounding_boxes(masks)
    remove = remove & present
    moves, moved, scales = geometry.draw_moves(draws, masks, boxes, remove & config.geometry, config)

    result = torch.empty(images.shape, dtype=torch.float32, device=images.device)
    at_once = n if images.is_cuda else max(1, PIXELS_AT_ONCE // (height * width))
    with torch.autocast(images.device.type, enabled=False):
        for start in range(0, n, at_once):
            rows = slice(start, start + at_once)
            part, mask = result[rows], masks[rows]
            part.copy_(to_float(mirrored(images[rows], flip[rows])))
            colour.change_colours(part, colours[rows])
            moving = rows_where(moved[rows])
            if isinstance(moving, slice):
                geometry.warp(part, mask, boxes[rows], moves[rows], scales[rows])
            elif moving is not None:
                some, its = part[moving], mask[moving]
                geometry.warp(some, its, boxes[rows][moving], moves[rows][moving], scales[rows][moving])
                part[moving], mask[moving] = some, its
            removing = rows_where(remove[rows])
            if removing is not None:
                painted = to_float(background.paint(backgrounds[rows][removing], height, width, noise))
                part[removing] = torch.where(mask[removing], part[removing], painted)
        matrices = moves @ geometry.flips(flip, width)
    return result, masks, matrices


def mirrored(images: Tensor, chosen: Tensor) -> Tensor:
    """Images (n, C, H, W) with those mirrored that are `chosen` (n,); a copy where any is."""
    rows = rows_where(chosen)
    if rows is None:
        return images
    if isinstance(rows, slice):
        return images.flip(-1)
    images = images.clone()
    images[rows] = images[rows].flip(-1)
    return images


def to_float(images: Tensor) -> Tensor:
    """uint8 images as float32 in [0, 1]; a copy of float images."""
    return images.to(torch.float32, copy=True) if images.is_floating_point() else images.float().div_(255)
