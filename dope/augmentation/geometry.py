"""Rotating, scaling and moving the object within its view.

Matrices are 3x3, in pixels with centres at +0.5, and map points of the old view to the new one.
"""

from __future__ import annotations

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


def warp(images: Tensor, masks: Tensor, boxes: Tensor, matrices: Tensor, scales: Tensor) -> None:
    """Move objects by `matrices` within images (n, 3, H, W) and masks (n, 1, H, W), in place.

    Colours are weighted by the mask, so that the old background does not bleed into the object's rim; what they are
    where the new mask is False is left open. Objects that shrink to less than a half are averaged down before, against
    aliasing.

    Args:
        boxes: (n, 4) edges of the objects' boxes, outside of which no mask pixel is True.
        matrices: (n, 3, 3), from the old view to the new.
        scales: (n,) of the matrices.
    """
    (top, left, height, width), (to_top, to_left, to_height, to_width) = _windows(images, boxes, matrices)
    here = (..., slice(top, top + height), slice(left, left + width))
    there = (..., slice(to_top, to_top + to_height), slice(to_left, to_left + to_width))
    alpha = masks[here].to(images.dtype)
    layers = torch.cat([images[here] * alpha, alpha], 1)
    usable = [level for level in LEVELS if height % 2**level == 0 and width % 2**level == 0]
    levels = (-scales.log2()).floor().clamp(0, usable[-1])
    # pixels of the new view to places in the window of the old one, both edges of which are at -1 and 1
    back = torch.linalg.inv_ex(matrices).inverse
    x = torch.arange(to_left, to_left + to_width, device=images.device) + 0.5
    y = (torch.arange(to_top, to_top + to_height, device=images.device) + 0.5)[:, None]
    grid = torch.empty(len(images), to_height, to_width, 2, device=images.device)
    for axis, (start, size) in enumerate(((left, width), (top, height))):
        a, b, c = (back[:, axis] * (2 / size))[:, :, None, None].unbind(1)
        torch.add(a * x, b * y + (c - (2 * start / size + 1)), out=grid[..., axis])
    moved = torch.empty(len(images), 4, to_height, to_width, device=images.device)
    for level in usable:
        rows = rows_where(levels == level)
        if rows is not None:
            source = F.avg_pool2d(layers[rows], 2**level) if level else layers[rows]
            moved[rows] = F.grid_sample(source, grid[rows], mode="bilinear", padding_mode="zeros", align_corners=False)
    new_alpha = moved[:, 3:]
    torch.div(moved[:, :3], new_alpha.clamp(min=1e-6), out=images[there]).clamp_(0, 1)
    masks.zero_()
    torch.gt(new_alpha, 0.5, out=masks[there])


Window = tuple[int, int, int, int]  # top, left, height, width


def _windows(images: Tensor, boxes: Tensor, matrices: Tensor) -> tuple[Window, Window]:
    """What the objects of all views fill before and after a move: on CPUs, where asking for it costs nothing."""
    height, width = images.shape[-2:]
    whole = (0, 0, height, width)
    if images.is_cuda:
        return whole, whole
    corners = boxes[:, [0, 1, 2, 1, 0, 3, 2, 3]].view(-1, 4, 2)
    edges = [
        f(c.flatten(0, 1), 0) for c in (corners, transform_points(corners, matrices)) for f in (torch.amin, torch.amax)
    ]
    low, high, to_low, to_high = torch.stack(edges).tolist()
    coarse = 2 ** LEVELS[-1]  # pixels of the coarsest level begin where they would without a window
    around = coarse if height % coarse == 0 and width % coarse == 0 else height * width
    return _window(low, high, around, height, width), _window(to_low, to_high, 1, height, width)


def _window(low: list[float], high: list[float], grain: int, height: int, width: int) -> Window:
    """The window around a box and two pixels more, its edges multiples of `grain`, within the view."""
    first = [max(0, int((edge - 2) // grain) * grain) for edge in low]
    last = [min(size, int(-((-edge - 2) // grain)) * grain) for edge, size in zip(high, (width, height), strict=True)]
    return first[1], first[0], last[1] - first[1], last[0] - first[0]


def transform_points(points: Tensor, matrices: Tensor) -> Tensor:
    """Map (n, P, 2) points by (n, 3, 3) matrices."""
    x, y = points.unbind(-1)
    a, b, c = matrices[:, :2, None].unbind(-1)  # (n, 2, 1) each
    # a product of (P, 2) by (2, 2) matrices takes ten times as long
    return torch.stack([a[:, row] * x + b[:, row] * y + c[:, row] for row in (0, 1)], -1)
