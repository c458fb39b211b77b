"""Augmentation of view pairs, and the ablation that replaces the second view."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from dope.augmentation.config import AugmentationConfig
from dope.augmentation.draws import WHOLE, Draws, Share, uniform_rows
from dope.augmentation.geometry import transform_points
from dope.augmentation.views import augment_views, columns, to_float
from dope.batch import PairBatch


@torch.no_grad()
def augment(
    batch: PairBatch, config: AugmentationConfig, generator: torch.Generator, share: Share = WHOLE
) -> PairBatch:
    """Augment both views of every pair, each with draws of its own, on the batch's device.

    Background removal is drawn for the pair, from (yes, no), (no, yes) and twice (yes, yes). Points follow the pixels;
    those that leave the image or the object's mask in either view become invalid. A view with an empty mask keeps its
    background and has no valid point.

    Args:
        batch: uint8 images, or float in [0, 1].
        config: probabilities and ranges.
        generator: the result is a function of it and of the batch; it may live on the CPU or on the batch's device.
            On the CPU nothing waits for a GPU to draw.
        share: which part of the global batch this is, where other ranks hold the others; with generators in the same
            state on all ranks, each gets what one process with the whole batch would make of its part.
    """
    uniform = uniform_rows(len(batch), 1 + 2 * columns(config), generator, batch.points.device, share)
    option = (uniform[:, 0] * 4).long()
    remove = torch.cat([option != 1, option != 0]) & (config.background_removal == "paired")
    images, masks, matrices = augment_views(
        [batch.images1, batch.images2],
        torch.cat([batch.masks1, batch.masks2]),
        remove,
        config,
        Draws(torch.cat(uniform[:, 1:].chunk(2, 1))),
        generator,
    )
    points = transform_points(torch.cat([batch.points[..., :2], batch.points[..., 2:]]), matrices)
    visible1, visible2 = on_object(points, masks).chunk(2)
    (images1, images2), (masks1, masks2), (points1, points2) = images.chunk(2), masks.chunk(2), points.chunk(2)
    return replace(
        batch,
        images1=images1,
        images2=images2,
        masks1=masks1,
        masks2=masks2,
        points=torch.cat([points1, points2], -1),
        valid=batch.valid & visible1 & visible2,
    )


def no_augmentation(batch: PairBatch) -> PairBatch:
    """The same batch with float images in [0, 1]."""
    return replace(batch, images1=to_float(batch.images1), images2=to_float(batch.images2))


def duplicate_view(batch: PairBatch) -> PairBatch:
    """Pairs of view 1 with itself: the ablation "one image augmented twice"."""
    return replace(batch, images2=batch.images1, masks2=batch.masks1, points=batch.points[..., :2].repeat(1, 1, 2))


def on_object(points: Tensor, masks: Tensor) -> Tensor:
    """Whether points (n, P, 2) fall on a True pixel of masks (n, 1, H, W): (n, P) bool."""
    height, width = masks.shape[-2:]
    x, y = points.unbind(-1)
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    # NaN and far-off padding must not reach the index
    column, row = (torch.where(inside, v, 0.0).long() for v in (x, y))
    return masks.flatten(1).gather(1, row * width + column) & inside
