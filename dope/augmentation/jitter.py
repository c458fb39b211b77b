"""Colour jitter as a whole, loss of colour, and blur, as SimSiam and its relatives have them; all off by default.

Chen and He, Exploring Simple Siamese Representation Learning, CVPR 2021, appendix A; the jitter is
torchvision.transforms.ColorJitter's, whose four changes come in a random order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import permutations

import torch
import torch.nn.functional as F
from torch import Tensor

from dope.augmentation import colour
from dope.augmentation.config import AugmentationConfig
from dope.augmentation.draws import Draws, rows_where

OPERATIONS = ("brightness", "contrast", "saturation", "hue")
FUNCTIONS = (colour.adjust_brightness, colour.adjust_contrast, colour.adjust_saturation, colour.adjust_hue)
ORDERS = tuple(permutations(range(len(OPERATIONS))))
COLUMNS = 5 + len(OPERATIONS)
REACH = 3.0  # standard deviations to either side that the kernel of the widest blur holds


@dataclass(frozen=True)
class JitterPlan:
    """What is done to each of n views.

    Attributes:
        chosen: (n,) bool, whether its colours jitter.
        order: (n, 4) long, places in `OPERATIONS`, the first change first.
        amounts: (n, 4), how far each of `OPERATIONS` goes.
        grey: (n,) bool, whether it loses its colour.
        blurred: (n,) bool.
        kernels: (n, 2 * radius + 1) float32 of sum 1, the same along x and y.
    """

    chosen: Tensor
    order: Tensor
    amounts: Tensor
    grey: Tensor
    blurred: Tensor
    kernels: Tensor


def is_on(config: AugmentationConfig) -> bool:
    """Whether any of it can happen."""
    return config.jitter_p > 0 or config.grey_p > 0 or config.blur_p > 0


def draw_jitter(draws: Draws, config: AugmentationConfig, unit: float) -> JitterPlan:
    """Draw it all; `unit` is what a pixel of the settings is on these images."""
    chosen, number = draws.chance(config.jitter_p), draws.integer((0, len(ORDERS) - 1))
    *factors, turns = config.jitter
    bounds = [(max(0.0, 1 - reach), 1 + reach) for reach in factors] + [(-turns, turns)]
    amounts = torch.stack([draws.uniform(bound) for bound in bounds], 1)
    grey, blurred = draws.chance(config.grey_p), draws.chance(config.blur_p)
    sigma = draws.uniform(config.blur_px) * unit
    radius = max(1, math.ceil(REACH * config.blur_px[1] * unit))
    offsets = torch.arange(-radius, radius + 1, device=sigma.device)
    kernels = torch.exp(-0.5 * (offsets / sigma[:, None]).square())
    order = torch.tensor(ORDERS, device=number.device)[number]
    return JitterPlan(chosen, order, amounts, grey, blurred, kernels / kernels.sum(1, keepdim=True))


def change_colours(images: Tensor, plan: JitterPlan) -> None:
    """Jitter, take colour away and blur the float images (n, 3, H, W) that were chosen for it, in place."""
    for position in range(len(OPERATIONS)):
        for number, function in enumerate(FUNCTIONS):
            rows = rows_where(plan.chosen & (plan.order[:, position] == number))
            if rows is not None:
                some = images[rows]
                function(some, plan.amounts[rows, number])
                images[rows] = some
    rows = rows_where(plan.grey)
    if rows is not None:
        some = images[rows]
        colour.adjust_saturation(some, some.new_zeros(len(some)))
        images[rows] = some
    rows = rows_where(plan.blurred)
    if rows is not None:
        images[rows] = blur(images[rows], plan.kernels[rows])


def blur(images: Tensor, kernels: Tensor) -> Tensor:
    """Images (n, C, H, W) filtered along x and y, each by its own kernel (n, k); borders are mirrored."""
    (n, channels), radius = images.shape[:2], kernels.shape[1] // 2
    weights = kernels.repeat_interleave(channels, 0)[:, None]  # (n * C, 1, k)
    flat = F.pad(images, (radius, radius, radius, radius), "reflect").flatten(0, 1)[None]
    flat = F.conv2d(flat, weights[:, :, None], groups=n * channels)
    return F.conv2d(flat, weights[..., None], groups=n * channels)[0].unflatten(0, (n, channels))
