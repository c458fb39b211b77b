"""Views of a textured unit sphere whose colours are its 3D coordinates, and a "network" that reads them back."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def sphere_view(turn_deg: float, size: int = 64) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float64]]:
    """Photo (H, W, 3) RGB, mask (H, W), and for each pixel the point (H, W, 3) of the sphere it shows (0 outside)."""
    x, y = np.meshgrid((np.arange(size) + 0.5) / size * 2.4 - 1.2, (np.arange(size) + 0.5) / size * 2.4 - 1.2)
    squared = x * x + y * y
    mask = squared < 1
    facing = np.stack([x, y, -np.sqrt(np.maximum(1 - squared, 0))], axis=-1)
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    points = facing @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) * mask[..., None]
    photo = np.where(mask[..., None], np.rint(127.5 + 127.5 * points), 0).astype(np.uint8)
    return photo, mask, points


class CoordinateNetwork(torch.nn.Module):
    """Descriptors (B, 3, H/4, W/4) are the true points of the sphere; black is background."""

    def descriptors(self, images: Tensor) -> Tensor:
        inside = (images.amax(1, keepdim=True) > 0).float()
        share = torch.nn.functional.avg_pool2d(inside, 4)
        points = torch.nn.functional.avg_pool2d((2 * images - 1) * inside, 4)
        return torch.nn.functional.normalize(points, dim=1) * share
