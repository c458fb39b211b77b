"""The rasteriser: exact masks and depth, where things are, what they look like, equal bytes."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dope.common.errors import BadInput, DopeError
from pipeline.geometry import Camera
from pipeline.render.config import FastConfig
from pipeline.render.fast import FastRenderer, context
from pipeline.render.fast.geometry import geometry_of, linear, occluder_faces
from pipeline.render.scene import Light, Model, Part, Picture, Scene, Shot, Surface
from tests.pipeline.fast_scenes import (
    box,
    box_depth,
    camera_at,
    checker,
    looking,
    panorama,
    plain_ground,
    rays,
    scene,
    sphere,
    sphere_depth,
    sunny,
)

HALF = (0.5, 0.3, 0.2)
ROOT = Path(__file__).parents[2]


def make(supersample: int = 1) -> FastRenderer:
    try:
        return FastRenderer(FastConfig(supersample=supersample))
    except DopeError as error:
        pytest.skip(f"no OpenGL here: {error}")


@pytest.fixture(scope="module")
def fast() -> Iterator[FastRenderer]:
    renderer = make()
    yield renderer
    renderer.close()


def one(renderer: FastRenderer, given: Scene) -> Picture:
    (picture,) = renderer.render(given)
    return picture


def off_centre() -> Camera:
    """Not square, two focal lengths, the principal point off the middle by no whole pixel."""
    camera = camera_at(33, 62, 1.9, (0.05, -0.1, 0.02), (120, 90))
    K = np.array([[110.3, 0, 66.37], [0, 97.9, 38.81], [0, 0, 1]])
    return replace(camera, K=K)


# ---- where things are


def test_depth_and_mask_are_those_of_a_box_to_float_precision(fast: FastRenderer) -> None:
    for camera in (off_centre(), camera_at(-120, 15, 2.5), camera_at(200, 88, 3.9, size=(64, 64))):
        picture, true = one(fast, scene(box(HALF), cameras=camera)), box_depth(camera, HALF)
        assert picture.image.shape == (camera.height, camera.width, 3) and picture.depth.dtype == np.float32
        wrong = picture.mask != (true > 0)
        assert wrong.sum() <= 2  # a pixel's centre within 1/256 pixel of an edge
        both = picture.mask & (true > 0)
        assert both.sum() > 70
        assert np.abs(picture.depth[both] / true[both] - 1).max() < 1e-5
        assert not picture.depth[~picture.mask].any()


@pytest.mark.parametrize("supersample", [1, 2, 3])
def test_the_silhouette_of_a_sphere_is_not_shifted(supersample: int) -> None:
    renderer, camera = make(supersample), off_centre()
    picture, true = one(renderer, scene(sphere(rings=200), cameras=camera)), sphere_depth(camera, 0.5)
    wrong = picture.mask != (true > 0)
    assert wrong.sum() <= 0.002 * (true > 0).sum()  # a shift of half a pixel would be 2%
    both = picture.mask & (true > 0)
    assert np.median(np.abs(picture.depth[both] / true[both] - 1)) < 3e-5  # the facets lie inside the sphere
    renderer.close()


def test_supersampling_changes_neither_mask_nor_depth(fast: FastRenderer) -> None:
    given = scene(sphere(rings=24), cameras=camera_at(10, 60, 2), ground=plain_ground(-0.5))
    once = one(fast, given)
    for supersample in (2, 3):
        finer = make(supersample)
        often = one(finer, given)
        finer.close()
        assert np.array_equal(once.mask, often.mask) and np.allclose(once.depth, often.depth, rtol=1e-6)
        assert not np.array_equal(once.image, often.image)


def test_a_supersampled_image_is_the_mean_of_its_samples_in_linear_light(fast: FastRenderer) -> None:
    camera = camera_at(10, 60, 1.6)
    surface = Surface("voronoi", ((0.9, 0.1, 0.1), (0.1, 0.9, 0.1), (0.1, 0.1, 0.9)), cells=6)
    part = sphere(rings=24)
    fine = one(fast, scene(part, cameras=camera.resized(192, 192), surface=surface)).image
    light = linear(fine / 255.0).reshape(96, 2, 96, 2, 3).mean(axis=(1, 3))
    finer = make(2)
    seen = linear(one(finer, scene(part, cameras=camera, surface=surface)).image / 255.0)
    assert np.abs(seen - light).max() < 0.012


def test_depth_of_one_view_lands_on_the_surface_that_another_sees(fast: FastRenderer) -> None:
    cameras = [camera_at(20, 50, 2.0, size=(224, 224)), camera_at(65, 70, 2.4, (0.1, 0, -0.1), size=(224, 224))]
    first, second = fast.render(scene(sphere(rings=60), box((0.2, 0.6, 0.1)), cameras=cameras))
    rows, columns = np.nonzero(first.mask)
    pixels = np.stack([columns, rows], axis=1) + 0.5
    points = cameras[0].unproject(pixels, first.depth[rows, columns].astype(np.float64))
    there, z = cameras[1].project(points)
    inside = (there > 1).all(axis=1) & (there < 222).all(axis=1)
    x, y = np.floor(there[inside] - 0.5).astype(int).T
    fx, fy = (there[inside] - 0.5 - np.stack([x, y], 1)).T
    corners = np.stack([second.depth[y + b, x + a] for a in (0, 1) for b in (0, 1)])
    weights = np.stack([(a * fx + (1 - a) * (1 - fx)) * (b * fy + (1 - b) * (1 - fy)) for a in (0, 1) for b in (0, 1)])
    seen = 1 / (weights / np.maximum(corners, 1e-9)).sum(axis=0)
    visible = (corners.min(axis=0) > 0) & (np.abs(seen - z[inside]) < 0.02)
    back, _ = cameras[0].project(cameras[1].unproject(there[inside][visible], seen[visible]))
    apart = np.linalg.norm(back - pixels[inside][visible], axis=1)
    assert visible.sum() > 2000 and np.median(apart) < 0.05 and (apart < 1).mean() > 0.99


def test_what_the_camera_is_close_to_or_inside_of_is_not_cut_off(fast: FastRenderer) -> None:
    near = camera_at(0, 90, 0.51, size=(48, 48))  # 1 cm before a wall
    inside = looking((1, 0.3, -0.2), (48, 48), 30.0)
    for camera in (near, inside):
        picture, true = one(fast, scene(box(HALF), cameras=camera)), box_depth(camera, HALF)
        assert picture.mask.all()
        assert np.abs(picture.depth / true - 1).max() < 1e-5


def test_many_parts_and_faces_without_area(fast: FastRenderer) -> None:
    places = [(x, y) for x in np.linspace(-0.45, 0.45, 10) for y in np.linspace(-0.4, 0.4, 5)]
    colours = np.random.default_rng(0).uniform(0.2, 0.8, (50, 3))
    parts = []
    for (x, y), colour in zip(places, colours, strict=True):
        part = box((0.03, 0.06, 0.05), (x, y, 0), colour=tuple(colour))
        parts.append(replace(part, faces=np.concatenate([[[0, 0, 1], [2, 2, 2]], part.faces])))
    camera = camera_at(0, 0.5, 2, size=(200, 200))
    picture = one(fast, scene(*parts, cameras=camera))
    tops = np.array([(x, y, 0.05) for x, y in places])
    columns, rows = np.floor(camera.project(tops)[0]).astype(int).T
    assert picture.mask[rows, columns].all()
    seen = linear(picture.image[rows, columns] / 255.0)
    ratio = (seen / linear(colours)).mean(axis=1)  # the same light on every top, apart from a highlight
    assert ratio.std() / ratio.mean() < 0.1
    assert np.corrcoef(seen.ravel(), linear(colours).ravel())[0, 1] > 0.995


# ---- looks


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


# ---- a function of the scene


def digest(pictures: Iterator[Picture]) -> str:
    whole = hashlib.sha256()
    for picture in pictures:
        for array in (picture.image, picture.mask, picture.depth):
            whole.update(np.ascontiguousarray(array).tobytes())
    return whole.hexdigest()


def rich_scene() -> Scene:
    surface = Surface("voronoi", ((0.8, 0.2, 0.1), (0.2, 0.5, 0.8)), seed=5)
    ground = plain_ground(-0.3, albedo=checker(), bumps=np.random.default_rng(0).random((64, 64), np.float32) * 0.01)
    cameras = [Shot(camera_at(a, 60, 2), (a / 50, 1.0)) for a in (0, 100)]
    return scene(
        box((0.2, 0.3, 0.3)),
        sphere(0.25, 20),
        cameras=cameras,
        surface=surface,
        ground=ground,
        light=Light(sunny(50, 30)),
    )


def test_two_processes_and_any_history_give_the_same_bytes() -> None:
    renderer = make(2)
    first = digest(renderer.render(rich_scene()))
    list(renderer.render(scene(sphere(rings=8), cameras=camera_at(0, 50, 2, size=(40, 30)))))
    assert digest(renderer.render(rich_scene())) == first
    code = "from test_render_fast import digest, make, rich_scene\nprint(digest(make(2).render(rich_scene())))"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(Path(__file__).parent)])}
    answer = subprocess.run(
        [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    assert answer.stdout.split()[-1] == first


def test_two_scenes_that_are_rendered_in_turns_do_not_mix(fast: FastRenderer) -> None:
    other = replace(rich_scene(), surface=Surface("voronoi", ((0.1, 0.9, 0.1), (0.9, 0.9, 0.1)), seed=9), ground=None)
    alone = [digest(fast.render(rich_scene())), digest(fast.render(other))]
    turns = list(zip(fast.render(rich_scene()), fast.render(other), strict=True))
    assert [digest(iter(pictures)) for pictures in zip(*turns, strict=True)] == alone


def test_memory_of_scenes_is_given_back(fast: FastRenderer) -> None:
    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    big = plain_ground(-0.5, albedo=np.zeros((512, 512, 3), np.uint8))
    part = sphere(rings=24, texture=np.zeros((512, 512, 3), np.uint8), uv=np.zeros((25 * 49, 2)))
    given = scene(part, cameras=camera_at(0, 60, 2, size=(32, 32)), ground=big)
    for _ in range(4):
        one(fast, given)
    before = resident_mb()
    for _ in range(16):
        one(fast, given)
    assert resident_mb() - before < 15  # of a scene's 6 MB each time


# ---- what cannot be rendered


def test_scenes_that_cannot_be_rendered_are_refused(fast: FastRenderer) -> None:
    camera = camera_at(0, 60, 2)
    bent = replace(camera, distortion=np.array([0.1, 0, 0, 0]))
    holes = replace(box(), vertices=np.where(np.arange(24).reshape(8, 3) == 5, np.nan, 0.3))
    strangers = replace(box(), faces=np.array([[0, 1, 99]]))
    for given, words in (
        (scene(box(), cameras=bent), "distortion"),
        (scene(Part(np.zeros((0, 3)), np.zeros((0, 3), np.int64)), cameras=camera), "no faces"),
        (scene(holes, cameras=camera), "no numbers"),
        (scene(strangers, cameras=camera), "vertex"),
    ):
        with pytest.raises(BadInput, match=words):
            list(fast.render(given))
    assert one(fast, scene(box(), cameras=camera)).mask.any()


def test_without_egl_or_moderngl_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    moderngl = pytest.importorskip("moderngl")

    def fails(**_: object) -> None:
        raise RuntimeError("libEGL.so not loaded")

    monkeypatch.setattr(moderngl, "create_context", fails)
    with pytest.raises(DopeError, match="apt-get install libegl1 libgl1-mesa-dri"):
        context._context.__wrapped__(0)
    monkeypatch.setitem(sys.modules, "moderngl", None)
    with pytest.raises(DopeError, match=r"dope-descriptors\[render\]"):
        context._context.__wrapped__(0)


# ---- what casts shadows


def test_a_large_mesh_casts_its_shadow_by_far_fewer_faces_without_losing_thin_rods() -> None:
    rod = box((0.5, 0.001, 0.001), (0, 0, 0.55))
    geometry = geometry_of(Model((sphere(rings=120), rod)))
    few = occluder_faces(geometry)
    assert len(few) < 0.3 * len(geometry.faces)
    corners = geometry.vertices[few][..., :3]
    middles = corners.mean(axis=1)
    assert ((middles[:, 2] > 0.54) & (np.ptp(corners[..., 0], axis=1) > 0.9)).any()
    # every direction from the middle still meets the sphere: the solid angles of its faces add up to the whole
    ball = corners[middles[:, 2] < 0.54].astype(np.float64)
    a, b, c = np.moveaxis(ball / np.linalg.norm(ball, axis=2, keepdims=True), 1, 0)
    triple = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c)))
    dots = [np.einsum("ij,ij->i", p, q) for p, q in ((a, b), (b, c), (c, a))]
    angle = 2 * np.arctan2(triple, 1 + sum(dots))
    assert angle.sum() == pytest.approx(4 * np.pi, rel=0.05)
