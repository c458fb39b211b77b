"""The rasteriser: exact masks and depth, equal bytes, what is refused; looks are tested in test_render_fast_looks."""

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
from pipeline.render.exposure import to_linear as linear
from pipeline.render.fast import FastRenderer, context
from pipeline.render.fast.geometry import geometry_of, occluder_faces
from pipeline.render.scene import Light, Model, Part, Picture, Scene, Shot, Surface
from tests.pipeline.fast_scenes import (
    box,
    box_depth,
    camera_at,
    checker,
    looking,
    make,
    one,
    plain_ground,
    scene,
    sphere,
    sphere_depth,
    sunny,
)

HALF = (0.5, 0.3, 0.2)
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def fast() -> Iterator[FastRenderer]:
    renderer = make()
    yield renderer
    renderer.close()


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
