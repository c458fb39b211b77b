"""A panorama as lights: one or two key lights that cast shadows, and the rest as smooth light from all around.

The rest is kept as spherical harmonics of order 2 (Ramamoorthi and Hanrahan, SIGGRAPH 2001). Shadows are those of a
fixed set of directions: some spread over the discs of the key lights, some over the whole sphere. A scene's light and
object stand still, so a shadow map of each direction is made once and serves all its shots.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.geometry import Floats
from pipeline.render.exposure import LUMINANCE, SIDES, expose, mean_albedo
from pipeline.render.scene import Ground, Light
from pipeline.render.skies import directions_of

ROWS = 48
"""Rows of the panorama that lights are looked for in."""
KEYS = 2
"""Key lights at most."""
KEY_SAMPLES = 8
"""Directions over the disc of a key light."""
AMBIENT_SAMPLES = 18
"""Directions over the sphere for the rest."""
GROUND_SAMPLES = 24
"""Directions over the upper half for the shadows on the ground, where few would show one by one."""
DIRECTIONS = KEYS * KEY_SAMPLES + AMBIENT_SAMPLES
CASTERS = KEYS * KEY_SAMPLES + GROUND_SAMPLES
KEY_RADIUS_DEG = (1.5, 16.0)
"""Smallest and largest radius of a key light: the sun's own is less than a shadow map resolves."""
KEY_REACH_DEG = 24.0


@dataclass(frozen=True)
class Lights:
    """Light as the shaders take it. World coordinates; radiance in units of the panorama's mean.

    Attributes:
        harmonics: (9, 3) irradiance over pi of the smooth light, as factors of the polynomials of `basis`.
        keys: (KEYS, 3) irradiance over pi of a surface that faces the key light; 0 for one that is not there.
        key_directions: (KEYS, 3) unit, towards the light.
        directions: (DIRECTIONS, 3) unit: KEY_SAMPLES for each key light, then AMBIENT_SAMPLES.
        weights: (DIRECTIONS,) share of its key light, or power of the smooth light around it; 0: unused.
        ground_directions: (CASTERS, 3) those that shade the ground.
        ground_weights: their shares, (CASTERS, KEYS + 1): of the smooth light on level ground, and of each key light.
        bounce: (3,) radiance of the lit ground, 0 without one.
        exposure: (3,) multiplies radiance before tone mapping; with it the white balance.
    """

    harmonics: Floats
    keys: Floats
    key_directions: Floats
    directions: Floats
    weights: Floats
    ground_directions: Floats
    ground_weights: Floats
    bounce: Floats
    exposure: Floats


def basis(directions: Floats) -> Floats:
    """Polynomials (..., 9) of unit vectors (..., 3), to which spherical harmonics up to order 2 are proportional."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.stack([np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], axis=-1)


_NORM = np.array([0.282095, *[0.488603] * 3, 1.092548, 1.092548, 0.315392, 1.092548, 0.546274])
_COSINE = np.array([np.pi, *[2 * np.pi / 3] * 3, *[np.pi / 4] * 5])


def lights_of(light: Light, ground: Ground | None) -> Lights:
    """The lights of a panorama over a ground, which hides the panorama's lower half and throws light back."""
    radiance = cv2.resize(light.panorama, (2 * ROWS, ROWS), interpolation=cv2.INTER_AREA).astype(np.float64)
    toward, angle = directions_of(ROWS, light.turn)
    if ground is not None:
        radiance[toward[..., 2] <= 0] = 0
    keys, key_directions, radii = np.zeros((KEYS, 3)), np.zeros((KEYS, 3)), np.zeros(KEYS)
    key_directions[:, 2] = 1
    for number in range(KEYS):
        found = _take_key(radiance, toward, angle)
        if found is None:
            break
        keys[number], key_directions[number], radii[number] = found
    bounce = np.zeros(3)
    if ground is not None:
        up = (radiance * angle[..., None] * np.maximum(toward[..., 2:], 0)).sum(axis=(0, 1)) / np.pi
        up += (keys * np.maximum(key_directions[:, 2:], 0)).sum(axis=0)
        bounce = up * mean_albedo(ground)
        radiance[toward[..., 2] <= 0] = bounce
    power = (radiance * angle[..., None]).reshape(-1, 3)
    harmonics = (_COSINE * _NORM * _NORM / np.pi)[:, None] * (basis(toward).reshape(-1, 9).T @ power)
    directions, luminance = toward.reshape(-1, 3), power @ LUMINANCE
    discs, sphere = _discs(key_directions, radii), _sphere()
    there = np.repeat(keys.any(axis=1), KEY_SAMPLES) / KEY_SAMPLES
    weights = np.concatenate([there, _around(sphere, directions, luminance)])
    above = _upper_half()
    level = _around(above, directions, luminance * np.maximum(directions[:, 2], 0))
    shares = np.zeros((len(discs) + GROUND_SAMPLES, 1 + KEYS))
    shares[len(discs) :, 0] = level / max(level.sum(), 1e-12)
    for key in range(KEYS):
        chosen = slice(key * KEY_SAMPLES, (key + 1) * KEY_SAMPLES)
        shares[chosen, 1 + key] = there[chosen]
    exposure = expose(_white(harmonics, keys, key_directions), ground, light.strength)
    samples, on_ground = np.concatenate([discs, sphere]), np.concatenate([discs, above])
    return Lights(
        harmonics, keys, key_directions, samples, weights, on_ground, shares, bounce, exposure.gain * exposure.balance
    )


