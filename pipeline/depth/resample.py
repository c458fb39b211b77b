"""Depth maps on other pixel grids: smaller, or distorted as the photo is, without surfaces between two surfaces."""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.depth.stereo import Depth, pixel_rays, sample_within_surfaces
from pipeline.geometry import Camera

EDGE = 0.03  # relative step between neighbouring depths beyond which they are two surfaces


def reduced(depth: Depth, long_side: int) -> Depth:
    """Depth (h, w) with its long side at most `long_side`; what is not a positive finite number becomes 0.

    At edges, where interpolation would mix two surfaces, the nearest pixel's depth is taken as it is.
    """
    with np.errstate(invalid="ignore"):
        depth = np.where((depth > 0) & np.isfinite(depth), depth, np.float32(0))
    height, width = depth.shape
    scale = long_side / max(height, width)
    if scale >= 1:
        return depth
    rows, columns = max(2, round(height * scale)), max(2, round(width * scale))
    u = (np.arange(columns) + 0.5) * (width / columns) - 0.5
    v = (np.arange(rows) + 0.5) * (height / rows) - 0.5
    u, v = (np.ascontiguousarray(index, np.float32) for index in np.meshgrid(u, v))
    sampled = _sampled(depth, u, v)
    nearest = np.asarray(cv2.remap(depth, u, v, cv2.INTER_NEAREST), np.float32)
    return np.where(sampled > 0, sampled, nearest)


def redistorted(depth: Depth, pinhole: Camera, camera: Camera) -> Depth:
    """Depth (h, w) of an undistorted view on the pixel grid of the distorted `camera` of the same pose.

    Args:
        depth: z-depth of `pinhole`, whose size may differ from the camera's; 0 or less = unknown.
    """
    height, width = depth.shape
    K = pinhole.resized(width, height).K
    rays = pixel_rays(camera)
    u = (rays[..., 0] * K[0, 0] + (K[0, 2] - 0.5)).astype(np.float32)
    v = (rays[..., 1] * K[1, 1] + (K[1, 2] - 0.5)).astype(np.float32)
    return _sampled(depth, u, v)


def distortion_px(camera: Camera) -> float:
    """How far lens distortion moves a pixel of the image at most."""
    if not camera.is_distorted:
        return 0.0
    x, y = np.meshgrid(np.linspace(0, camera.width, 17), np.linspace(0, camera.height, 17))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    straight = camera.to_normalised(pixels) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    return float(np.linalg.norm(straight - pixels, axis=1).max())


def _sampled(depth: Depth, u: Depth, v: Depth) -> Depth:
    """Depth at array indices u, v, 0 where it is unknown or between two surfaces.

    Logarithms are interpolated: there a step at an edge is relative, and 0 stays free for the unknown.
    """
    known = depth > 0
    if not known.any():
        return np.zeros(u.shape, np.float32)
    smallest = depth[known].min()
    logarithms = np.where(known, 1 + np.log(np.where(known, depth, smallest) / smallest), 0).astype(np.float32)
    sampled = sample_within_surfaces(logarithms, u, v, tolerance=EDGE)
    return np.where(sampled > 0, np.exp(sampled - 1) * smallest, 0).astype(np.float32)
