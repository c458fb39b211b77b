"""What is drawn for an object: how it looks, what it stands on, what lights it, where it is seen from."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np

from dope.common import seeds
from pipeline.geometry import Camera
from pipeline.render import grounds, skies
from pipeline.render.config import LookConfig, RenderConfig
from pipeline.render.scene import Ground, Light, Model, Scene, Shot, Surface

STUDIO = 19
"""The procedural panorama that lights recipe plain: three soft boxes."""
GREY = (0.62, 0.62, 0.62)
Colour = tuple[float, float, float]
T = TypeVar("T")


@dataclass(frozen=True)
class Defaults:
    """What a recipe says where the settings say "recipe"."""

    surface: str
    ground: bool


RECIPES = {
    "modelnet": Defaults("own", True),
    "shapenet": Defaults("own", True),
    "abc": Defaults("random", True),
    "procedural": Defaults("random", True),
    "plain": Defaults("own", False),
}


def draw_scene(model: Model, cameras: Sequence[Camera], config: RenderConfig, name: str) -> Scene:
    """The scene of a posed object, a function of the settings, the seed and the object's name.

    Args:
        model: in its pose (`pose.posed`).
        cameras: of the views, two a pair; each pair finds the object somewhere else on the ground.
        name: id of the object.
    """
    look, seed = config.look, ("render", config.seed, name)
    rng = seeds.generator("look", *seed)
    defaults = RECIPES[config.recipe]
    kind = defaults.surface if look.surface == "recipe" else look.surface
    surface = draw_surface(kind, model, rng)
    light = draw_light(look, rng) if config.recipe != "plain" or look.hdris else Light(skies.sky(STUDIO))
    has_ground = defaults.ground if look.ground == "recipe" else look.ground == "on"
    ground = draw_ground(look, float(model.vertices()[:, 2].min()), rng) if has_ground else None
    places = rng.uniform(-look.places, look.places, (len(cameras) // 2 + 1, 2))
    shots = tuple(Shot(camera, tuple(map(float, places[i // 2]))) for i, camera in enumerate(cameras))  # type: ignore[arg-type]
    return Scene(model, surface, ground, light, shots, seeds.derive_seed("renderer", *seed) % 2**31)


def draw_surface(kind: str, model: Model, rng: np.random.Generator) -> Surface:
    """How an object looks: "own", "grey", or "random", which leaves objects alone that have a look of their own."""
    if kind == "grey":
        return Surface("colour", (GREY,))
    if kind == "own" or model.has_look:
        return Surface("own", (GREY,))
    roughness, seed, cells = float(rng.uniform(0.3, 0.9)), int(rng.integers(2**31)), float(rng.uniform(4, 14))
    draw = rng.uniform()
    if draw < 0.5:
        return Surface("colour", (_colour(rng),), roughness=roughness)
    if draw < 0.75:
        palette = tuple(_colour(rng) for _ in range(8))
    else:
        hue = float(rng.uniform())
        palette = tuple(_colour(rng, (hue + float(rng.normal(0, 0.02))) % 1) for _ in range(8))
    return Surface("voronoi", palette, cells, roughness, seed)


def _colour(rng: np.random.Generator, hue: float | None = None) -> Colour:
    saturation, value = rng.uniform(0.25, 0.95), rng.uniform(0.3, 0.95)
    return colorsys.hsv_to_rgb(float(rng.uniform()) if hue is None else hue, saturation, value)


def draw_light(look: LookConfig, rng: np.random.Generator) -> Light:
    """One of the panoramas, its strength and direction."""
    panorama = _choice(look.hdris, skies.find_skies, skies.read_sky, skies.sky, skies.COUNT, rng)
    return Light(panorama, float(rng.uniform(*look.strength)), float(rng.uniform(0, 2 * np.pi)))


def draw_ground(look: LookConfig, height: float, rng: np.random.Generator) -> Ground:
    """One of the materials, on a plane at `height`."""
    material = _choice(
        look.materials, grounds.find_materials, grounds.read_material, grounds.ground_material, grounds.COUNT, rng
    )
    return material.at(height)


def _choice(
    folder: str | None,
    find: Callable[[Path], list[Path]],
    read: Callable[[Path], T],
    make: Callable[[int], T],
    count: int,
    rng: np.random.Generator,
) -> T:
    number = rng.uniform()  # one draw, whatever there is to choose from
    if folder is None:
        return make(int(number * count))
    paths = _found(find, folder)
    return read(paths[int(number * len(paths))])


@lru_cache(maxsize=8)
def _found(find: Callable[[Path], list[Path]], folder: str) -> list[Path]:
    return find(Path(folder))
