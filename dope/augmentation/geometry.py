"""Rotating, scaling and moving the object within its view.

Matrices are 3x3, in pixels with centres at +0.5, and map points of the old view to the new one.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from dope.augmentation.config import AugmentationConfig
from dope.augmentation.draws import Draws

COLUMNS = 5
NOMINAL_PX = 224  # the image side that the config's lengths are given for
DILATION_PX = 2  # two dilations by 3x3: the box the object is cut out with
LEVELS = (0, 1, 2)  # halvings before resampling


def flips(chosen: Tensor, width: int) -> Tensor:
    """Matrices (n, 3, 3) that mirror x where `chosen` (n,) and change nothing elsewhere."""
    matrices = torch.eye(3, device=chosen.device).repeat(len(chosen), 1, 1)
    matrices[:, 0, 0] = torch.where(chosen, -1.0, 1.0)
    matrices[:, 0, 2] = torch.where(chosen, float(width), 0.0)
    return matrices


def bounding_boxes(masks: Tensor) -> tuple[Tensor, Tensor]:
    """Left, top, right, bottom edges (n, 4) float32 of masks (n, 1, H, W), and (n,) bool: whether any pixel is True."""
    columns, rows = masks[:, 0].any(1).to(torch.uint8), masks[:, 0].any(2).to(torch.uint8)
    edges = [
        columns.argmax(1),
        rows.argmax(1),
        columns.shape[1] - columns.flip(1).argmax(1),
        rows.shape[1] - rows.flip(1).argmax(1),
    ]
    return torch.stack(edges, 1).float(), columns.bool().any(1)


def draw_moves(
    draws: Draws, masks: Tensor, allowed: Tensor, config: AugmentationConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw the geometric step for the views in `allowed` (n,) whose object keeps clear of the border.

    Returns:
        matrices (n, 3, 3), the identity for views that stay; moved (n,) bool; scales (n,).
    """
    height, width = masks.shape[-2:]
    unit = min(height, width) / NOMINAL_PX
    chosen = draws.chance(config.geometry_p)
    angle = torch.deg2rad(draws.integer(config.rotation_deg).float())
    longest = draws.integer(config.longest_side_px) * unit
    offset = torch.stack([draws.uniform((0.0, 1.0)), draws.uniform((0.0, 1.0))], 1)

    boxes, present = bounding_boxes(masks)
    border, size = config.clear_border_px * unit, torch.tensor([width, height], device=masks.device)
    clear = (boxes[:, :2] >= border).all(1) & (boxes[:, 2:] <= size - border).all(1)
    moved = allowed & chosen & present & clear

    sides = boxes[:, 2:] - boxes[:, :2] + 2 * DILATION_PX * unit
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    cos, sin = angle.cos(), angle.sin()
    turned = torch.stack(  # sides of the canvas grown around the rotated box
        [cos.abs() * sides[:, 0] + sin.abs() * sides[:, 1], sin.abs() * sides[:, 0] + cos.abs() * sides[:, 1]], 1
    )
    scale = (longest / turned.amax(1)).clamp(max=config.largest_scale)
    turned = turned * scale[:, None]
    margin = config.margin_px * unit
    new_centre = margin + offset * (size - 2 * margin - turned).clamp(min=0) + turned / 2

    linear = torch.stack([cos, -sin, sin, cos], 1).view(-1, 2, 2) * scale[:, None, None]
    matrices = torch.eye(3, device=masks.device).repeat(len(masks), 1, 1)
    matrices[:, :2, :2] = linear
    matrices[:, :2, 2] = new_centre - (linear @ centre[:, :, None])[:, :, 0]
    identity = torch.eye(3, device=masks.device)
    return torch.where(moved[:, None, None], matrices, identity), moved, torch.where(moved, scale, 1.0)


def warp(images: Tensor, masks: Tensor, matrices: Tensor, scales: Tensor) -> tuple[Tensor, Tensor]:
    """Resample objects by `matrices`: images (n, 3, H, W) and masks (n, 1, H, W), valid where the new mask is True.

    Colours are weighted by the mask, so that the old background does not bleed into the object's rim. Objects that
    shrink to less than a half are averaged down before, against aliasing.
    """
    alpha = masks.to(images.dtype)
    layers = torch.cat([images * alpha, alpha], 1)
    height, width = images.shape[-2:]
    usable = [level for level in LEVELS if height % 2**level == 0 and width % 2**level == 0]
    theta = _normalised(matrices, width, height)
    levels = (-scales.log2()).floor().clamp(0, usable[-1])
    result = torch.empty_like(layers)
    for level in usable:
        rows = (levels == level).nonzero()[:, 0]
        if len(rows):
            source = F.avg_pool2d(layers[rows], 2**level) if level else layers[rows]
            grid = F.affine_grid(theta[rows], [len(rows), 4, height, width], align_corners=False)
            result[rows] = F.grid_sample(source, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    new_alpha = result[:, 3:]
    return (result[:, :3] / new_alpha.clamp(min=1e-6)).clamp_(0, 1), new_alpha > 0.5


def transform_points(points: Tensor, matrices: Tensor) -> Tensor:
    """Map (n, P, 2) points by (n, 3, 3) matrices."""
    return points @ matrices[:, :2, :2].transpose(1, 2) + matrices[:, None, :2, 2]


def _normalised(matrices: Tensor, width: int, height: int) -> Tensor:
    """`affine_grid`'s theta (n, 2, 3): from the new view to the old, both edges at -1 and 1."""
    to_unit = torch.tensor([[2 / width, 0, -1], [0, 2 / height, -1], [0, 0, 1.0]], device=matrices.device)
    back = torch.tensor([[width / 2, 0, width / 2], [0, height / 2, height / 2], [0, 0, 1.0]], device=matrices.device)
    return (to_unit @ torch.linalg.inv_ex(matrices).inverse @ back)[:, :2]
