"""Colour changes of float images in [0, 1], each with an amount for each image; they work in place.

Each is torchvision.transforms.functional's of the same name: hue is a shift in HSV, saturation and contrast blend with
the grey image and its mean, and every change is clamped to [0, 1] by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dope.augmentation.config import AugmentationConfig
from dope.augmentation.draws import Draws, rows_where

GREY = (0.2989, 0.587, 0.114)  # ITU-R BT.601, as torchvision rounds it
OPERATIONS = ("hue", "saturation", "brightness", "gamma", "contrast")  # in the order of application
COLUMNS = 2 * len(OPERATIONS)


@dataclass(frozen=True)
class ColourPlan:
    """For each operation and view: whether (5, n) bool, and by how much (5, n)."""

    chosen: Tensor
    amount: Tensor

    def __getitem__(self, rows: slice) -> ColourPlan:
        return ColourPlan(self.chosen[:, rows], self.amount[:, rows])


def draw_colour(draws: Draws, config: AugmentationConfig) -> ColourPlan:
    """Draw each operation's choice and amount."""
    chosen = torch.stack([draws.chance(config.colour_p) for _ in OPERATIONS])
    return ColourPlan(chosen, torch.stack([draws.uniform(getattr(config, name)) for name in OPERATIONS]))


def change_colours(images: Tensor, plan: ColourPlan) -> None:
    """Apply each operation to the images (n, 3, H, W) that were chosen for it, in place."""
    for operation, chosen, amount in zip(FUNCTIONS, plan.chosen, plan.amount, strict=True):
        rows = rows_where(chosen)
        if isinstance(rows, slice):
            operation(images, amount)
        elif rows is not None:
            some = images[rows]
            operation(some, amount[rows])
            images[rows] = some


def adjust_hue(images: Tensor, turns: Tensor) -> None:
    """Turn the hue of (n, 3, H, W) by `turns` (n,) of the colour circle; value and HSV saturation stay."""
    red, green, blue = images.unbind(1)
    value = torch.maximum(torch.maximum(red, green), blue)
    chroma = value - torch.minimum(torch.minimum(red, green), blue)
    inverse = chroma.clamp(min=1e-8).reciprocal_()
    # hue in sixths of a turn: red 0, green 2, blue 4
    hue = torch.where(
        value == red,
        (green - blue).mul_(inverse),
        torch.where(value == green, (blue - red).mul_(inverse).add_(2), (red - green).mul_(inverse).add_(4)),
    )
    hue.add_(6 * turns[:, None, None])
    # a channel has the full value within a sixth to either side of its own hue, none of the chroma beyond two sixths
    for channel, centre in zip((red, green, blue), (0.0, 2.0, 4.0), strict=True):
        away = hue.sub(centre)
        away.sub_(away.div(6).round_().mul_(6)).abs_()  # distance on the circle, 0 to 3
        channel.copy_(value).sub_(away.sub_(1).clamp_(0, 1).mul_(chroma))


def adjust_saturation(images: Tensor, factor: Tensor) -> None:
    """Blend with the grey image: (1 - factor) * grey + factor * image."""
    weight = factor[:, None, None, None]
    grey = _grey(images)[:, None].mul_(1 - weight)
    images.mul_(weight).add_(grey).clamp_(0, 1)


def adjust_brightness(images: Tensor, factor: Tensor) -> None:
    """Multiply by factor."""
    images.mul_(factor[:, None, None, None]).clamp_(0, 1)


def adjust_gamma(images: Tensor, gamma: Tensor) -> None:
    """Raise to the power gamma."""
    # log and exp are vectorised on CPUs, pow with an exponent for each image less so; log(0) = -inf becomes 0 again
    images.log_().mul_(gamma[:, None, None, None]).exp_()


def adjust_contrast(images: Tensor, factor: Tensor) -> None:
    """Blend with the mean of the grey image: (1 - factor) * mean + factor * image."""
    mean = _grey(images).mean((1, 2))
    images.mul_(factor[:, None, None, None]).add_((mean * (1 - factor))[:, None, None, None]).clamp_(0, 1)


def _grey(images: Tensor) -> Tensor:
    red, green, blue = images.unbind(1)
    return (red * GREY[0]).add_(green, alpha=GREY[1]).add_(blue, alpha=GREY[2])


FUNCTIONS = (adjust_hue, adjust_saturation, adjust_brightness, adjust_gamma, adjust_contrast)
