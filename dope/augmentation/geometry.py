"""Rotating, scaling and moving the object within its view.

Matrices are 3x3, in pixels with centres at +0.5, and map points of the old view to the new one.
"""

from __future__ import annotations

import cv2
import torch
import torch.nn.functional as F
from torch import Tensor

from dope.augmentation.config import AugmentationConfig
from dope.augmentation.draws import Draws, rows_where

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
    numbers = masks[:, 0].view(torch.uint8)  # PyTorch takes `any` of bools one by one, but 16 bytes' largest at a time
    if not masks.is_cuda:
        boxes = torch.tensor([cv2.boundingRect(mask) for mask in numbers.numpy(force=True)]).view(-1, 4).float()
        return torch.cat([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], 1), boxes[:, 2] > 0
    columns, rows = numbers.amax(1), numbers.amax(2)
    edges = [
        columns.argmax(1),
        rows.argmax(1),
        columns.shape[1] - columns.flip(1).argmax(1),
        rows.shape[1] - rows.flip(1).argmax(1),
    ]
    return torch.stack(edges, 1).float(), columns.bool().any(1)


def draw_moves(
    draws: Draws, masks: Tensor, boxes: Tensor, allowed: Tensor, config: AugmentationConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw the geometric step for the views in `allowed` (n,) whose object's box (n, 4) keeps clear of the border.

    Returns:
        matrices (n, 3, 3), the identity for views that stay; moved (n,) bool; scales (n,).
    """
    height, width = masks.shape[-2:]
    unit = min(height, width) / NOMINAL_PX
    chosen = draws.chance(config.geometry_p)
    angle = torch.deg2rad(draws.integer(config.rotation_deg).float())
    longest = draws.integer(config.longest_side_px) * unit
    offset = torch.stack([draws.uniform((0.0, 1.0)), draws.uniform((0.0, 1.0))], 1)

    border, size = config.clear_border_px * unit, torch.tensor([width, height], device=masks.device)
    clear = (boxes[:, :2] >= border).all(1) & (boxes[:, 2:] <= size - border).all(1)
    moved = allowed & chosen & clear

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
    """Move objects by `matrices` within images (n, 3, H, W) and masks (n, 1, H, W); what the new ones are.

    Colours are weighted by the mask, so that the old background does not bleed into the object's rim; what they are
    where the new mask is False is left open. Objects that shrink to less than a half are averaged down before, against
    aliasing.

    Args:
        matrices: (n, 3, 3), from the old view to the new.
        scales: (n,) of the matrices.
    """
    height, width = images.shape[-2:]
    alpha = masks.to(images.dtype)
    layers = torch.cat([images * alpha, alpha], 1)
    levels = halvings(scales, height, width)
    # pixels of the new view to places in the old one, both edges of which are at -1 and 1
    back = torch.linalg.inv_ex(matrices).inverse
    x = torch.arange(width, device=images.device) + 0.5
    y = (torch.arange(height, device=images.device) + 0.5)[:, None]
    grid = torch.empty(len(images), height, width, 2, device=images.device)
    for axis, size in enumerate((width, height)):
        a, b, c = (back[:, axis] * (2 / size))[:, :, None, None].unbind(1)
        torch.add(a * x, b * y + (c - 1), out=grid[..., axis])
    moved = torch.empty_like(layers)
    for level in LEVELS:
        rows = rows_where(levels == level)
        if rows is not None:
            source = F.avg_pool2d(layers[rows], 2**level) if level else layers[rows]
            moved[rows] = F.grid_sample(source, grid[rows], mode="bilinear", padding_mode="zeros", align_corners=False)
    new_alpha = moved[:, 3:]
    return (moved[:, :3] / new_alpha.clamp(min=1e-6)).clamp_(0, 1), new_alpha > 0.5


def halvings(scales: Tensor, height: int, width: int) -> Tensor:
    """How often (n,) each view is halved before it is resampled by `scales` (n,): as often as its sides allow."""
    usable = [level for level in LEVELS if height % 2**level == 0 and width % 2**level == 0]
    return (-scales.log2()).floor().clamp(0, usable[-1]).long()


def transform_points(points: Tensor, matrices: Tensor) -> Tensor:
    """Map (n, P, 2) points by (n, 3, 3) matrices."""
    x, y = points.unbind(-1)
    a, b, c = matrices[:, :2, None].unbind(-1)  # (n, 2, 1) each
    # a product of (P, 2) by (2, 2) matrices takes ten times as long
    return torch.stack([a[:, row] * x + b[:, row] * y + c[:, row] for row in (0, 1)], -1)
