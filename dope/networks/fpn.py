"""A feature pyramid and the branches that merge it into one map at stride 4.

Pyramid: Lin et al., CVPR 2017. Merging branches: Kirillov et al., Panoptic Feature Pyramid Networks, CVPR 2019,
with BatchNorm in place of GroupNorm.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor, nn


class FeaturePyramid(nn.Module):
    """Bring backbone stages of strides 4, 8, 16, 32 to `channels` each, coarse context added to the finer ones."""

    def __init__(self, inputs: Sequence[int], channels: int) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(nn.Conv2d(c, channels, 1) for c in inputs)
        self.output = nn.ModuleList(nn.Conv2d(channels, channels, 3, padding=1) for _ in inputs)

    def forward(self, stages: Sequence[Tensor]) -> list[Tensor]:
        """Map stages, finest first, to maps of the same sizes with `channels` channels."""
        merged = [lateral(stage) for lateral, stage in zip(self.lateral, stages, strict=True)]
        for i in range(len(merged) - 2, -1, -1):
            merged[i] = merged[i].add_(F.interpolate(merged[i + 1], scale_factor=2.0, mode="nearest"))
        return [output(x) for output, x in zip(self.output, merged, strict=True)]


class MergeBranch(nn.Module):
    """`blocks` times 3x3 convolution, BatchNorm, ReLU, each followed by bilinear x2 where `upsample`."""

    def __init__(self, channels: int, blocks: int, *, upsample: bool) -> None:
        super().__init__()
        self.upsample = upsample
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels), nn.ReLU(inplace=True)
            )
            for _ in range(blocks)
        )

    def forward(self, x: Tensor) -> Tensor:
        for block in self.blocks:
            x = block(x)
            if self.upsample:
                x = F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
        return x


class PanopticMerge(nn.Module):
    """Sum the pyramid's four maps at stride 4: three blocks there, and one block a doubling of the coarser ones."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.branches = nn.ModuleList(
            [MergeBranch(channels, 3, upsample=False)]
            + [MergeBranch(channels, doublings, upsample=True) for doublings in (1, 2, 3)]
        )

    def forward(self, pyramid: Sequence[Tensor]) -> Tensor:
        """Map four maps at strides 4, 8, 16, 32 to one at stride 4."""
        maps = [branch(x) for branch, x in zip(self.branches, pyramid, strict=True)]
        return (maps[0] + maps[1]).add_(maps[2]).add_(maps[3])  # the maps themselves, ReLU needs again
