"""The rasteriser: colours, textures, cells, panorama, ground, shadows, exposure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from pipeline.render.exposure import to_linear as linear
from pipeline.render.fast import FastRenderer
from pipeline.render.scene import Light, Part, Shot, Surface
from tests.pipeline.fast_scenes import (
    box,
    box_depth,
    camera_at,
    checker,
    looking,
    make,
    one,
    panorama,
    plain_ground,
    rays,
    scene,
    sphere,
    sunny,
)

HALF = (0.5, 0.3, 0.2)


@pytest.fixture(scope="module")
def fast() -> Iterator[FastRenderer]:
    renderer = make()
    yield renderer
    renderer.close()


def test_faces_are_seen_from_both_sides(fast: FastRenderer) -> None:
    part, camera = sphere(rings=20), camera_at(40, 50, 2)
    inverted = replace(part, faces=part.faces[:, ::-1], normals=-part.normals)
    light = Light(sunny(90, 40))
    a, b = (one(fast, scene(p, cameras=camera, light=light)).image.astype(int) for p in (part, inverted))
    assert np.abs(a - b).max() <= 3


def test_textures_lie_as_their_coordinates_say(fast: FastRenderer) -> None:
    picture = np.zeros((2, 2, 3), np.uint8)
    picture[0, 0], picture[0, 1], picture[1, 0], picture[1, 1] = (250, 0, 0), (0, 250, 0), (0, 0, 250), (250, 250, 0)
    square = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    other = np.full((5, 3, 3), 128, np.uint8)  # of another size: both must fit into one array
    far = Part(square - np.array([0, 0, 1]), np.array([[0, 1, 2]]), uv=uv, texture=other)
    part = Part(square, np.array([[0, 1, 2], [0, 2, 3]]), uv=uv + 7, texture=picture)
    camera = camera_at(-90, 1, 1.5)  # from above: +x is right, +y is up
    image = one(fast, scene(part, far, cameras=camera)).image
    centres = np.array([[-0.25, 0.25, 0], [0.25, 0.25, 0], [-0.25, -0.25, 0], [0.25, -0.25, 0]])
    columns, rows = np.floor(camera.project(centres)[0]).astype(int).T
    named = [[2, 0, 0], [0, 2, 0], [0, 0, 2], [2, 2, 0]]
    assert [[2 if c > 90 else 0 for c in image[r, k]] for r, k in zip(rows, columns, strict=True)] == named


def test_colours_of_vertices_parts_and_none(fast: FastRenderer) -> None:
    camera = camera_at(0, 30, 2)

    def middle(**look: object) -> np.ndarray:
        return linear(one(fast, scene(box(**look), cameras=camera)).image[48, 48] / 255.0)

    grey, red = middle(), middle(colour=(0.9, 0.1, 0.1))
    assert np.ptp(grey) < 0.03 and red[0] > 5 * red[1]
    colours = np.tile([0.1, 0.8, 0.1], (8, 1))
    assert middle(colours=colours)[1] > 5 * middle(colours=colours)[0]
    both = middle(colours=colours, colour=(1.0, 0.5, 1.0))
    assert both[1] < 0.5 * middle(colours=colours)[1]
    brighter = middle(colour=(0.8, 0.8, 0.8)) / grey
    assert np.allclose(brighter, linear(np.array(0.8)) / linear(np.array(0.6)), rtol=0.12)


def test_between_vertices_their_light_is_mixed(fast: FastRenderer) -> None:
    """As Blender and glTF have it: half way between black and white is half the light, not half the sRGB."""
    corners = np.array([[0.0, -0.5, -0.5], [0, 0.5, -0.5], [0, 0.5, 0.5], [0, -0.5, 0.5]])
    camera = camera_at(0, 89.9, 2)

    def middle(*levels: float) -> float:
        card = Part(corners, np.array([[0, 1, 2], [0, 2, 3]]), colours=np.repeat(levels, 3).reshape(4, 3))
        return float(linear(one(fast, scene(card, cameras=camera)).image[48, 48] / 255.0).mean())

    assert abs(middle(0, 0, 1, 1) - (middle(0, 0, 0, 0) + middle(1, 1, 1, 1)) / 2) < 0.02


def voronoi_cells(points: np.ndarray, cells: float, seed: int, count: int) -> np.ndarray:
    """The shader's cells in NumPy: the index of each point's colour."""

    def scrambled(v: np.ndarray) -> np.ndarray:
        v = v * np.uint32(1664525) + np.uint32(1013904223)
        x, y, z = v.T.copy()
        for _ in range(2):
            x = x + y * z
            y = y + z * x
            z = z + x * y
            if _ == 0:
                x, y, z = (u ^ (u >> np.uint32(16)) for u in (x, y, z))
        return np.stack([x, y, z], axis=1)

    best, owner = np.full(len(points), np.inf), np.zeros(len(points), np.uint32)
    p = points * cells
    for step in np.ndindex(3, 3, 3):
        cell = np.floor(p) + np.array(step) - 1
        shift = np.array([seed, seed >> 10, seed >> 20], np.uint32)
        h = scrambled((cell.astype(np.int64) + 32768).astype(np.uint32) + shift)
        d = ((cell + (h >> np.uint32(8)) / 2**24 - p) ** 2).sum(axis=1)
        closer = d < best
        best, owner = np.where(closer, d, best), np.where(closer, h[:, 0] ^ (h[:, 1] >> np.uint32(3)), owner)
    keys = np.stack([owner, np.full_like(owner, seed), np.full_like(owner, 7)], axis=1)
    return scrambled(keys)[:, 0] % np.uint32(count)


def test_voronoi_cells_are_solid_and_a_function_of_integers(fast: FastRenderer) -> None:
    colours = ((0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8))
    surface = Surface("voronoi", colours, cells=7.0, seed=123456789, roughness=1.0)
    for camera in (camera_at(0, 60, 1.8), camera_at(140, 100, 2.2)):
        picture = one(fast, scene(sphere(rings=60), cameras=camera, surface=surface))
        rows, columns = np.nonzero(picture.mask)
        points = camera.unproject(np.stack([columns, rows], 1) + 0.5, picture.depth[rows, columns].astype(np.float64))
        named = picture.image[rows, columns].argmax(axis=1)
        expected = voronoi_cells(points, 7.0, 123456789, 3)
        assert len(set(expected.tolist())) == 3
        assert (named == expected).mean() > 0.998  # but for points on a border


def test_the_panorama_is_where_its_convention_says(fast: FastRenderer) -> None:
    tiny, rows = Part(np.full((3, 3), 5e3) + np.eye(3), np.array([[0, 1, 2]])), 128
    marks = {(1, 0, 0): (0.5, 0.5), (0, 1, 0): (0.25, 0.5), (0, -1, 0): (0.75, 0.5), (1, 0, 1): (0.5, 0.25)}
    for direction, (u, v) in marks.items():
        sky = panorama(0.2, rows)
        y, x = int(v * rows), int(u * 2 * rows)
        sky[y - 2 : y + 2, x - 2 : x + 2] = 1.0
        image = one(fast, scene(tiny, cameras=looking(direction), light=Light(sky))).image
        bright = np.argwhere(image[..., 0] > image[..., 0].min() + 0.5 * np.ptp(image[..., 0]))
        assert len(bright) and np.abs(bright.mean(axis=0) - 31.5).max() < 2.5
        turned = one(fast, scene(tiny, cameras=looking(direction), light=Light(sky, turn=0.3))).image
        assert not np.array_equal(turned, image)
    sky = panorama(0.2, rows)
    sky[62:66, 126:130] = 1.0
    seen_at = looking((np.cos(0.7), np.sin(0.7), 0))
    image = one(fast, scene(tiny, cameras=seen_at, light=Light(sky, turn=0.7))).image[..., 0]
    assert image[32, 32] == image.max() > image[2, 2] + 40


def test_the_ground_is_a_plane_with_exact_depth(fast: FastRenderer) -> None:
    camera = camera_at(25, 70, 2.0, (0, 0, 0.3))
    picture = one(fast, scene(box(HALF), cameras=camera, ground=plain_ground(-0.2)))
    d = rays(camera)
    with np.errstate(divide="ignore"):
        plane = (-0.2 - camera.centre[2]) / d[..., 2]
    plane = np.where((plane > 0) & (plane < 1e5), plane, 0)
    shown = box_depth(camera, HALF)
    true = np.where(shown > 0, shown, plane)
    assert (picture.mask != (shown > 0)).sum() <= 2
    same = picture.mask == (shown > 0)
    assert (plane == 0).any() and (plane > 0).any()
    assert np.allclose(picture.depth[same], true[same], rtol=2e-5)


def test_the_ground_hides_what_is_behind_it_from_either_side(fast: FastRenderer) -> None:
    for zenith, low, high in ((60, -0.05, 0.2), (120, -0.2, -0.05)):
        camera = camera_at(30, zenith, 2)
        picture = one(fast, scene(box(HALF), cameras=camera, ground=plain_ground(-0.05)))
        half, middle = (0.5, 0.3, (high - low) / 2), (0, 0, (high + low) / 2)
        true = box_depth(camera, half, middle)
        near_edge = 12  # the cut is drawn 1e-4 off the plane, so that what lies on it is seen
        assert (picture.mask != (true > 0)).sum() <= near_edge and picture.mask.sum() > 300


def test_a_sheet_that_lies_on_the_ground_is_seen(fast: FastRenderer) -> None:
    square = Part(
        np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    camera = camera_at(30, 75, 2)
    alone, lying = (one(fast, scene(square, cameras=camera, ground=g)).mask for g in (None, plain_ground(0.0)))
    assert alone.sum() > 300 and np.array_equal(alone, lying)


def test_the_ground_moves_with_the_place_and_wraps_around(fast: FastRenderer) -> None:
    ground = plain_ground(-0.2, albedo=checker(64, 4), side=2.0)
    camera = camera_at(25, 40, 2.0)
    shots = [Shot(camera, place) for place in ((0, 0), (0.5, 0), (1.0, 0), (2.0, -4.0))]
    images = [p.image.astype(int) for p in fast.render(scene(box((0.01, 0.01, 0.01)), cameras=shots, ground=ground))]
    assert np.abs(images[0] - images[1]).mean() > 20
    assert np.abs(images[0] - images[2]).mean() < 1.5 and np.abs(images[0] - images[3]).mean() < 1.5


def test_objects_throw_shadows_away_from_the_sun_and_darken_the_ground_they_touch(fast: FastRenderer) -> None:
    part, camera = box((0.1, 0.1, 0.3)), camera_at(-90, 30, 3)
    for azimuth, towards in ((0, -1), (180, 1)):
        light = Light(sunny(azimuth, 45, 1500))
        image = one(fast, scene(part, cameras=camera, light=light, ground=plain_ground(-0.3))).image[..., 1]
        spots = np.array([[towards * 0.35, 0, -0.3], [-towards * 0.35, 0, -0.3], [-towards * 1.1, 0, -0.3]])
        columns, rows = np.floor(camera.project(spots)[0]).astype(int).T
        shaded, lit, far = (float(image[r, c]) for r, c in zip(rows, columns, strict=True))
        assert shaded < 0.75 * lit and far > 0.8 * lit
    even = one(fast, scene(box((0.4, 0.4, 0.1)), cameras=camera, ground=plain_ground(-0.1))).image[..., 1]
    beside, away = np.floor(camera.project(np.array([[0.44, 0, -0.1], [1.2, 0, -0.1]]))[0]).astype(int)
    assert even[beside[1], beside[0]] < 0.93 * even[away[1], away[0]]


def test_objects_shade_themselves_without_spots(fast: FastRenderer) -> None:
    roof, floor = box((0.3, 0.3, 0.02), (0, 0, 0.3)), box((0.5, 0.5, 0.02), (0, 0, -0.3))
    camera, light = camera_at(-90, 55, 2.5), Light(sunny(-90, 60, 1500))
    covered = one(fast, scene(roof, floor, cameras=camera, light=light)).image[..., 1]
    bare = one(fast, scene(floor, cameras=camera, light=light))
    columns, rows = np.floor(camera.project(np.array([[0, 0.25, -0.28], [0.45, -0.4, -0.28]]))[0]).astype(int).T
    assert covered[rows[0], columns[0]] < 0.6 * bare.image[rows[0], columns[0], 1]  # in the roof's shadow
    top = np.abs(camera.unproject(np.argwhere(bare.mask)[:, ::-1] + 0.5, bare.depth[bare.mask])[:, 2] + 0.28) < 1e-4
    values = bare.image[bare.mask][top][:, 1].astype(float)
    assert len(values) > 500 and np.ptp(values) < 12  # a flat face in the sun has one brightness


@pytest.mark.parametrize("strength", [0.4, 0.9])
def test_exposure_is_between_black_and_white(fast: FastRenderer, strength: float) -> None:
    for sky in (panorama(), sunny(30, 20, 3000), sunny(30, 70, 50)):
        given = scene(
            sphere(rings=24),
            cameras=camera_at(0, 60, 1.5),
            light=Light(sky / sky.mean(), strength),
            ground=plain_ground(-0.5),
        )
        picture = one(fast, given)
        assert 0.2 < picture.image.mean() / 255 < 0.75
        assert (picture.image[picture.mask] > 250).mean() < 0.02 and (picture.image < 8).mean() < 0.02
