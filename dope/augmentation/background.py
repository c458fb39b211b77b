"""New backgrounds: one colour or a gradient of two, with or without 8-bit noise."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from dope.augmentation.config import AugmentationConfig
from dope.augmentation.draws import Draws, on_device, rows_where

COLUMNS = 11


@dataclass(frozen=True)
class BackgroundPlan:
    """What each of n views gets in place of its background.

    Attributes:
        first, second: (n, 3) colours in 0 to 255.
        horizontal: (n,) bool, whether the gradient runs along x.
        noisy: (n,) bool, whether there is noise.
        corner: (n, 2) in [0, 1), where the view's noise begins in the field, down and to the right.
    """

    first: Tensor
    second: Tensor
    horizontal: Tensor
    noisy: Tensor
    corner: Tensor

    def __getitem__(self, rows: slice | Tensor) -> BackgroundPlan:
        return BackgroundPlan(*(getattr(self, field.name)[rows] for field in fields(self)))


def draw_backgrounds(draws: Draws, config: AugmentationConfig) -> BackgroundPlan:
    """Draw colours and kinds."""
    first = torch.stack([draws.integer((0, 255)) for _ in range(3)], 1).float()
    second = torch.stack([draws.integer((0, 255)) for _ in range(3)], 1).float()
    one_colour = draws.chance(config.one_colour_p)
    second = torch.where(one_colour[:, None], first, second)
    horizontal, noisy = draws.chance(0.5), draws.chance(config.noise_p)
    corner = torch.stack([draws.uniform((0.0, 1.0)), draws.uniform((0.0, 1.0))], 1)
    return BackgroundPlan(first, second, horizontal, noisy, corner)


def noise_field(noise: int, height: int, width: int, generator: torch.Generator, device: torch.device) -> Tensor:
    """Differences U{0..noise-1} - U{0..noise-1} of bytes with wrap-around, (3, H, W) uint8.

    One field serves all views of a step, each from a corner of its own on and round its edges: a pixel's noise has the
    same distribution as if every view had its own field, for a fraction of the numbers, and all ranks can draw the
    same one.
    """
    on_it = on_device(generator, device)
    shape = (2, 3, height, width)
    plus, minus = torch.randint(noise, shape, dtype=torch.uint8, generator=on_it, device=device)
    return plus.sub_(minus)


def corners(plan: BackgroundPlan, height: int, width: int) -> Tensor:
    """Row and column (n, 2) of the field at which each view's noise begins."""
    return (plan.corner * torch.tensor([height, width], device=plan.corner.device)).long()


def paint(plan: BackgroundPlan, height: int, width: int, field: Tensor | None) -> Tensor:
    """Backgrounds (n, 3, H, W) uint8; the noise of `field` wraps around at 0 and 255."""
    device, n = plan.first.device, len(plan.first)
    x, y = (torch.linspace(0, 1, side, device=device) for side in (width, height))
    first, step = plan.first[:, :, None], (plan.second - plan.first)[:, :, None]
    across = torch.addcmul(first, step, x).to(torch.uint8)[:, :, None].expand(n, 3, height, width)
    down = torch.addcmul(first, step, y).to(torch.uint8)[..., None].expand(n, 3, height, width)
    horizontal = rows_where(plan.horizontal)
    painted = across if isinstance(horizontal, slice) else down
    if isinstance(horizontal, Tensor):
        painted = torch.where(plan.horizontal[:, None, None, None], across, down)
    rows = rows_where(plan.noisy)
    if field is None or rows is None:
        return painted
    # (3, places down, places across, H, W), a view
    windows = field.repeat(1, 2, 2).unfold(1, height, 1).unfold(2, width, 1)
    top, left = corners(plan, height, width)[rows].unbind(1)
    noise = windows[:, top, left].transpose(0, 1)
    if isinstance(rows, slice):
        return painted + noise
    painted = painted.clone()
    painted[rows] += noise
    return painted
