"""From light to pictures as a camera does it: exposure, white balance, a curve with a shoulder."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Floats
from pipeline.render.scene import Ground, Light

WHITE = 0.6
"""Radiance that a white object gets at the usual strength of the light."""
USUAL_STRENGTH = 0.65
USUAL_ALBEDO = 0.25
"""Of grounds, linear: over darker ones more is exposed, over brighter ones less."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_ROWS = 64
_SHOULDER = 0.72
_FADE = 0.15


@dataclass(frozen=True)
class Exposure:
    """What a camera would set for a scene.

    Attributes:
        strength: of Blender's world.
        balance: (3,) multiplies the colours of what comes out: half of the light's hue goes.
    """

    strength: float
    balance: Floats


def expose(light: Light, ground: Ground | None) -> Exposure:
    """Exposure by the mean radiance of a white matt object that looks up (twice) and to all four sides.

    Radiance of a surface of normal n is 1/pi times the integral of L(d) max(n d, 0) over directions d; below the
    horizon a ground of the picture's mean albedo, lit from above, stands for the panorama.
    """
    panorama = cv2.resize(light.panorama, (2 * _ROWS, _ROWS), interpolation=cv2.INTER_AREA).astype(np.float64)
    down = (np.arange(_ROWS) + 0.5) * np.pi / _ROWS
    azimuth = np.pi - (np.arange(2 * _ROWS) + 0.5) * np.pi / _ROWS + light.turn
    z = np.cos(down)[:, None] + 0 * azimuth
    across = np.sin(down)[:, None]
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=-1)
    share = (across * (np.pi / _ROWS) ** 2 / np.pi + 0 * azimuth)[..., None]
    albedo = USUAL_ALBEDO
    if ground is not None:
        mean = to_linear(ground.albedo.reshape(-1, 3).mean(axis=0) / 255)
        albedo = float(mean @ LUMINANCE)
        panorama[z <= 0] = mean * (panorama * share * np.maximum(z, 0)[..., None]).sum(axis=(0, 1))
    normals = np.array([[0, 0, 1.0], [0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    seen = np.maximum(directions.reshape(-1, 3) @ normals.T, 0)
    white = np.maximum((seen.T @ (panorama * share).reshape(-1, 3)).mean(axis=0), 1e-6)
    bright = float(white @ LUMINANCE)
    scale = WHITE / bright * float(np.clip(USUAL_ALBEDO / max(albedo, 1e-3), 0.2, 5)) ** 0.35
    return Exposure(scale * light.strength / USUAL_STRENGTH, (bright / white) ** 0.6)


def show(radiance: NDArray[np.float32], balance: Floats) -> NDArray[np.uint8]:
    """Radiance (H, W, 3) that was exposed, as sRGB bytes; what is not finite is black or white.

    The curve is Khronos PBR Neutral's above its toe: below 0.72 colours stay true, brighter ones are compressed and
    lose their hue (github.com/KhronosGroup/ToneMapping, PBR_Neutral).
    """
    light = np.maximum(np.nan_to_num(radiance, nan=0.0, posinf=1e4, neginf=0.0), 0.0) * balance.astype(np.float32)
    peak = light.max(axis=-1, keepdims=True)
    room = 1 - _SHOULDER
    squeezed = 1 - room**2 / (np.maximum(peak, _SHOULDER) + room - _SHOULDER)
    fade = 1 - 1 / (_FADE * (peak - squeezed) + 1)
    bright = light * (squeezed / np.maximum(peak, _SHOULDER)) * (1 - fade) + squeezed * fade
    return to_srgb(np.where(peak < _SHOULDER, light, bright))


def to_srgb(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Linear light to sRGB bytes (IEC 61966-2-1), cut at 1."""
    light = np.clip(light, 0.0, 1.0)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.power(light, np.float32(1 / 2.4)) - 0.055)
    return np.round(srgb * 255).astype(np.uint8)


def to_linear(srgb: Floats) -> Floats:
    """sRGB in [0, 1] to linear light."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
