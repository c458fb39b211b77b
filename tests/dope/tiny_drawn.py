"""Drawn objects that can be told apart by their two colours: what a tiny network can learn within seconds."""

from __future__ import annotations

import colorsys
from pathlib import Path

import numpy as np
import pytest
import tiny_shards
import tiny_views
from numpy.typing import NDArray
from tiny_shards import TinyPair, texture

CLASS = 100
"""Object seeds of one class: those of the same hundred."""


def drawn_pair(object_seed: int, pair_seed: int, size: int = 64, n_points: int = 200) -> TinyPair:
    """A disc with a stripe, turned and moved in each view, before a texture; its class has the disc's hue, the object
    that of the stripe."""
    one, generator = np.random.default_rng([object_seed, 1]), np.random.default_rng([object_seed, pair_seed])
    hues = (object_seed // CLASS * 0.381966) % 1, one.random()
    images, masks = [], []
    for _ in range(2):
        centre, turn = size / 2 + generator.uniform(-0.08, 0.08, 2) * size, generator.uniform(0, np.pi)
        y, x = np.mgrid[:size, :size] + 0.5
        x, y = x - centre[0], y - centre[1]
        mask = np.hypot(x, y) < 0.36 * size
        stripe = np.abs(x * np.sin(turn) - y * np.cos(turn)) < 0.15 * size
        seen = np.where(stripe[..., None], colour(hues[1], 0.6), colour(hues[0], 1.0))
        images.append(np.where(mask[..., None], seen, texture(generator, size)).astype(np.uint8))
        masks.append((255 * mask).astype(np.uint8))
    middle = np.full((n_points, 4), size / 2, np.float32)
    return TinyPair(images, masks, middle, np.eye(2, 3))


def colour(hue: float, value: float) -> NDArray[np.float64]:
    """BGR in 0 to 255."""
    return 255 * np.array(colorsys.hsv_to_rgb(hue % 1, 1.0, value))[::-1]


def draw_pairs(folder: Path, monkeypatch: pytest.MonkeyPatch, *, objects: int, held_out: int) -> Path:
    """Shards with 4 pairs of each object and one of each held-out one, all with hues of their own."""

    def own_hues(object_seed: int, *arguments: int) -> TinyPair:
        return drawn_pair(CLASS * object_seed, *arguments)

    monkeypatch.setattr(tiny_shards, "make_pair", own_hues)
    return tiny_shards.write_shards(
        folder, n_objects=objects, pairs=4, val_objects=held_out, val_pairs=1, size=32, n_points=10, per_shard=512
    )


def draw_views(folder: Path, monkeypatch: pytest.MonkeyPatch, *, categories: int, objects: int) -> Path:
    """Single views, 4 of each object, with classes; the last object of each is held out."""
    monkeypatch.setattr(tiny_views, "make_pair", drawn_pair)
    return tiny_views.write_views(folder, categories=categories, objects=objects, views=4, size=32)
