"""Descriptors of a few views, at the resolution of the photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from dope.decoding import resized
from dope.figures.drawing import Image
from dope.lowshot.encoding import to_tensor

SURE = 0.5  # soft mask from which a pixel counts as the object


class Describer(Protocol):
    """What figures need of a `DopeNetwork`."""

    def descriptors(self, images: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class DescriptorMap:
    """One view.

    Attributes:
        photo: (H, W, 3) uint8 RGB.
        units: (D, h, w) unit descriptors on the network's grid.
        mask: (H, W) float32 in [0, 1]: predicted, or given (0 or 1).
    """

    photo: Image
    units: Tensor
    mask: NDArray[np.float32]

    @property
    def object(self) -> NDArray[np.bool_]:
        """(H, W), True = object."""
        return self.mask >= SURE

    def upsampled(self, height: int, width: int) -> Tensor:
        """Descriptors (height, width, D), bilinear, unit length again."""
        units = F.interpolate(self.units[None], (height, width), mode="bilinear", align_corners=False)[0]
        return F.normalize(units, dim=0).permute(1, 2, 0)

    def at_pixels(self, where: NDArray[np.bool_]) -> Tensor:
        """Descriptors (N, D) of the pixels of `where` (H, W), or of a smaller grid over the whole view, row by row."""
        return self.upsampled(*where.shape)[torch.from_numpy(where).to(self.units.device)]


@torch.inference_mode()
def describe(
    network: Describer,
    photos: Sequence[Image],
    masks: Sequence[NDArray[np.bool_]] | None = None,
    *,
    image_size: int | None = None,
    device: torch.device | str = "cpu",
) -> list[DescriptorMap]:
    """Encode photos (H, W, 3) uint8 RGB, one by one.

    Args:
        network: in eval mode.
        photos: of any size once `image_size` is given, else of sides that are multiples of 32.
        masks: (H, W) bool each, used in place of the predicted soft masks.
        image_size: side in pixels that the network was trained with.
        device: where the network is.
    """
    maps = []
    for i, photo in enumerate(photos):
        found = network.descriptors(to_tensor(resized(photo, image_size)[None], device))[0].float()
        norms = found.norm(dim=0)
        if masks is None:
            soft = F.interpolate(norms[None, None], photo.shape[:2], mode="bilinear", align_corners=False)
            mask = soft[0, 0].clamp(0, 1).cpu().numpy()
        else:
            mask = masks[i].astype(np.float32)
        maps.append(DescriptorMap(photo, F.normalize(found, dim=0), mask))
    return maps
