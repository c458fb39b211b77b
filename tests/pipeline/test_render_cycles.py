"""Pictures of Blender's path tracer against closed formulas. The interpreter comes from $DOPE_BPY_PYTHON."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator

import numpy as np
import pytest

from pipeline.children import Limits
from pipeline.geometry import Camera
from pipeline.render.config import CyclesConfig
from pipeline.render.cycles.process import VARIABLE
from pipeline.render.cycles.renderer import CyclesRenderer
from pipeline.render.exposure import WHITE, to_linear, to_srgb
from pipeline.render.scene import Light, Model, Part, Picture, Scene, Shot, Surface
from tests.pipeline.render_scenes import (
    box,
    box_depth,
    even_light,
    ground,
    look_at,
    plane_depth,
    rays,
    small_scene,
    sphere,
    sphere_depth,
)

pytestmark = pytest.mark.skipif(
    not os.environ.get(VARIABLE), reason=f"needs an interpreter with bpy, named by ${VARIABLE}"
)
HALF = np.array([0.5, 0.4, 0.3])
CHEAP = CyclesConfig(samples=4, denoise=False, bounces=1)


@pytest.fixture(scope="module")
def blender() -> Iterator[CyclesRenderer]:
    rendering = CyclesRenderer(CHEAP, Limits(minutes=1))
    yield rendering
    rendering.close()


def render_one(blender: CyclesRenderer, scene: Scene) -> Picture:
    (picture,) = blender.render(scene)
    return picture


CAMERAS = {
    "as the paper's": look_at(0.3, 1.0, 2.5),
    "nearly level": look_at(2.0, 1.39, 1.8),
    "wide, off centre, oblong pixels": look_at(4.0, 0.6, 3.0, size=(80, 48), f=(60.0, 45.0), centre=(31.3, 29.6)),
    "tall, oblong the other way": look_at(5.0, 0.4, 2.5, size=(40, 64), f=(44.0, 52.8), centre=(22.5, 30.1)),
}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_mask_and_depth_of_a_box_on_the_ground_are_exact(blender: CyclesRenderer, camera: Camera) -> None:
    picture = render_one(blender, small_scene(camera, on=ground(-0.3)))
    solid, plane = box_depth(camera, HALF), plane_depth(camera, -0.3 - 1e-5)
    assert np.count_nonzero(picture.mask != (solid < np.inf)) <= 1  # a ray along an edge may go either way
    same = picture.mask == (solid < np.inf)
    expected = np.minimum(solid, plane)
    assert picture.mask.sum() > 100 and np.abs(picture.depth - expected)[picture.mask & same].max() < 3e-6
    near, sky = same & (expected < 50), same & (expected == np.inf)
    assert np.abs(picture.depth / expected - 1)[near].max() < 1e-5
    assert (picture.depth[sky] == 0).all()
    assert (picture.depth[same & (expected < 1000)] > 0).all()


def test_mask_and_depth_of_a_sphere_are_exact_up_to_its_facets(blender: CyclesRenderer) -> None:
    camera = look_at(1.0, 0.9, 2.2, centre=(30.2, 33.7))
    picture = render_one(blender, small_scene(camera, part=sphere()))
    expected = sphere_depth(camera, 0.5)
    assert np.count_nonzero(picture.mask != (expected < np.inf)) <= 3
    both = picture.mask & (expected < np.inf)
    error = picture.depth[both] - expected[both]
    # its chords lie up to 7.5e-5 within; at the outline, where the ray grazes, that is more along the ray
    assert np.median(error) < 1e-4 and np.quantile(error, 0.01) > -1e-6 and np.quantile(error, 0.98) < 2e-3


def test_pairs_agree(blender: CyclesRenderer) -> None:
    """Depth of one view unprojected, projected into the other: the surface there, seen from here, is at most 0.1 px
    away."""
    first, second = look_at(0.2, 1.0, 2.3), look_at(1.1, 0.7, 2.0)
    one, two = blender.render(small_scene(first, second, part=sphere()))
    ys, xs = np.nonzero(one.mask)
    pixels = np.stack([xs + 0.5, ys + 0.5], axis=1)
    points = unproject(first, pixels, one.depth[ys, xs])
    there, depth = second.project(points)
    corner = np.floor(there - 0.5).astype(int)
    part = there - 0.5 - corner
    inverse = np.zeros(len(there))
    whole = np.ones(len(there), bool)
    for dy in (0, 1):
        for dx in (0, 1):
            x, y = np.clip(corner[:, 0] + dx, 0, 63), np.clip(corner[:, 1] + dy, 0, 63)
            weight = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
            inverse += weight / np.where(two.depth[y, x] > 0, two.depth[y, x], 1)
            whole &= two.mask[y, x]
    seen = whole & (np.abs(1 / np.where(whole, inverse, 1) - depth) < 0.05)
    back, _ = first.project(unproject(second, there[seen], 1 / inverse[seen]))
    distance = np.linalg.norm(back - pixels[seen], axis=1)
    assert seen.sum() > 200
    assert np.median(distance) < 0.1 and np.quantile(distance, 0.95) < 1


def unproject(camera: Camera, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    local = np.column_stack([camera.to_normalised(pixels), np.ones(len(pixels))]) * depth[:, None]
    return (local - camera.t) @ camera.R


@pytest.mark.parametrize(("azimuth", "elevation", "turn"), [(0.0, 0.1, 0.0), (0.7, 0.2, 0.0), (0.7, 0.2, 1.1)])
def test_the_panorama_is_where_it_says(blender: CyclesRenderer, azimuth: float, elevation: float, turn: float) -> None:
    """Row 0 is up, the middle column +x, columns clockwise from above; `turn` is counter-clockwise."""
    sky = np.repeat(np.array([0.5, 0.02, 0.5], np.float32)[None], 64 * 128, axis=0).reshape(64, 128, 3)
    row, column = int((0.5 - elevation / np.pi) * 64), int((0.5 - azimuth / (2 * np.pi)) * 128)
    sky[row, column] = (0.1, 2.0, 0.1)
    where = np.pi / 2 - (row + 0.5) / 64 * np.pi, np.pi - (column + 0.5) / 128 * 2 * np.pi + turn
    towards = np.array([np.cos(where[0]) * np.cos(where[1]), np.cos(where[0]) * np.sin(where[1]), np.sin(where[0])])
    camera = look_at(azimuth + turn + np.pi + 0.2, 1.5, 2.0)  # from the other side
    picture = render_one(blender, small_scene(camera, part=box((0.01, 0.01, 0.01)), light=Light(sky, 1.0)))
    assert turn == 0 or picture.image[..., 1].max() < 200  # not where it was before the turn
    picture = render_one(blender, small_scene(camera, part=box((0.01, 0.01, 0.01)), light=Light(sky, 1.0, turn)))
    ys, xs = np.nonzero(picture.image[..., 1] > 200)
    spot = np.array([xs.mean() + 0.5, ys.mean() + 0.5])
    expected, depth = camera.project(camera.centre[None] + towards * 1e3)
    assert depth[0] > 0
    assert np.linalg.norm(spot - expected[0]) < 1.0


def facing(part: Part, **more) -> Scene:
    """A card in the plane x = 0.2 seen from +x: y to the right, z up."""
    camera = look_at(0.0, np.pi / 2, 2.0, f=(64.0, 64.0))
    return small_scene(camera, part=part, **more)


def card(**look) -> Part:
    vertices = np.array([(0.2, -0.5, -0.5), (0.2, 0.5, -0.5), (0.2, 0.5, 0.5), (0.2, -0.5, 0.5)])
    return Part(vertices, np.array([(0, 1, 2), (0, 2, 3)]), **look)


UV = np.array([(0.0, 0.0), (1, 0), (1, 1), (0, 1)])
RED, GREEN, BLUE, PALE = (200, 40, 40), (40, 200, 40), (40, 40, 200), (200, 200, 200)


def corners(image: np.ndarray) -> list[str]:
    """Which channel leads in the corners of the card: top left, top right, bottom left, bottom right."""
    names = []
    for y, x in ((17, 17), (17, 46), (46, 17), (46, 46)):
        pixel = image[y, x].astype(int)
        names.append("w" if pixel.max() - pixel.min() < 20 else "rgb"[int(pixel.argmax())])
    return names


def test_textures_lie_as_their_coordinates_say(blender: CyclesRenderer) -> None:
    texture = np.repeat(np.repeat(np.array([[RED, GREEN], [BLUE, PALE]], np.uint8), 8, axis=0), 8, axis=1)
    picture = render_one(blender, facing(card(uv=UV, texture=texture)))
    assert corners(picture.image) == ["r", "g", "b", "w"]
    tinted = render_one(blender, facing(card(uv=UV, texture=texture, colour=(1.0, 0.2, 0.2))))
    assert corners(tinted.image)[0::3] == ["r", "r"]
    shifted = render_one(blender, facing(card(uv=UV + np.array([0.5, 0]), texture=texture)))  # wraps around
    assert corners(shifted.image) == ["g", "r", "w", "b"]


def test_brightness_is_that_of_albedo_under_even_light(blender: CyclesRenderer) -> None:
    """A matt surface of albedo a under even light is as bright as WHITE a; gloss adds a little."""
    for colour in (0.3, 0.7):
        picture = render_one(blender, facing(card(colour=(colour,) * 3)))
        expected = to_srgb(WHITE * to_linear(np.array(colour)))
        assert -5 < int(picture.image[32, 32, 1]) - int(expected) < 25
    bright = render_one(blender, facing(card(), light=even_light(1.0)))
    grey = render_one(blender, facing(card(colour=(0.6, 0.6, 0.6)), light=even_light(1.0)))
    np.testing.assert_array_equal(bright.image, grey.image)  # no look: grey


def test_vertices_have_colours(blender: CyclesRenderer) -> None:
    colours = np.array([BLUE, PALE, GREEN, RED]) / 255.0
    picture = render_one(blender, facing(card(colours=colours)))
    assert corners(picture.image) == ["r", "g", "b", "w"]


def test_surfaces_of_one_colour_and_of_cells(blender: CyclesRenderer) -> None:
    own = card(colour=(0.1, 0.1, 0.9))
    plain = render_one(blender, facing(own, surface=Surface("colour", ((0.8, 0.1, 0.1),))))
    assert corners(plain.image) == ["r"] * 4
    palette = ((0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8))
    images = [
        render_one(blender, facing(own, surface=Surface("voronoi", palette, cells=8.0, seed=seed))).image
        for seed in (1, 1, 2)
    ]
    leading = images[0][18:46, 18:46].argmax(axis=-1)
    assert set(np.unique(leading)) == {0, 1, 2}
    saturation = np.ptp(images[0][18:46, 18:46].astype(int), axis=-1)
    assert np.mean(saturation > 60) > 0.7  # cells of pure colours, mixed only where they meet
    np.testing.assert_array_equal(images[0], images[1])
    assert np.any(images[0] != images[2])


def test_the_ground_moves_with_the_objects_place(blender: CyclesRenderer) -> None:
    albedo = np.repeat(np.array([[RED, GREEN]], np.uint8), 2, axis=0).repeat(32, axis=0).repeat(32, axis=1)
    camera = look_at(-np.pi / 2, 0.5, 2.0)  # x to the right
    scene = small_scene(camera, part=box((0.01, 0.01, 0.01)), on=ground(-0.3, albedo, side=8.0))
    places = ((2.0, 0.0), (6.0, 0.0), (-2.0 - 8e4, 0.0), (3.8, 0.0))
    scene = dataclasses.replace(scene, shots=tuple(Shot(camera, place) for place in places))
    red, green, far_green, left_right = (picture.image[40].astype(int) for picture in blender.render(scene))
    assert (red[:, 0] >= red[:, 1]).all() and (green[:, 1] >= green[:, 0]).all() and red[:, 0].mean() > 100
    np.testing.assert_array_equal(far_green, green)
    assert left_right[0, 0] > left_right[0, 1] and left_right[-1, 1] > left_right[-1, 0]


def test_bumps_show_and_leave_depth_alone(blender: CyclesRenderer) -> None:
    camera = look_at(0.0, 0.5, 2.0)
    waves = (0.03 * np.sin(np.arange(64) * 2 * np.pi / 16)).astype(np.float32)[None].repeat(64, axis=0)
    sky = np.full((16, 32, 3), 0.05, np.float32)
    sky[3:6, 14:19] = 4.0
    speck = box((0.01, 0.01, 0.01))
    flat, rough = (
        render_one(blender, small_scene(camera, part=speck, on=ground(-0.3, bumps=bumps), light=Light(sky)))
        for bumps in (None, waves)
    )
    np.testing.assert_array_equal(flat.depth, rough.depth)
    rows = [picture.image[40:, :, 1].mean(axis=1) for picture in (flat, rough)]  # the waves run away from the camera
    assert np.ptp(rows[0]) < 10 < 20 < np.ptp(rows[1])
    x = (camera.centre + rays(camera) * flat.depth[..., None])[40:, 32, 0]
    towards_light = -np.cos(2 * np.pi * x / 0.5)
    assert np.corrcoef(towards_light, rows[1])[0, 1] > 0.9


def test_normals_of_the_file_make_it_smooth(blender: CyclesRenderer) -> None:
    coarse = sphere(rings=6)
    elevation = np.pi / 2 - (np.arange(64) + 0.5) / 64 * np.pi
    sky = np.repeat(0.05 + 3 * np.maximum(np.sin(elevation), 0) ** 2, 128 * 3).reshape(64, 128, 3).astype(np.float32)
    camera = look_at(0.0, 1.2, 2.0, f=(90.0, 90.0))
    flat, smooth = (
        render_one(blender, small_scene(camera, part=part, light=Light(sky))).image.astype(float)
        for part in (dataclasses.replace(coarse, normals=None), coarse)
    )
    profiles = [image[20:44, 22:42, 1].mean(axis=1) for image in (flat, smooth)]
    assert all(np.ptp(profile) > 30 for profile in profiles)
    steps = [np.abs(np.diff(profile)).max() for profile in profiles]
    assert steps[1] < 0.5 * steps[0]
    inside_out = dataclasses.replace(coarse, faces=coarse.faces[:, ::-1])
    again = render_one(blender, small_scene(camera, part=inside_out, light=Light(sky)))
    assert np.abs(again.image.astype(float) - smooth).mean() < 2
    mixed = np.where(np.arange(len(coarse.faces))[:, None] % 3 == 0, coarse.faces[:, ::-1], coarse.faces)
    again = render_one(blender, small_scene(camera, part=dataclasses.replace(coarse, faces=mixed), light=Light(sky)))
    assert np.abs(again.image.astype(float) - smooth).mean() < 2


def test_what_lies_flat_on_the_ground_is_seen(blender: CyclesRenderer) -> None:
    vertices = np.array([(-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0)])
    camera = look_at(0.4, 0.6, 2.0)
    picture = render_one(
        blender, small_scene(camera, part=Part(vertices, np.array([(0, 1, 2), (0, 2, 3)])), on=ground(0.0))
    )
    expected = box_depth(camera, np.array([0.5, 0.5, 1e-9])) < np.inf
    assert np.count_nonzero(picture.mask != expected) <= 1


def test_pictures_do_not_depend_on_what_was_rendered_before(blender: CyclesRenderer) -> None:
    """Nor on the process, nor on the views before."""
    config = dataclasses.replace(CHEAP, samples=4, denoise=True, bounces=4)
    cameras = look_at(0.3, 1.0, 2.5), look_at(1.3, 0.5, 2.0)
    scene = small_scene(*cameras, on=ground(-0.3), surface=Surface("voronoi"), seed=7)
    one, two = CyclesRenderer(config), CyclesRenderer(config)
    try:
        alone = list(one.render(scene))
        list(two.render(small_scene(part=sphere(), seed=3)))
        after = list(two.render(scene))
        last = list(two.render(dataclasses.replace(scene, shots=scene.shots[1:])))
    finally:
        one.close()
        two.close()
    for a, b in [*zip(alone, after, strict=True), (alone[1], last[0])]:
        for name in ("image", "mask", "depth"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    other = small_scene(*cameras, on=ground(-0.3), surface=Surface("voronoi"), seed=8)
    assert np.any(render_one(blender, dataclasses.replace(other, shots=other.shots[:1])).image != alone[0].image)


def test_parts_have_each_their_own_look(blender: CyclesRenderer) -> None:
    left = dataclasses.replace(card(colour=(0.8, 0.1, 0.1)), vertices=card().vertices * (1, 0.5, 1) - (0, 0.25, 0))
    right = dataclasses.replace(card(colour=(0.1, 0.8, 0.1)), vertices=card().vertices * (1, 0.5, 1) + (0, 0.25, 0))
    scene = dataclasses.replace(facing(card()), model=Model((left, right)))
    picture = render_one(blender, scene)
    assert corners(picture.image) == ["r", "g", "r", "g"]
    assert picture.mask[32, 20] and picture.mask[32, 44]
