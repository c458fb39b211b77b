"""Procedural floors: wood, tiles, stone, cloth, gravel and others, each a picture that wraps around, with heights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common import seeds
from pipeline.render.noise import smooth_step, wrapping_noise

SIZE = 512
_Plane = NDArray[Any]  # (SIZE, SIZE) or (SIZE, SIZE, 3)


@dataclass(frozen=True)
class Floor:
    """See `grounds.Material`, whose fields these are."""

    albedo: NDArray[np.uint8]
    bumps: NDArray[np.float32] | None
    roughness: float
    side: float


def floor(number: int) -> Floor:
    """The floor of a number (0 ... COUNT - 1): a kind, and a colouring of it."""
    kind, colours = _FLOORS[number]
    rng = seeds.generator("floor", number)
    colour, heights, roughness, side = kind(rng, np.asarray(colours, np.float32))
    albedo = np.clip(np.rint(255 * colour), 0, 255).astype(np.uint8)
    bumps = None if heights is None else np.ascontiguousarray(heights, np.float32)
    return Floor(np.ascontiguousarray(albedo), bumps, roughness, side)


# Each kind: a generator and sRGB colours (K, 3) to colour (SIZE, SIZE, 3), heights or None, roughness, side.
_Made = tuple[_Plane, _Plane | None, float, float]
_Kind = Callable[[np.random.Generator, _Plane], _Made]

_Y, _X = np.mgrid[0:SIZE, 0:SIZE].astype(np.float32)


def _noise(rng: np.random.Generator, coarsest: int, octaves: int, fade: float = 0.6) -> _Plane:
    return wrapping_noise(rng, SIZE, SIZE, coarsest, octaves, fade)


def _mix(a: _Plane, b: _Plane, share: _Plane) -> _Plane:
    return np.asarray(a + (b - a) * np.asarray(share, np.float32)[..., None], np.float32)


def _stretched(rng: np.random.Generator, along: int, across: int, octaves: int) -> _Plane:
    """Noise (SIZE, SIZE) that is `along` px long in x and `across` px in y."""
    ratio = max(1, along // across)
    small = wrapping_noise(rng, SIZE, SIZE // ratio, across, octaves)
    big = np.pad(small, ((0, 0), (2, 2)), mode="wrap")
    wide = cv2.resize(big, (SIZE + 4 * ratio, SIZE), interpolation=cv2.INTER_CUBIC)
    return wide[:, 2 * ratio : 2 * ratio + SIZE]


def _blocks(rows: int, columns: int, shifts: _Plane) -> tuple[_Plane, _Plane]:
    """A running bond: each pixel's block, and its distance in px to the block's edge."""
    height, width = SIZE // rows, SIZE / columns
    row = (_Y // height).astype(np.int64)
    x = (_X + shifts[row] * width) % SIZE
    column = (x // width).astype(np.int64)
    u, v = x - column * width + 0.5, _Y - row * height + 0.5
    return row * columns + column, np.minimum(np.minimum(u, width - u), np.minimum(v, height - v))


def _planks(rng: np.random.Generator, colours: _Plane) -> _Made:
    rows, columns = int(rng.choice([4, 8])), 2
    block, edge = _blocks(rows, columns, rng.random(rows).astype(np.float32))
    shift = rng.integers(0, SIZE, (rows * columns, 2))
    long, fine = _stretched(rng, 256, 8, 4), _stretched(rng, 64, 2, 2)
    y, x = (_Y.astype(np.int64) + shift[block, 0]) % SIZE, (_X.astype(np.int64) + shift[block, 1]) % SIZE
    grain = long[y, x]
    rings = np.sin(6 * grain + 0.5 * fine)
    tone = rng.normal(0, 0.35, rows * columns)[block]
    colour = _mix(
        colours[0], colours[1], np.clip(0.5 + 0.22 * rings + 0.12 * fine + tone * 0.5, 0, 1).astype(np.float32)
    )
    gap = smooth_step(0.6, 2.2, edge)
    colour = colour * (0.35 + 0.65 * gap)[..., None]
    return colour, 0.006 * gap + 0.0006 * rings, rng.uniform(0.35, 0.6), 2.4


def _tiles(rng: np.random.Generator, colours: _Plane) -> _Made:
    count = int(rng.choice([4, 8]))
    block, edge = _blocks(count, count, np.zeros(count, np.float32))
    shade = rng.normal(0, 0.03, count * count)[block]
    stain = _noise(rng, 64, 5)
    face = colours[0] * (1 + shade + 0.03 * stain)[..., None]
    joint = smooth_step(1.5, 3.5, edge)
    grain = 1 + 0.08 * _noise(rng, 4, 2)
    colour = _mix(colours[1] * grain[..., None], face, joint)
    return colour, 0.008 * smooth_step(1.0, 6.0, edge), rng.uniform(0.15, 0.4), 2.0


def _checker(rng: np.random.Generator, colours: _Plane) -> _Made:
    count = int(rng.choice([4, 6, 8]))
    cell = SIZE / count
    odd = ((_X // cell + _Y // cell) % 2).astype(np.float32)
    stain = _noise(rng, 128, 6)
    colour = _mix(colours[0], colours[1], odd) * (1 + 0.04 * stain)[..., None]
    u, v = _X % cell + 0.5, _Y % cell + 0.5
    edge = np.minimum(np.minimum(u, cell - u), np.minimum(v, cell - v))
    return colour * (0.75 + 0.25 * smooth_step(0.4, 1.6, edge))[..., None], None, rng.uniform(0.15, 0.45), 2.0


def _bricks(rng: np.random.Generator, colours: _Plane) -> _Made:
    rows, columns = 8, 4
    block, edge = _blocks(rows, columns, np.where(np.arange(rows) % 2, 0.5, 0.0).astype(np.float32))
    rough = _noise(rng, 16, 4)
    shade = rng.normal(0, 0.14, rows * columns)[block]
    face = colours[0] * (1 + shade + 0.08 * rough)[..., None]
    inside = smooth_step(2.0, 5.0, edge + 0.7 * rough)
    colour = _mix(colours[1] * (1 + 0.08 * _noise(rng, 4, 2))[..., None], face, inside)
    return colour, 0.009 * inside + 0.001 * rough, 0.85, 2.0


def _concrete(rng: np.random.Generator, colours: _Plane) -> _Made:
    large, fine = _noise(rng, 128, 5, 0.7), _noise(rng, 8, 4, 0.8)
    colour = _mix(colours[0], colours[1], np.clip(0.5 + 0.25 * large, 0, 1)) * (1 + 0.03 * fine)[..., None]
    holes = smooth_step(2.3, 2.9, _noise(rng, 8, 2))
    return colour * (1 - 0.35 * holes)[..., None], 0.0012 * fine - 0.004 * holes, rng.uniform(0.6, 0.9), 2.5


def _marble(rng: np.random.Generator, colours: _Plane) -> _Made:
    warp = _noise(rng, 128, 5, 0.55)
    veins = np.abs(_noise(rng, 128, 4, 0.5) + 0.35 * warp)
    thin = np.exp(-veins * 9) + 0.5 * np.exp(-np.abs(_noise(rng, 64, 5, 0.55)) * 16)
    colour = _mix(colours[0] * (1 + 0.03 * warp)[..., None], colours[1], np.clip(thin, 0, 1) * 0.85)
    return colour, None, rng.uniform(0.08, 0.25), 2.5


def _cloth(rng: np.random.Generator, colours: _Plane) -> _Made:
    threads = int(rng.choice([48, 64, 96]))
    a, b = 2 * np.pi * threads * _X / SIZE, 2 * np.pi * threads * _Y / SIZE
    over = np.cos(a / 2) * np.cos(b / 2) > 0
    weave = np.where(over, np.abs(np.sin(a)), np.abs(np.sin(b))).astype(np.float32)
    uneven = _stretched(rng, 128, 4, 3) + _stretched(rng, 128, 4, 3).T
    colour = _mix(colours[1], colours[0], over.astype(np.float32)) * (0.82 + 0.18 * weave + 0.04 * uneven)[..., None]
    stripes = rng.random() < 0.5
    if stripes:
        band = smooth_step(0.1, 0.3, np.cos(2 * np.pi * 4 * _X / SIZE) + 0.2).astype(np.float32)
        colour = _mix(colour, colour * (colours[1] / np.maximum(colours[0], 0.05)), 0.8 * band)
    return colour, 0.002 * weave, 0.95, 1.2


def _carpet(rng: np.random.Generator, colours: _Plane) -> _Made:
    tuft, blotch = _noise(rng, 4, 3, 0.9), _noise(rng, 64, 4)
    share = np.clip(0.5 + 0.3 * tuft + 0.12 * blotch, 0, 1)
    return _mix(colours[0], colours[1], share), 0.0012 * tuft, 1.0, 1.6


def _gravel(rng: np.random.Generator, colours: _Plane) -> _Made:
    count = int(rng.integers(18, 34))
    cell = SIZE / count
    sites = (np.moveaxis(np.mgrid[0:count, 0:count], 0, -1) + rng.uniform(0.1, 0.9, (count, count, 2))) * cell
    y, x = (_Y // cell).astype(np.int64), (_X // cell).astype(np.int64)
    nearest = np.full((SIZE, SIZE), np.inf, np.float32)
    second, owner = nearest.copy(), np.zeros((SIZE, SIZE), np.int64)
    for dy, dx in np.ndindex(5, 5):
        row, column = y + dy - 2, x + dx - 2
        site = sites[row % count, column % count] + np.stack([row - row % count, column - column % count], -1) * cell
        away = np.hypot(site[..., 0] - _Y - 0.5, site[..., 1] - _X - 0.5).astype(np.float32)
        closer = away < nearest
        second = np.where(closer, nearest, np.minimum(second, away))
        owner = np.where(closer, (row % count) * count + column % count, owner)
        nearest = np.minimum(nearest, away)
    gap = (second - nearest) / cell
    dome = smooth_step(-0.05, 0.4, gap).astype(np.float32)
    tint = rng.normal(0, 0.13, count * count)[owner]
    share = np.clip(rng.random(count * count)[owner], 0, 1)
    face = _mix(colours[0], colours[1], share) * (1 + tint + 0.05 * _noise(rng, 8, 3))[..., None]
    return face * (0.3 + 0.7 * dome)[..., None], (0.35 * cell / SIZE * dome).astype(np.float32), 0.9, 1.8


def _grass(rng: np.random.Generator, colours: _Plane) -> _Made:
    fine = 0.5 * (_stretched(rng, 8, 2, 2) + _stretched(rng, 8, 2, 2).T) + 0.5 * _noise(rng, 4, 3, 0.9)
    patch = _noise(rng, 128, 4)
    share = np.clip(0.5 + 0.28 * fine + 0.15 * patch, 0, 1)
    return _mix(colours[0], colours[1], share) * (1 + 0.12 * fine)[..., None], 0.002 * fine, 1.0, 2.5


def _sand(rng: np.random.Generator, colours: _Plane) -> _Made:
    warp = _noise(rng, 128, 4)
    ripple = np.sin(2 * np.pi * 9 * _Y / SIZE + 1.4 * warp).astype(np.float32)
    grain = _noise(rng, 2, 2)
    share = np.clip(0.5 + 0.12 * ripple + 0.1 * warp + 0.15 * grain, 0, 1)
    return _mix(colours[0], colours[1], share), 0.006 * ripple + 0.0004 * grain, 0.95, 2.5


def _paint(rng: np.random.Generator, colours: _Plane) -> _Made:
    colour = colours[0] * (1 + 0.02 * _noise(rng, 128, 6))[..., None]
    return colour.astype(np.float32), None, rng.uniform(0.3, 0.8), 3.0


def _terrazzo(rng: np.random.Generator, colours: _Plane) -> _Made:
    colour = colours[0] * (1 + 0.02 * _noise(rng, 64, 4))[..., None]
    for number in range(3):
        chip = smooth_step(1.15, 1.35, _noise(rng, (32, 16, 16)[number], 2, 0.35)).astype(np.float32)
        colour = _mix(colour, colours[1 + number % (len(colours) - 1)] * (1 + 0.2 * rng.normal()), chip)
    return colour, None, rng.uniform(0.1, 0.3), 2.0


def _cork(rng: np.random.Generator, colours: _Plane) -> _Made:
    speck = np.abs(_noise(rng, 16, 4, 0.8))
    share = np.clip(0.75 - 0.5 * speck, 0, 1)
    return _mix(colours[0], colours[1], share), -0.001 * speck, 0.9, 1.6


def _parquet(rng: np.random.Generator, colours: _Plane) -> _Made:
    """Squares of strips that lie across each other."""
    count, strips = 4, 5
    cell = SIZE // count
    turned = ((_X // cell + _Y // cell) % 2).astype(bool)
    grain = _stretched(rng, 128, 4, 3)
    along = np.where(turned, grain.T, grain)
    across = np.where(turned, _X, _Y) % cell
    strip = np.minimum((across * strips / cell).astype(np.int64), strips - 1)
    inside = across - strip * cell / strips + 0.5
    edge = np.minimum(inside, cell / strips - inside)
    u = np.where(turned, _Y, _X) % cell + 0.5
    edge = np.minimum(edge, np.minimum(u, cell - u))
    name = ((_Y // cell) * count + _X // cell).astype(np.int64) * strips + strip
    tone = rng.normal(0, 0.2, count * count * strips)[name]
    share = np.clip(0.5 + 0.2 * along + tone, 0, 1).astype(np.float32)
    gap = smooth_step(0.4, 1.6, edge)
    return _mix(colours[0], colours[1], share) * (0.5 + 0.5 * gap)[..., None], 0.003 * gap, rng.uniform(0.25, 0.5), 2.0


_FLOORS: tuple[tuple[_Kind, tuple[tuple[float, float, float], ...]], ...] = (
    (_planks, ((0.62, 0.44, 0.28), (0.45, 0.29, 0.17))),
    (_tiles, ((0.80, 0.78, 0.74), (0.55, 0.53, 0.50))),
    (_concrete, ((0.62, 0.61, 0.59), (0.50, 0.49, 0.48))),
    (_carpet, ((0.45, 0.20, 0.20), (0.62, 0.34, 0.30))),
    (_marble, ((0.88, 0.87, 0.85), (0.48, 0.47, 0.46))),
    (_gravel, ((0.60, 0.57, 0.52), (0.42, 0.40, 0.38))),
    (_cloth, ((0.78, 0.74, 0.66), (0.66, 0.61, 0.52))),
    (_checker, ((0.85, 0.84, 0.80), (0.16, 0.16, 0.18))),
    (_paint, ((0.74, 0.74, 0.72),)),
    (_parquet, ((0.70, 0.52, 0.33), (0.52, 0.36, 0.21))),
    (_grass, ((0.20, 0.33, 0.11), (0.42, 0.52, 0.20))),
    (_bricks, ((0.60, 0.33, 0.25), (0.66, 0.63, 0.58))),
    (_terrazzo, ((0.80, 0.78, 0.74), (0.42, 0.34, 0.30), (0.62, 0.52, 0.42), (0.30, 0.36, 0.34))),
    (_planks, ((0.38, 0.25, 0.16), (0.25, 0.15, 0.09))),
    (_tiles, ((0.66, 0.40, 0.28), (0.72, 0.68, 0.62))),
    (_sand, ((0.82, 0.72, 0.55), (0.68, 0.57, 0.41))),
    (_cloth, ((0.24, 0.34, 0.52), (0.17, 0.24, 0.40))),
    (_paint, ((0.42, 0.50, 0.46),)),
    (_carpet, ((0.34, 0.36, 0.40), (0.50, 0.52, 0.55))),
    (_marble, ((0.22, 0.25, 0.23), (0.66, 0.68, 0.64))),
    (_planks, ((0.80, 0.72, 0.60), (0.68, 0.58, 0.45))),
    (_checker, ((0.72, 0.30, 0.26), (0.86, 0.80, 0.70))),
    (_cork, ((0.46, 0.31, 0.19), (0.72, 0.54, 0.36))),
    (_concrete, ((0.40, 0.40, 0.41), (0.30, 0.30, 0.31))),
    (_gravel, ((0.74, 0.66, 0.54), (0.56, 0.44, 0.34))),
    (_tiles, ((0.35, 0.48, 0.55), (0.78, 0.78, 0.76))),
    (_carpet, ((0.62, 0.56, 0.44), (0.76, 0.70, 0.58))),
    (_parquet, ((0.48, 0.33, 0.21), (0.34, 0.21, 0.12))),
    (_cloth, ((0.62, 0.22, 0.20), (0.80, 0.76, 0.70))),
    (_paint, ((0.80, 0.64, 0.40),)),
    (_bricks, ((0.55, 0.54, 0.53), (0.40, 0.40, 0.39))),
    (_terrazzo, ((0.36, 0.37, 0.39), (0.80, 0.78, 0.74), (0.55, 0.50, 0.44))),
)
COUNT = len(_FLOORS)
