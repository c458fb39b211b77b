"""One distant lamp and the sky: what they give to a matt surface, with the shadows that things cast."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.demo.raster import Panel, rasterise
from pipeline.geometry import Floats

SHADOW_TEXELS, SHADOW_REACH = 130, 5.6
"""Resolution of the lamp's depth map a unit of length, and half its side."""


@dataclass(frozen=True)
class Light:
    """A lamp far away, the sky, and the lamp's view of the scene for shadows.

    Attributes:
        frame: (3, 3) rows: the light map's x and y in the world, and the direction to the lamp.
        key, sky: (3,) RGB strengths.
        texels: of the light map a unit of length.
        heights: (S, S) float32, the nearest surface to the lamp at each texel of the light map (-inf: none).
    """

    frame: Floats
    key: Floats
    sky: Floats
    texels: float
    heights: NDArray[np.float32]

    @classmethod
    def cast(cls, rng: np.random.Generator, vertices: Floats, faces: NDArray[np.int64], detail: float) -> Light:
        """A random lamp over a mesh (V, 3), (F, 3)."""
        elevation, azimuth = np.radians(rng.uniform(48, 68)), rng.uniform(0, 2 * np.pi)
        to_lamp = np.array(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        )
        x = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        frame = np.stack([x, np.cross(to_lamp, x), to_lamp])
        warm = rng.uniform(-0.05, 0.05)
        key, sky = (
            rng.uniform(0.78, 0.9) * np.array([1 + warm, 1, 1 - warm]),
            rng.uniform(0.46, 0.54) * np.array([0.97, 1, 1.04]),
        )
        texels = SHADOW_TEXELS * detail
        return cls(frame, key, sky, texels, _seen_along(frame, vertices, faces, texels))

    def on(self, points: Floats, normals: Floats) -> Floats:
        """Light (N, 3) that reaches surface points (N, 3) with unit normals (N, 3)."""
        facing = np.maximum(normals @ self.frame[2], 0)
        # off the surface along the normal: a point must not shade itself
        local = (points + 0.025 * normals) @ self.frame.T
        at = (local[:, :2] + SHADOW_REACH) * self.texels
        size = self.heights.shape[0]
        open_share = np.zeros(len(points))
        for dx, dy in np.ndindex(3, 3):
            column = np.clip((at[:, 0] + dx - 1).astype(int), 0, size - 1)
            row = np.clip((at[:, 1] + dy - 1).astype(int), 0, size - 1)
            open_share += self.heights[row, column] < local[:, 2]
        # the ground takes away half the sky from what looks down, more from what is close to it
        near_ground = np.clip(points[:, 2] / 0.22, 0, 1)
        sky = (0.68 + 0.32 * normals[:, 2]) * (0.7 + 0.3 * near_ground)
        return self.key * (facing * open_share / 9)[:, None] + self.sky * sky[:, None]

    def on_ground(self, panel: Panel, vertices: Floats, faces: NDArray[np.int64]) -> NDArray[np.uint8]:
        """The panel's picture, a part of z = 0, lit and with the shadows of everything on it."""
        height, width = panel.texture.shape[:2]
        lamp = cv2.GaussianBlur(np.isfinite(self.heights).astype(np.float32), (0, 0), 0.014 * self.texels)
        low = np.where(vertices[:, 2:] < 0.1, vertices, np.nan)
        contact = np.isfinite(_seen_along(np.eye(3), low, faces, self.texels)).astype(np.float32)
        above = cv2.GaussianBlur(contact, (0, 0), 0.07 * self.texels)
        shades = []
        for frame, shade in ((self.frame, lamp), (np.eye(3), above)):
            # texel index of the panel -> texel index of the map, both half a step from positions
            world = np.stack([panel.right, panel.down, panel.origin + 0.5 * (panel.right + panel.down)], axis=1)
            to_map = (frame[:2] @ world) * self.texels
            to_map[:, 2] += SHADOW_REACH * self.texels - 0.5
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            shades.append(cv2.warpAffine(shade, to_map, (width, height), flags=flags))
        key = (self.key * self.frame[2, 2]).astype(np.float32)
        lit = (1 - shades[0])[..., None] * key + (1 - 0.5 * shades[1])[..., None] * self.sky.astype(np.float32)
        return np.clip(panel.texture * lit, 0, 255).astype(np.uint8)


def _seen_along(frame: Floats, vertices: Floats, faces: NDArray[np.int64], texels: float) -> NDArray[np.float32]:
    """Largest coordinate along frame[2] at each texel of an orthographic map, -inf where there is nothing."""
    size = int(2 * SHADOW_REACH * texels)
    local = vertices @ frame.T
    xy = (local[:, :2] + SHADOW_REACH) * texels
    lift = 2 * SHADOW_REACH  # makes all positive, as the depth buffer wants
    nearness = np.where(np.isfinite(local[:, 2]), local[:, 2] + lift, -1)
    seen = rasterise(np.nan_to_num(xy), nearness, faces, size, size, cull=False)
    return np.where(seen.face >= 0, seen.nearness - lift, -np.inf).astype(np.float32)
