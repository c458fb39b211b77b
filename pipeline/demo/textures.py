"""Colours of things: solid textures for objects, painted pictures for flat surroundings.

All are rich at every scale, since the videos exist to be matched: SIFT needs blobs, dense stereo needs grain. A solid
texture is a function of the surface point alone, so it runs over seams and parts as if carved from one block.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common import seeds
from pipeline.geometry import Floats

PATTERNS = ("marble", "bands", "cells", "speckle", "wood", "patches", "checks")
"""Names of the solid patterns."""

PART_HUES = {
    "back": 0.78,
    "base": 0.66,
    "body": 0.57,
    "cabin": 0.48,
    "cap": 0.93,
    "frame": 0.70,
    "handle": 0.02,
    "head": 0.86,
    "inside": 0.52,
    "knob": 0.97,
    "leg": 0.35,
    "lid": 0.13,
    "neck": 0.42,
    "seat": 0.09,
    "shade": 0.14,
    "stem": 0.30,
    "tail": 0.90,
    "top": 0.07,
    "wheel": 0.73,
    "wing": 0.16,
}
"""Base hue of each part name: a handle is reddish on every object, whatever its family."""

_LATTICE = 64


@functools.cache
def _lattice() -> NDArray[np.float32]:
    """White noise on a periodic lattice, the same for everybody; textures differ by where they read it."""
    return seeds.generator("demo", "lattice").random(_LATTICE**3, dtype=np.float32)


def noise(points: Floats) -> Floats:
    """Value noise in [0, 1] at points (N, 3): white noise on the integers, trilinear between, period 64."""
    floor = np.floor(points)
    f = (points - floor).astype(np.float32)
    low = floor.astype(np.int64) % _LATTICE
    high = (low + 1) % _LATTICE
    x0, x1 = low[:, 0] * _LATTICE**2, high[:, 0] * _LATTICE**2
    y0, y1 = low[:, 1] * _LATTICE, high[:, 1] * _LATTICE
    z0, z1 = low[:, 2], high[:, 2]
    lattice = _lattice()

    def along_z(xy: NDArray[np.int64]) -> Floats:
        near = lattice[xy + z0]
        return near + f[:, 2] * (lattice[xy + z1] - near)

    near = along_z(x0 + y0)
    near += f[:, 1] * (along_z(x0 + y1) - near)
    far = along_z(x1 + y0)
    far += f[:, 1] * (along_z(x1 + y1) - far)
    return near + f[:, 0] * (far - near)


def fractal_noise(points: Floats, octaves: int) -> Floats:
    """Octaves of `noise`, each at twice the frequency and half the height of the last; about [0, 1], mean 0.5."""
    total = np.zeros(len(points), np.float32)
    for octave in range(octaves):
        # a shift between octaves hides that all read one lattice
        total += (noise(points * 2.03**octave + 17.3 * octave) - 0.5) / 2**octave
    return total / 1.3 + 0.5


def cells(points: Floats) -> tuple[Floats, Floats]:
    """Voronoi cells, one jittered site a unit cube: a random value in [0, 1] for each cell, and the border's distance.

    The second is (d2 - d1) of the distances to the two nearest sites: 0 on the border.
    """
    cube = np.floor(points).astype(np.int64)
    nearest = np.full(len(points), np.inf, np.float32)
    second = nearest.copy()
    value = np.zeros(len(points), np.float32)
    lattice = _lattice()
    for step in np.ndindex(3, 3, 3):
        x, y, z = ((cube + np.subtract(step, 1)) % _LATTICE).T
        index = (x * _LATTICE + y) * _LATTICE + z
        # a site's three coordinates and its value are read at four far-apart places of the lattice
        shift = (((np.array(k * 65_537 + 11) + index) % _LATTICE**3) for k in range(4))
        jitter = np.stack([lattice[next(shift)] for _ in range(3)], axis=1)
        offset = (cube + np.subtract(step, 1) - points).astype(np.float32) + 0.15 + 0.7 * jitter
        distance = np.einsum("ij,ij->i", offset, offset)
        closer = distance < nearest
        second = np.where(closer, nearest, np.minimum(second, distance))
        value = np.where(closer, lattice[next(shift)], value)
        nearest = np.where(closer, distance, nearest)
    return value, np.sqrt(second) - np.sqrt(nearest)


@dataclass(frozen=True)
class SolidTexture:
    """A colour for every point of space.

    Attributes:
        pattern: one of `PATTERNS`.
        palette: (4, 3) RGB in [0, 1] that the pattern runs through.
        turn: (3, 3) and shift (3,): where in the pattern's space the object sits.
        frequency: features of the pattern per unit of length.
        grain: height of the fine noise that every pattern carries, relative to brightness.
    """

    pattern: str
    palette: Floats
    turn: Floats
    shift: Floats
    frequency: float
    grain: float

    def colour(self, points: Floats) -> Floats:
        """RGB (N, 3) float in [0, 1] at surface points (N, 3)."""
        local = points @ self.turn.T
        t = np.clip(self._pattern(local * self.frequency + self.shift), 0, 1)
        steps = np.linspace(0, 1, len(self.palette))
        colours = np.stack([np.interp(t, steps, channel) for channel in self.palette.T], axis=1)
        fine = noise(local * 95 + self.shift) - 0.5
        fine += noise(local * 38 - self.shift) - 0.5
        fine += noise(local * 14 + 2 * self.shift) - 0.5
        return np.clip(colours * (1 + self.grain * fine)[:, None], 0, 1)

    def _pattern(self, p: Floats) -> Floats:
        match self.pattern:
            case "marble":
                return 0.5 + 0.5 * np.sin(2 * np.pi * (p[:, 0] * 0.7 + 2.2 * fractal_noise(p * 0.8, 4)))
            case "bands":
                wave = np.sin(2 * np.pi * (p[:, 2] + 0.35 * fractal_noise(p, 3)))
                return 0.5 + 0.42 * np.tanh(4 * wave) + 0.35 * (fractal_noise(p * 3, 3) - 0.5)
            case "cells":
                value, border = cells(p * 1.3)
                return np.where(border < 0.08, 0.0, 0.15 + 0.85 * value)
            case "speckle":
                spots = (noise(p * 3.1) > 0.72) * 0.65 + (noise(p * 6.7 + 5) > 0.74) * 0.35
                return 0.35 * fractal_noise(p * 0.9, 3) + spots
            case "wood":
                radius = np.hypot(p[:, 0], p[:, 1]) + 0.5 * fractal_noise(p * (1, 1, 0.25), 4)
                return 0.5 + 0.5 * np.sin(2 * np.pi * radius * 1.6) * (0.5 + noise(p * (7, 7, 1.2)))
            case "patches":
                return np.round(fractal_noise(p, 4) * 4.6 - 0.8) / 3
            case "checks":
                bent = p + 0.18 * (noise(p * 1.7)[:, None] - 0.5)
                parity = np.floor(bent * 1.1).sum(1) % 2
                return 0.2 + 0.55 * parity + 0.5 * (fractal_noise(p * 2.5, 3) - 0.5)
        raise ValueError(self.pattern)


def random_texture(rng: np.random.Generator, part: str | None = None) -> SolidTexture:
    """A texture for one part of one instance: the part name gives the hue, chance gives the rest (any hue for None)."""
    hue = PART_HUES[part] + rng.normal(0, 0.018) if part else rng.random()
    saturation, value = rng.uniform(0.5, 0.8), rng.uniform(0.75, 1.0)
    palette = [
        hsv_to_rgb(hue + rng.normal(0, 0.02), saturation, value * 0.45),
        hsv_to_rgb(hue + rng.normal(0, 0.015), saturation, value * 0.8),
        hsv_to_rgb(hue, saturation, value),
        hsv_to_rgb(hue + rng.normal(0, 0.025), saturation * 0.4, min(1.0, value * 1.25)),
    ]
    order = rng.permutation(4)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return SolidTexture(
        pattern=str(rng.choice(PATTERNS)),
        palette=np.array(palette)[order],
        turn=turn,
        shift=rng.uniform(0, _LATTICE, 3),
        frequency=float(rng.uniform(6.5, 11)),
        grain=float(rng.uniform(0.4, 0.65)),
    )


def hsv_to_rgb(hue: float, saturation: float, value: float) -> Floats:
    """RGB (3,) in [0, 1]; the hue is periodic with 1."""
    sector = (np.array([5, 3, 1]) + 6 * hue) % 6
    return value * (1 - saturation * np.clip(np.minimum(sector, 4 - sector), 0, 1))


def plane_noise(rng: np.random.Generator, height: int, width: int, coarsest: int, octaves: int) -> Floats:
    """Fractal noise (H, W) float32, mean 0, deviation 1, of smooth random grids from `coarsest` pixels a cell down."""
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        cell = max(1, coarsest >> octave)
        coarse = rng.standard_normal((height // cell + 2, width // cell + 2), dtype=np.float32)
        grid = cv2.resize(coarse, None, fx=cell, fy=cell, interpolation=cv2.INTER_CUBIC)
        total += grid[:height, :width] * 0.7**octave
    return (total - total.mean()) / max(float(total.std()), 1e-6)


def painted_plane(rng: np.random.Generator, height: int, width: int, step: int, style: str) -> NDArray[np.uint8]:
    """A picture (H, W, 3) uint8 RGB for a flat surface.

    Args:
        step: pixels of the style's typical feature (a tile, a board, a shape).
        style: "tiles", "boards", "shapes" or "paper".
    """
    hue, saturation, value = rng.random(), rng.uniform(0.08, 0.3), rng.uniform(0.5, 0.75)
    image = np.empty((height, width, 3), np.float32)
    image[:] = 255 * hsv_to_rgb(hue, saturation, value)
    if style == "tiles":
        for y in range(0, height, step):
            for x in range(0, width, step):
                tint = hsv_to_rgb(hue + rng.normal(0, 0.04), saturation, value * rng.uniform(0.65, 1.2))
                image[y : y + step - 2, x : x + step - 2] = 255 * tint
                if rng.random() < 0.3:
                    _random_shape(rng, image, (x + step // 2, y + step // 2), step * rng.uniform(0.15, 0.4), hue)
    elif style == "boards":
        for y in range(0, height, step):
            x = -int(rng.integers(0, 6 * step))
            while x < width:
                end = x + int(rng.integers(3 * step, 8 * step))
                tint = hsv_to_rgb(0.08 + rng.normal(0, 0.015), rng.uniform(0.35, 0.6), rng.uniform(0.4, 0.75))
                image[y : y + step - 2, max(x, 0) : max(end - 2, 0)] = 255 * tint
                x = end
        streaks = plane_noise(rng, height, -(-width // 8), max(2, step // 2), 4)
        image *= 1 + 0.09 * cv2.resize(streaks, (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
    elif style == "paper":
        stripes = 1 + 0.12 * np.sign(np.sin(np.arange(width) * 2 * np.pi / step + rng.random() * 6))
        image *= stripes[None, :, None]
        for _ in range(int(1.2 * width / step)):
            _picture(rng, image, step)
    if style in ("shapes", "paper"):
        share = 1.4 if style == "shapes" else 0.35
        for _ in range(int(share * height * width / step**2)):
            centre = (int(rng.integers(width)), int(rng.integers(height)))
            size = step * (rng.uniform(0.12, 0.55) if style == "shapes" else rng.uniform(0.06, 0.2))
            _random_shape(rng, image, centre, size, hue + rng.normal(0, 0.12))
    image *= 1 + 0.1 * plane_noise(rng, height, width, step, 5)[..., None]
    image *= 1 + 0.07 * plane_noise(rng, height, width, 4, 2)[..., None]
    return np.clip(image, 0, 255).astype(np.uint8)


def _random_shape(rng: np.random.Generator, image: Floats, centre: tuple[int, int], size: float, hue: float) -> None:
    colour = [float(c) for c in 255 * hsv_to_rgb(hue, rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.95))]
    kind = rng.integers(3)
    if kind == 0:
        cv2.circle(image, centre, max(1, round(size)), colour, -1 if rng.random() < 0.6 else max(1, round(size / 4)))
    else:
        corners = int(rng.integers(3, 7))
        angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
        reach = size * rng.uniform(0.5, 1.2, corners)
        outline = np.stack([centre[0] + reach * np.cos(angle), centre[1] + reach * np.sin(angle)], axis=1)
        cv2.fillPoly(image, [np.round(outline).astype(np.int32)], colour)


def _picture(rng: np.random.Generator, image: Floats, step: int) -> None:
    """A framed picture hung somewhere on a wall."""
    height, width = (int(step * rng.uniform(0.5, 1.3)) for _ in range(2))
    y, x = int(rng.integers(0, max(1, image.shape[0] - height))), int(rng.integers(0, max(1, image.shape[1] - width)))
    canvas = image[y : y + height, x : x + width]
    hue = rng.random()
    canvas[:] = 255 * hsv_to_rgb(hue, 0.4, rng.uniform(0.5, 0.9))
    for _ in range(14):
        centre = (int(rng.integers(canvas.shape[1])), int(rng.integers(canvas.shape[0])))
        _random_shape(rng, canvas, centre, step * rng.uniform(0.05, 0.25), hue + rng.normal(0, 0.15))
    frame = [float(c) for c in 255 * hsv_to_rgb(0.08, 0.5, rng.uniform(0.1, 0.4))]
    cv2.rectangle(image, (x, y), (x + width - 1, y + height - 1), frame, max(1, step // 14))