def _take_key(radiance: Floats, toward: Floats, angle: Floats) -> tuple[Floats, Floats, float] | None:
    """The strongest light of a panorama (colour, direction, radius in radians), which is taken out of it."""
    bright = radiance @ LUMINANCE
    order = np.argsort(bright, axis=None)
    share = np.cumsum(np.broadcast_to(angle, bright.shape).ravel()[order])
    usual = bright.ravel()[order][np.searchsorted(share, 0.8 * share[-1])]
    excess = np.maximum(bright - 2.0 * usual, 0) * angle
    if not excess.any():
        return None
    wide = cv2.copyMakeBorder(excess, 0, 0, 8, 8, cv2.BORDER_WRAP)
    blurred = cv2.GaussianBlur(wide, (0, 0), 2.5)[:, 8:-8]
    peak = toward[np.unravel_index(np.argmax(blurred), blurred.shape)]
    near = np.where(toward @ peak > np.cos(np.radians(KEY_REACH_DEG)), excess, 0)
    total = near.sum()
    if total < 0.06 * (bright * angle).sum():
        return None
    direction = (near[..., None] * toward).sum(axis=(0, 1))
    direction /= max(float(np.linalg.norm(direction)), 1e-12)
    away = np.arccos(np.clip(toward @ direction, -1, 1))
    radius = float(np.sqrt(2 * (near * away**2).sum() / total))
    taken = near / np.maximum(bright * angle, 1e-12)
    colour = (radiance * (taken * angle)[..., None]).sum(axis=(0, 1)) / np.pi
    radiance *= 1 - taken[..., None]
    return colour, direction, float(np.clip(radius, *np.radians(KEY_RADIUS_DEG)))


_GOLDEN = np.pi * (3 - np.sqrt(5))


def _discs(keys: Floats, radii: Floats) -> Floats:
    """Directions (KEYS * KEY_SAMPLES, 3) over the discs of the key lights."""
    number = np.arange(KEY_SAMPLES) + 0.5
    radius, around = np.sqrt(number / KEY_SAMPLES), _GOLDEN * number
    across, along = frame_of(keys)
    offsets = np.cos(around)[:, None] * across[:, None] + np.sin(around)[:, None] * along[:, None]
    discs = keys[:, None] + (np.tan(radii)[:, None] * radius)[..., None] * offsets
    return (discs / np.linalg.norm(discs, axis=-1, keepdims=True)).reshape(-1, 3)


def _sphere() -> Floats:
    """Directions (AMBIENT_SAMPLES, 3), evenly over the sphere."""
    number = np.arange(AMBIENT_SAMPLES) + 0.5
    return _spiral(number, 1 - 2 * number / AMBIENT_SAMPLES)


def _upper_half() -> Floats:
    """Directions (GROUND_SAMPLES, 3) over the upper half, as dense as level ground sees it."""
    number = np.arange(GROUND_SAMPLES) + 0.5
    return _spiral(number, np.sqrt(1 - number / GROUND_SAMPLES))


def _spiral(number: Floats, z: Floats) -> Floats:
    flat = np.sqrt(1 - z * z)
    return np.column_stack([flat * np.cos(_GOLDEN * number), flat * np.sin(_GOLDEN * number), z])


def _around(samples: Floats, toward: Floats, power: Floats) -> Floats:
    """The power (N,) that comes from around each sample (S, 3): of the directions (N, 3) that it is nearest to."""
    return np.asarray(np.bincount(np.argmax(toward @ samples.T, axis=1), power, len(samples)), np.float64)


def frame_of(directions: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors (..., 3) that stand upright on unit vectors (..., 3) and on each other."""
    x, y, z = np.moveaxis(directions, -1, 0)
    steep = np.abs(z) > 0.9
    zero = np.zeros_like(z)
    across = np.stack([np.where(steep, zero, -y), np.where(steep, -z, x), np.where(steep, y, zero)], axis=-1)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    a, b, c = np.moveaxis(across, -1, 0)
    return across, np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=-1)


def _white(harmonics: Floats, keys: Floats, key_directions: Floats) -> Floats:
    """Mean radiance (3,) of white surfaces that look to `SIDES`."""
    light = basis(SIDES) @ harmonics + np.maximum(SIDES @ key_directions.T, 0) @ keys
    return np.asarray(np.maximum(light, 1e-6).mean(axis=0))
