"""All augmentation of single views; pairs are two lists of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dope.augmentation import background, colour, geometry, jitter, on_cpu
from dope.augmentation.config import AugmentationConfig
from dope.augmentation.draws import WHOLE, Draws, Share, rows_where, uniform_rows

COLUMNS = 1 + colour.COLUMNS + geometry.COLUMNS + background.COLUMNS


def columns(config: AugmentationConfig) -> int:
    """How many numbers are drawn for a view; what is off takes none, so that it changes nothing of the others."""
    return COLUMNS + (jitter.COLUMNS if jitter.is_on(config) else 0)


@dataclass(frozen=True)
class ViewPlan:
    """What is to be done to each of n views.

    Attributes:
        flip: (n,) bool, mirrored first.
        colours: changes of the whole view's colours.
        jitter: further ones after these, or None.
        remove: (n,) bool, whether the background is replaced by `backgrounds`, with windows of the field `noise`.
        boxes: (n, 4) left, top, right and bottom edges of the mirrored objects.
        moved: (n,) bool, whether the mirrored object is moved by `moves` (n, 3, 3) with `scales` (n,).
    """

    flip: Tensor
    colours: colour.ColourPlan
    remove: Tensor
    backgrounds: background.BackgroundPlan
    noise: Tensor | None
    boxes: Tensor
    moved: Tensor
    moves: Tensor
    scales: Tensor
    jitter: jitter.JitterPlan | None = None


@torch.no_grad()
def augment_images(
    images: Tensor, masks: Tensor, config: AugmentationConfig, generator: torch.Generator, share: Share = WHOLE
) -> tuple[Tensor, Tensor]:
    """Augment views that come alone: each loses its background with `config.single_background_p`.

    Args:
        images: (B, 3, H, W) uint8, or float in [0, 1].
        masks: (B, 1, H, W) bool. A view with an empty mask keeps its background.
        config: probabilities and ranges; `background_removal` "off" keeps every background.
        generator: the result is a function of it and of the inputs.
        share: which part of the global batch this is, where other ranks hold the others.

    Returns:
        images (B, 3, H, W) float32 in [0, 1] and masks (B, 1, H, W) bool.
    """
    draws = Draws(uniform_rows(len(images), 1 + columns(config), generator, images.device, share))
    remove = draws.chance(config.single_background_p) & (config.background_removal != "off")
    new_images, new_masks, _ = augment_views([images], masks, remove, config, draws, generator)
    return new_images, new_masks


@torch.no_grad()
def augment_views(
    images: Sequence[Tensor],
    masks: Tensor,
    remove: Tensor,
    config: AugmentationConfig,
    draws: Draws,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Change colours, flip, and where `remove` (n,): move the object and paint a new background.

    Args:
        images: (b, 3, H, W) each, of n views in all.
        masks: (n, 1, H, W) bool.
        draws: holds `columns(config)` numbers a view; all that is drawn for a view comes from them.
        generator: of the noise that all views share.

    Returns:
        images (n, 3, H, W) float32, masks (n, 1, H, W) bool, and the matrices (n, 3, 3) that map points of the old
        views to the new ones.
    """
    height, width = masks.shape[-2:]
    flip = draws.chance(config.flip_p)
    colours = colour.draw_colour(draws, config)
    backgrounds = background.draw_backgrounds(draws, config)
    noise = None
    if config.noise > 0 and config.noise_p > 0 and config.background_removal != "off":
        noise = background.noise_field(config.noise, height, width, generator, masks.device)

    masks = mirrored(masks, flip)
    boxes, present = geometry.bounding_boxes(masks)
    remove = remove & present
    moves, moved, scales = geometry.draw_moves(draws, masks, boxes, remove & config.geometry, config)
    unit = min(height, width) / geometry.NOMINAL_PX
    jitters = jitter.draw_jitter(draws, config, unit) if jitter.is_on(config) else None
    plan = ViewPlan(flip, colours, remove, backgrounds, noise, boxes, moved, moves, scales, jitters)
    make = on_cpu.change_views if masks.device.type == "cpu" else change_views
    with torch.autocast(masks.device.type, enabled=False):
        new_images, new_masks = make(images, masks, plan)
        return new_images, new_masks, moves @ geometry.flips(flip, width)


def change_views(images: Sequence[Tensor], masks: Tensor, plan: ViewPlan) -> tuple[Tensor, Tensor]:
    """Carry out a plan on all views at a time, as a GPU has it best.

    Args:
        images: (b, 3, H, W) of n views in all, not yet mirrored.
        masks: (n, 1, H, W) bool, mirrored already.

    Returns:
        images (n, 3, H, W) float32 and masks (n, 1, H, W) bool.
    """
    height, width = masks.shape[-2:]
    result, masks = to_float(mirrored(torch.cat(tuple(images)), plan.flip)), masks.clone()
    colour.change_colours(result, plan.colours)
    if plan.jitter is not None:
        jitter.change_colours(result, plan.jitter)
    moving = rows_where(plan.moved)
    if moving is not None:
        result[moving], masks[moving] = geometry.warp(
            result[moving], masks[moving], plan.moves[moving], plan.scales[moving]
        )
    removing = rows_where(plan.remove)
    if removing is not None:
        painted = to_float(background.paint(plan.backgrounds[removing], height, width, plan.noise))
        result[removing] = torch.where(masks[removing], result[removing], painted)
    return result, masks


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
