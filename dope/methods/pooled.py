"""One vector an image: a ResNet-18 and the mean over its last stage's grid, as the paper's baselines have it."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dope.lowshot.embedding import Embedder
from dope.networks.init import init_encoder
from dope.networks.resnet import ResNet18


class PooledNetwork(nn.Module):
    """ResNet-18 with global average pooling (DOPE, supplement: the encoder of all baselines).

    Args:
        width: factor on the 64, 128, 256, 512 channels of the stages.

    Attributes:
        dim: length of a feature, 512 at width 1.
    """

    def __init__(self, width: float) -> None:
        super().__init__()
        self.backbone = ResNet18(width)
        init_encoder(self.backbone)
        self.dim: int = self.backbone.channels[-1]

    def forward(self, images: Tensor) -> Tensor:
        """Features (B, dim), raw, of float images (B, 3, H, W) in [0, 1]."""
        last: Tensor = self.backbone(images)[-1]
        return last.mean((2, 3))


class PooledEmbedder(Embedder):
    """Features of whole images, and none of cells.

    Args:
        network: in eval mode; maps images (B, 3, H, W) to (B, D).
        name: the method.
        own_classifier: what `--classifier auto` means.
        image_size: side in pixels that views are resized to; None: as they are.
    """

    has_dense = False

    def __init__(self, network: nn.Module, name: str, own_classifier: str, image_size: int | None) -> None:
        self.network, self.name, self.own_classifier, self.image_size = network, name, own_classifier, image_size

    @torch.inference_mode()
    def pooled(self, images: Tensor) -> Tensor:
        features: Tensor = self.network(images)
        return features.float()
