"""Panoramas of studios and rooms: boxes seen from inside, with lamps, soft boxes and windows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.render.noise import smooth_step, wrapping_noise

_Plane = NDArray[Any]


def studio(toward: _Plane, rng: np.random.Generator) -> _Plane:
    """A backdrop that goes from floor to dark ceiling without an edge, and two to four soft boxes."""
    up = toward[..., 2]
    tint = 1 + rng.uniform(-0.08, 0.08, 3)
    floor, wall, top = rng.uniform(0.12, 0.6), rng.uniform(0.15, 0.9), rng.uniform(0.03, 0.3)
    grey = floor + (wall - floor) * smooth_step(-0.6, 0.15, up) + (top - wall) * smooth_step(0.1, 0.95, up)
    azimuth = np.arctan2(toward[..., 1], toward[..., 0])
    grey = grey * (1 + 0.25 * np.cos(azimuth - rng.uniform(0, 6.3)))
    light = grey[..., None] * tint
    start = rng.uniform(0, 2 * np.pi)
    for number in range(int(rng.integers(2, 5))):
        around, height = start + number * rng.uniform(1.5, 2.4), np.radians(rng.uniform(18, 65))
        size = rng.uniform(0.12, 0.42, 2)
        power = rng.uniform(9, 30) if number == 0 else rng.uniform(2, 12)
        warmth = rng.uniform(-0.12, 0.12)
        panel = _panel(toward, around, height, size[0], size[1], 0.03)
        light = light + panel[..., None] * power * (1 + warmth * np.array([1.0, 0.1, -1.0]))
    if rng.random() < 0.5:  # a panel over the object
        light = light + _panel(toward, start, np.pi / 2 - 0.05, 0.5, 0.3, 0.05)[..., None] * rng.uniform(3, 9)
    return light.astype(np.float32)


def room(toward: _Plane, rng: np.random.Generator) -> _Plane:
    """A box with windows or lamps, things on and before its walls, seen from 1.2 m above its floor."""
    half = np.array([rng.uniform(2, 5), rng.uniform(2, 5)])
    ceiling, eye = rng.uniform(2.4, 3.6), 1.2
    safe = np.where(np.abs(toward) < 1e-6, np.float32(1e-6), toward)
    walls = half / np.abs(safe[..., :2])
    level = np.where(safe[..., 2] > 0, ceiling - eye, eye) / np.abs(safe[..., 2])
    distances = np.concatenate([walls, level[..., None]], axis=-1)
    axis = np.argmin(distances, axis=-1)
    point = toward * np.min(distances, axis=-1)[..., None]
    point[..., 2] += eye
    paint = _paint(rng)
    light = np.empty((*toward.shape[:2], 3))
    light[:] = paint * rng.uniform(0.55, 0.9)
    floor = (axis == 2) & (toward[..., 2] < 0)
    grain = wrapping_noise(rng, toward.shape[0], toward.shape[1], 16, 4)
    wood = np.array([0.36, 0.23, 0.13]) * rng.uniform(0.6, 1.6) if rng.random() < 0.7 else np.full(3, 0.35)
    light[floor] = wood * (1 + 0.15 * grain[floor][:, None])
    roof = (axis == 2) & ~floor
    light[roof] = rng.uniform(0.65, 0.9)
    day = rng.random() < 0.6
    for side in range(4):
        on = (axis == side % 2) & ((toward[..., side % 2] > 0) == (side < 2))
        along = point[..., 1 - side % 2]
        _furnish(light, on, along, point[..., 2], half[1 - side % 2], ceiling, rng)
        if day and (side == 0 or rng.random() < 0.4):
            _windows(light, on, along, point[..., 2], half[1 - side % 2], ceiling, rng)
    light *= _corners(point, half, ceiling)[..., None]
    if not day or rng.random() < 0.4:
        _lamps(light, roof, point, half, rng)
    return light.astype(np.float32)


def _paint(rng: np.random.Generator) -> NDArray[np.float64]:
    hue = rng.uniform(0, 2 * np.pi)
    return 0.75 + rng.uniform(0.0, 0.16) * np.cos(hue + np.array([0, 2.1, 4.2]))


def _panel(
    toward: _Plane, azimuth: float, elevation: float, half_width: float, half_height: float, soft: float
) -> NDArray[np.floating]:
    """How much of a rectangle in the plane before a direction each ray meets, with a soft rim."""
    flat = np.cos(elevation)
    ahead = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    top = np.cross(right, ahead)
    depth = toward @ ahead
    before = np.maximum(depth, 1e-3)
    x, y = np.abs(toward @ right) / before, np.abs(toward @ top) / before
    inside = smooth_step(half_width + soft, half_width - soft, x) * smooth_step(
        half_height + soft, half_height - soft, y
    )
    return np.where(depth > 0, inside, 0)


def _rectangle(
    on: NDArray[np.bool_], x: _Plane, y: _Plane, low: tuple[float, float], high: tuple[float, float]
) -> NDArray[np.bool_]:
    return on & (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])


def _furnish(
    light: NDArray[np.float64],
    on: NDArray[np.bool_],
    x: _Plane,
    y: _Plane,
    half: float,
    ceiling: float,
    rng: np.random.Generator,
) -> None:
    """Cupboards, shelves, pictures, a door: rectangles on a wall, and a skirting board."""
    light[on & (y < 0.1)] *= 0.8
    for _ in range(int(rng.integers(2, 6))):
        width, place = rng.uniform(0.4, 1.6), rng.uniform(-half, half)
        standing = rng.random() < 0.6
        bottom = 0.0 if standing else rng.uniform(1.1, 1.5)
        height = rng.uniform(0.6, 2.0) if standing else rng.uniform(0.3, 0.9)
        colour = np.clip(rng.uniform(0.05, 0.6) * (1 + rng.uniform(-0.5, 0.5, 3)), 0.02, 0.8)
        low, high = (place - width / 2, bottom), (place + width / 2, min(bottom + height, ceiling))
        light[_rectangle(on, x, y, low, high)] = colour
        if rng.random() < 0.6:  # boards and books, or the panel of a door, or what the picture shows
            for row in np.arange(low[1] + 0.08, high[1] - 0.2, 0.34):
                start = low[0] + 0.06
                while start < high[0] - 0.08:
                    thick = rng.uniform(0.05, 0.3)
                    book = np.clip(rng.uniform(0.05, 0.7) * (1 + rng.uniform(-0.6, 0.6, 3)), 0.02, 0.9)
                    end = (min(start + thick, high[0] - 0.06), row + rng.uniform(0.15, 0.28))
                    light[_rectangle(on, x, y, (start, row), end)] = book
                    start += thick + 0.01


def _windows(
    light: NDArray[np.float64],
    on: NDArray[np.bool_],
    x: _Plane,
    y: _Plane,
    half: float,
    ceiling: float,
    rng: np.random.Generator,
) -> None:
    """One to three windows: bright, blue above and green below, with bars."""
    count = int(rng.integers(1, 4))
    width, bottom, top = min(rng.uniform(0.7, 1.4), 1.6 * half / count), rng.uniform(0.4, 1.0), ceiling - 0.3
    power = rng.uniform(8, 22)
    for number in range(count):
        place = (number + 0.5) / count * 2 * half - half
        low, high = (place - width / 2, bottom), (place + width / 2, top)
        light[_rectangle(on, x, y, (low[0] - 0.08, low[1] - 0.08), (high[0] + 0.08, high[1] + 0.08))] = 0.85
        pane = _rectangle(on, x, y, low, high)
        share = np.clip((y[pane] - 1.1) / 0.3, 0, 1)[:, None]
        light[pane] = power * (np.array([0.22, 0.26, 0.14]) * (1 - share) + np.array([0.85, 0.97, 1.15]) * share)
        bars = (np.abs(x - place) < 0.025) | (np.abs(y - (low[1] + high[1]) / 2) < 0.025)
        light[pane & bars] = 0.6


def _lamps(
    light: NDArray[np.float64],
    roof: NDArray[np.bool_],
    point: _Plane,
    half: NDArray[np.float64],
    rng: np.random.Generator,
) -> None:
    """One to four lamps in a row on the ceiling, or tubes."""
    power, warm = rng.uniform(25, 60), np.array([1.0, rng.uniform(0.78, 1.0), rng.uniform(0.5, 1.0)])
    shift = rng.uniform(-0.4, 0.4) * half[1]
    count = int(rng.integers(1, 5))
    tube = rng.random() < 0.5
    for place in (np.arange(count) + 0.5) / count * 2 * half[0] - half[0]:
        dx, dy = point[..., 0] - place, point[..., 1] - shift
        shape = (np.abs(dx) < 0.09) & (np.abs(dy) < 0.7) if tube else dx * dx + dy * dy < 0.09
        light[roof & shape] = power * warm


def _corners(point: _Plane, half: NDArray[np.float64], ceiling: float) -> NDArray[np.floating]:
    """Rooms are darker towards their edges."""
    gaps = [half[0] - np.abs(point[..., 0]), half[1] - np.abs(point[..., 1]), point[..., 2], ceiling - point[..., 2]]
    second = np.sort(np.stack(gaps), axis=0)[1]  # the nearest is the wall itself
    return 0.55 + 0.45 * (1 - np.exp(-second / 0.35))
