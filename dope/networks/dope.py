"""The dense descriptor network: ResNet-18, feature pyramid, mask head and projector (DOPE, section 3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dope.common.errors import BadInput
from dope.networks.fpn import FeaturePyramid, PanopticMerge
from dope.networks.init import init_encoder
from dope.networks.resnet import ResNet18, load_torchvision

STRIDE = 4  # pixels of the image a feature cell, in each direction
COARSEST_STRIDE = 32  # image sides are multiples of it, so that each pyramid level is exactly half of the finer one
CERTAIN = 100.0  # a logit whose sigmoid is exactly 1 in float32
CELLS_AT_ONCE = 8192  # of the projector on whole maps: bounds its 1024-channel activations


@dataclass(frozen=True)
class NetworkConfig:
    """The network's sizes; the defaults are the paper's network as released."""

    width: float = 1.0
    """Factor on the 64, 128, 256, 512 channels of the ResNet-18 stages."""
    pyramid: int = 128
    """Channels of the feature pyramid and of the feature map."""
    projector: tuple[int, ...] = (1024, 1024, 1024, 256)
    """Output channels of the projector's layers; the last is the length of a descriptor."""
    predict_mask: bool = True
    """Predict the object's mask and multiply the descriptors with it; off, all cells count as object."""


class NetworkOutput(NamedTuple):
    """What the encoder makes of B images: features (B, C, H/4, W/4) and mask logits (B, 1, H/4, W/4)."""

    features: Tensor
    mask_logits: Tensor


class DopeNetwork(nn.Module):
    """Dense descriptors: unit vectors on a grid of stride 4, multiplied by the probability of being the object.

    The projector is a stack of `Linear` layers, the same as 1x1 convolutions, so that training runs it on the sampled
    cells alone.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = ResNet18(config.width)
        self.pyramid = FeaturePyramid(self.backbone.channels, config.pyramid)
        self.merge = PanopticMerge(config.pyramid)
        for part in (self.backbone, self.pyramid, self.merge):
            init_encoder(part)
        # PyTorch's own start for the head: a fan-out of 1 would mean N(0, sqrt(2)) and a mask saturated from the start
        self.mask_head = nn.Conv2d(config.pyramid, 1, 1, bias=False) if config.predict_mask else None
        self.projector = _projector(config.pyramid, config.projector)

    def forward(self, images: Tensor) -> NetworkOutput:
        """Encode float images (B, 3, H, W) in [0, 1], H and W multiples of 32.

        Without mask prediction the logits are a constant whose sigmoid is exactly 1.

        Raises:
            BadInput: H or W is not a multiple of 32.
        """
        height, width = images.shape[-2:]
        if height % COARSEST_STRIDE or width % COARSEST_STRIDE:
            raise BadInput(
                f"images are {width}x{height} px, and the network needs sides that are multiples of {COARSEST_STRIDE}",
                where="network input",
                remedy="Resize or pad the images, e.g. to 224x224",
            )
        features = self.merge(self.pyramid(self.backbone(images)))
        if self.mask_head is None:
            return NetworkOutput(features, torch.full_like(features[:, :1], CERTAIN))
        return NetworkOutput(features, self.mask_head(features))

    def project(self, cell_features: Tensor) -> Tensor:
        """Map features of cells (N, C) to raw projections (N, D), neither normalised nor masked."""
        return self.projector(cell_features)

    def sample(self, output: NetworkOutput, cells: Tensor) -> Tensor:
        """Descriptors (B, P, D) float32 at `cells` (B, P, 2), long, row and column; gradients reach the mask too."""
        image = torch.arange(len(cells), device=cells.device)[:, None]
        rows, columns = cells.unbind(-1)
        features = output.features.permute(0, 2, 3, 1)[image, rows, columns]  # (B, P, C)
        logits = output.mask_logits[:, 0][image, rows, columns]
        projections = self.project(features.flatten(0, 1)).unflatten(0, cells.shape[:2])
        return F.normalize(projections.float(), dim=-1) * logits.float().sigmoid()[..., None]

    def descriptors(self, images: Tensor) -> Tensor:
        """Descriptors (B, D, H/4, W/4) float32 on the whole grid: unit vectors times the soft predicted mask.

        Gradients flow unless the caller disables them.
        """
        return self.dense(self(images))

    def dense(self, output: NetworkOutput) -> Tensor:
        """The same as `descriptors`, of images encoded before."""
        batch, _, height, width = output.features.shape
        cells = output.features.permute(0, 2, 3, 1).flatten(0, 2)  # (B * h * w, C)
        probabilities = output.mask_logits.float().sigmoid().flatten().split(CELLS_AT_ONCE)
        parts = [
            F.normalize(self.project(part).float(), dim=-1) * probability[:, None]
            for part, probability in zip(cells.split(CELLS_AT_ONCE), probabilities, strict=True)
        ]
        return torch.cat(parts).unflatten(0, (batch, height, width)).permute(0, 3, 1, 2)

    def masks(self, images: Tensor) -> Tensor:
        """Probabilities (B, 1, H/4, W/4) float32 that a cell shows the object."""
        return self(images).mask_logits.float().sigmoid()

    def load_backbone(self, state: Mapping[str, Tensor]) -> None:
        """Start the backbone from a torchvision resnet18 state dict; its classifier is left out.

        Images stay in [0, 1]: weights trained with ImageNet's normalisation see other statistics until they adapt.

        Raises:
            BadInput: the state dict is not of a ResNet-18 of this width.
        """
        load_torchvision(self.backbone, state)


def _projector(inputs: int, outputs: tuple[int, ...]) -> nn.Sequential:
    """Linear layers with ReLU between, the last without bias and without ReLU."""
    layers: list[nn.Module] = []
    for i, channels in enumerate(outputs):
        last = i == len(outputs) - 1
        layers.append(nn.Linear(inputs, channels, bias=not last))
        if not last:
            layers.append(nn.ReLU(inplace=True))
        inputs = channels
    return nn.Sequential(*layers)
