"""How weights start."""

from __future__ import annotations

import math

from torch import nn


def init_encoder(module: nn.Module) -> None:
    """Set convolutions to N(0, sqrt(2 / (k * k * out))) with zero bias and BatchNorm to weight 1, bias 0, in place."""
    for part in module.modules():
        if isinstance(part, nn.Conv2d):
            fan_out = part.kernel_size[0] * part.kernel_size[1] * part.out_channels
            nn.init.normal_(part.weight, std=math.sqrt(2 / fan_out))
            if part.bias is not None:
                nn.init.zeros_(part.bias)
        elif isinstance(part, nn.BatchNorm2d):
            nn.init.ones_(part.weight)
            nn.init.zeros_(part.bias)
