"""New backgrounds: one colour or a gradient of two, with or without 8-bit noise."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from dope.augmentation.config import AugmentationConfig
from dope.augmentation.draws import Draws

COLUMNS = 9


@dataclass(frozen=True)
class BackgroundPlan:
    """For each view: two colours (n, 3) in 0 to 255, whether the gradient runs along x, and whether there is noise."""

    first: Tensor
    second: Tensor
    horizontal: Tensor
    noisy: Tensor

    def __getitem__(self, rows: slice | Tensor) -> BackgroundPlan:
        return BackgroundPlan(*(getattr(self, field.name)[rows] for field in fields(self)))


def draw_backgrounds(draws: Draws, config: AugmentationConfig) -> BackgroundPlan:
    """Draw colours and kinds."""
    first = torch.stack([draws.integer((0, 255)) for _ in range(3)], 1).float()
    second = torch.stack([draws.integer((0, 255)) for _ in range(3)], 1).float()
    one_colour = draws.chance(config.one_colour_p)
    second = torch.where(one_colour[:, None], first, second)
    return BackgroundPlan(first, second, draws.chance(0.5), draws.chance(config.noise_p))


def paint(plan: BackgroundPlan, height: int, width: int, noise: int, generator: torch.Generator) -> Tensor:
    """Backgrounds (n, 3, H, W) uint8; the noise, U{0..noise-1} - U{0..noise-1}, wraps around at 0 and 255."""
    device = plan.first.device
    x = torch.linspace(0, 1, width, device=device).expand(height, width)
    y = torch.linspace(0, 1, height, device=device)[:, None].expand(height, width)
    ramp = torch.where(plan.horizontal[:, None, None], x, y)[:, None]
    first, second = plan.first[:, :, None, None], plan.second[:, :, None, None]
    painted = torch.addcmul(first, second - first, ramp).to(torch.uint8)
    rows = plan.noisy.nonzero()[:, 0]
    if len(rows) and noise > 0:
        shape = (2, len(rows), 3, height, width)
        plus, minus = torch.randint(noise, shape, dtype=torch.uint8, generator=generator, device=device)
        painted[rows] += plus - minus
    return painted
