"""From light to pictures as a camera does it: exposure, white balance, a curve with a shoulder. Of both renderers."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Floats
from pipeline.render.scene import Ground, Light
from pipeline.render.skies import directions_of

WHITE = 0.55
"""Radiance that a white object gets at the usual strength of the light."""
USUAL_STRENGTH = 0.65
USUAL_ALBEDO = 0.25
"""Of grounds, linear: over darker ones more is exposed, over brighter ones less."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
SIDES = np.array([[0, 0, 1.0], [0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
"""Normals by which a white object is measured: it looks up (twice) and to all four sides."""
SHOULDER = 0.72
"""Colours below it stay true."""
FADE = 0.15
"""How fast colours beyond it lose their hue."""
_ROWS = 64


@dataclass(frozen=True)
class Exposure:
    """What a camera would set for a scene.

    Attributes:
        gain: multiplies radiance in units of the panorama's mean; the light's strength is part of it.
        balance: (3,) multiplies its colours: half of the light's hue goes.
    """

    gain: float
    balance: Floats


def expose(white: Floats, ground: Ground | None, strength: float) -> Exposure:
    """The exposure by which a white object is WHITE at the usual strength over a usual ground.

    Args:
        white: (3,) mean radiance of white matt surfaces of the normals SIDES, as the renderer lights them, in units of
            the panorama's mean: what a renderer simplifies of the light does not change how bright its pictures are.
        ground: over bright grounds less is exposed; None counts as a usual one.
        strength: of the light.
    """
    white = np.maximum(white, 1e-6)
    albedo = USUAL_ALBEDO if ground is None else float(mean_albedo(ground) @ LUMINANCE)
    bright = float(white @ LUMINANCE)
    scale = WHITE / bright * np.clip(USUAL_ALBEDO / max(albedo, 1e-3), 0.2, 5) ** 0.35
    return Exposure(float(scale) * (strength / USUAL_STRENGTH), (bright / white) ** 0.6)


def white_under(light: Light, ground: Ground | None) -> Floats:
    """What `expose` takes of a renderer that simplifies nothing.

    Radiance of a surface of normal n is 1/pi times the integral of L(d) max(n d, 0) over directions d; below the
    horizon a ground of the picture's mean albedo, lit from above, stands for the panorama.
    """
    panorama = cv2.resize(light.panorama, (2 * _ROWS, _ROWS), interpolation=cv2.INTER_AREA).astype(np.float64)
    directions, angle = directions_of(_ROWS, light.turn)
    power, up = panorama * (angle / np.pi)[..., None], directions[..., 2:]
    if ground is not None:
        bounce = mean_albedo(ground) * (power * np.maximum(up, 0)).sum(axis=(0, 1))
        power = np.where(up > 0, power, bounce * (angle / np.pi)[..., None])
    facing = np.maximum(directions.reshape(-1, 3) @ SIDES.T, 0)
    return np.asarray((facing.T @ power.reshape(-1, 3)).mean(axis=0))


def mean_albedo(ground: Ground) -> Floats:
    """Linear colour (3,) of the mean of a ground's picture."""
    return to_linear(cv2.resize(ground.albedo, (1, 1), interpolation=cv2.INTER_AREA)[0, 0] / 255.0)


def show(radiance: NDArray[np.float32], balance: Floats) -> NDArray[np.uint8]:
    """Radiance (H, W, 3) that was exposed, as sRGB bytes; what is not finite is black or white.

    The curve is Khronos PBR Neutral's above its toe: below SHOULDER colours stay true, brighter ones are compressed
    and lose their hue (github.com/KhronosGroup/ToneMapping, PBR_Neutral). `fast/common.glsl` has the same.
    """
    light = np.maximum(np.nan_to_num(radiance, nan=0.0, posinf=1e4, neginf=0.0), 0.0) * balance.astype(np.float32)
    peak = light.max(axis=-1, keepdims=True)
    room = 1 - SHOULDER
    squeezed = 1 - room**2 / (np.maximum(peak, SHOULDER) + room - SHOULDER)
    fade = 1 - 1 / (FADE * (peak - squeezed) + 1)
    bright = light * (squeezed / np.maximum(peak, SHOULDER)) * (1 - fade) + squeezed * fade
    return to_srgb(np.where(peak < SHOULDER, light, bright))


def to_srgb(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Linear light to sRGB bytes (IEC 61966-2-1), cut at 1."""
    light = np.clip(light, 0.0, 1.0)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.power(light, np.float32(1 / 2.4)) - 0.055)
    return np.round(srgb * 255).astype(np.uint8)


def to_linear(srgb: Floats) -> Floats:
    """sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0) + 0.055) / 1.055) ** 2.4)
