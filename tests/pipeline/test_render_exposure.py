"""Exposure, white balance and curve, and that both renderers' pictures are as bright."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from pipeline.render import grounds, skies
from pipeline.render.config import CyclesConfig
from pipeline.render.cycles.process import VARIABLE
from pipeline.render.cycles.renderer import CyclesRenderer
from pipeline.render.exposure import LUMINANCE, WHITE, Exposure, expose, show, to_linear, to_srgb, white_under
from pipeline.render.fast.light import lights_of
from pipeline.render.scene import Ground, Light, Part, Picture, Renderer, Scene, Surface
from tests.pipeline.fast_scenes import make
from tests.pipeline.render_scenes import even_light, ground, look_at, small_scene, sphere


def exposed(light: Light, on: Ground | None = None) -> Exposure:
    return expose(white_under(light, on), on, light.strength)


def test_srgb_has_its_fixed_points() -> None:
    light = np.array([[0.0, 0.0031308, 0.2158605, 1.0, 7.0, -1.0]], np.float32)
    np.testing.assert_array_equal(to_srgb(light), [[0, 10, 128, 255, 255, 0]])


def test_colours_are_true_up_to_a_shoulder_and_white_far_beyond() -> None:
    radiance = np.array([[0.7, 0.2, 0.05], [1.4, 0.4, 0.1], [200, 60, 20], [np.nan, -1, 0], [np.inf] * 3], np.float32)
    shown = show(radiance[None], np.ones(3))[0]
    np.testing.assert_array_equal(shown[0], to_srgb(radiance[0]))
    assert 218 < shown[1, 0] < 255 and shown[1, 1] > shown[0, 1]
    assert (shown[2] > 240).all() and (shown[4] > 250).all() and (shown[3] == 0).all()


def test_a_white_object_is_as_bright_whatever_the_panorama() -> None:
    rng = np.random.default_rng(0)
    for light in (
        even_light(),
        Light(np.full((8, 16, 3), 0.2, np.float32)),
        Light(rng.uniform(0, 2, (64, 128, 3)).astype(np.float32)),
    ):
        exposure = exposed(light)
        mean = light.panorama.reshape(-1, 3).mean(axis=0)
        assert abs(exposure.gain * float(mean.mean()) - WHITE) < 0.02
        np.testing.assert_allclose(exposure.balance, 1, atol=0.02)
    reddish = exposed(Light(np.ones((8, 16, 3), np.float32) * np.array([1.6, 0.9, 0.5], np.float32)))
    assert reddish.balance[0] < 1 < reddish.balance[1] < reddish.balance[2]
    dark, bright = (ground(-0.5, np.full((4, 4, 3), value, np.uint8)) for value in (60, 230))
    assert exposed(even_light(), dark).gain > 1.5 * exposed(even_light(), bright).gain
    assert abs(exposed(even_light(1.3)).gain / exposed(even_light()).gain - 2) < 1e-9


@pytest.mark.parametrize("number", [0, 1, 3, 4, 6])
def test_what_the_rasteriser_simplifies_of_light_hardly_changes_its_exposure(number: int) -> None:
    light = Light(skies.sky(number), 0.8, 0.7 * number)
    for on in (None, grounds.ground_material(number).at(-0.5)):
        exact, simplified = exposed(light, on), lights_of(light, on).exposure
        ratio = simplified @ LUMINANCE / (exact.gain * exact.balance @ LUMINANCE)
        assert 0.93 < ratio < 1.03


@pytest.fixture
def renderers() -> Iterator[tuple[Renderer, Renderer]]:
    if not os.environ.get(VARIABLE):
        pytest.skip(f"needs an interpreter with bpy, named by ${VARIABLE}")
    blender = CyclesRenderer(CyclesConfig(samples=16))
    yield make(), blender
    blender.close()


def mean_light(pictures: Iterable[Picture], *, of_object: bool = True) -> float:
    shown = [to_linear(picture.image[picture.mask == of_object] / 255.0) for picture in pictures]
    return float(np.concatenate(shown).mean())


def test_the_same_scene_is_as_bright_by_both_renderers(renderers: tuple[Renderer, Renderer]) -> None:
    cameras = look_at(0.3, 1.0, 2.0, size=(48, 48), f=(40, 40)), look_at(3.4, 0.6, 2.0, size=(48, 48), f=(40, 40))
    surface = Surface("colour", ((0.8, 0.8, 0.8),), roughness=0.9)
    for number in (0, 3, 6):
        scene = small_scene(*cameras, part=sphere(rings=24), on=ground(-0.5), surface=surface)
        scene = replace(scene, light=Light(skies.sky(number), 0.65, 1.0))
        pictures = [list(renderer.render(scene)) for renderer in renderers]
        for of_object in (True, False):
            fast, blender = (mean_light(each, of_object=of_object) for each in pictures)
            assert abs(np.log(fast / blender)) < 0.1, f"panorama {number}, object {of_object}"


def test_colours_between_vertices_are_the_same_by_both_renderers(renderers: tuple[Renderer, Renderer]) -> None:
    corners = np.array([[0.0, -0.5, -0.5], [0, 0.5, -0.5], [0, 0.5, 0.5], [0, -0.5, 0.5]])
    colours = np.array([[0.0, 0, 0], [0.1, 0, 0], [1, 1, 1], [0.9, 1, 0.8]])
    card = Part(corners, np.array([[0, 1, 2], [0, 2, 3]]), colours=colours)
    scene: Scene = small_scene(look_at(0.0, 1.5, 2.0), part=card)
    (fast,), (blender,) = (list(renderer.render(scene)) for renderer in renderers)
    inside = fast.mask & blender.mask
    assert np.abs(fast.image[inside].astype(int) - blender.image[inside]).mean() < 6
