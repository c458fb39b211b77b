"""The demo's objects, renderer and films: exact geometry, whole files, equal bytes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from dope.common import files
from dope.common.errors import UsageError
from pipeline.demo import film, matroska, scene, shapes, surroundings, textures
from pipeline.demo.film import DemoConfig, FilmConfig, film_objects, look_at
from pipeline.demo.raster import NEAR, Panel, project, rasterise
from pipeline.geometry import Camera, rotation_angle_deg
from pipeline.solids.grids import box, cylinder, ellipsoid, loft, sweep

SMALL = FilmConfig(width=96, height=72, frames=4, samples=1, detail=0.25)


def camera_at(
    azimuth_deg: float, elevation_deg: float, distance: float = 2.3, width: int = 200, height: int = 150
) -> Camera:
    a, e = np.radians([azimuth_deg, elevation_deg])
    centre = np.array([0, 0, 0.3]) + distance * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    R = look_at(centre, np.array([0, 0, 0.3]))
    K = np.array([[width, 0, 0.5 * width], [0, width, 0.5 * height], [0, 0, 1]])
    return Camera(width, height, K, np.zeros(4), R, -R @ centre)


def mesh_of(grids: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0, *(grid.shape[0] * grid.shape[1] for grid in grids)])
    faces = [scene._grid_faces(grid) + start for grid, start in zip(grids, starts, strict=False)]
    return np.concatenate([grid.reshape(-1, 3) for grid in grids]), np.concatenate(faces)


@pytest.fixture(scope="module")
def mug() -> scene.Scene:
    return scene.build_scene("mug", 3)


# ---- the rasteriser


def test_rasteriser_agrees_with_a_loop_over_pixels_and_triangles() -> None:
    rng = np.random.default_rng(0)
    width, height = 23, 17
    xy, nearness = rng.uniform(-6, 28, (60, 2)), rng.uniform(0.2, 2, 60)
    nearness[7] = -1  # behind the camera: its triangles vanish
    faces = rng.permutation(60).reshape(20, 3)
    visible = rasterise(xy, nearness, faces, width, height)
    for row in range(height):
        for column in range(width):
            best, owner = 0.0, -1
            for index, face in enumerate(faces):
                corners = np.concatenate([xy[face].T, np.ones((1, 3))])
                if np.linalg.det(corners) <= 0 or (nearness[face] <= 0).any():
                    continue
                weights = np.linalg.solve(corners, (column + 0.5, row + 0.5, 1))
                if (weights >= 0).all() and weights @ nearness[face] > best:
                    best, owner = weights @ nearness[face], index
            assert visible.face[row, column] == owner
            assert visible.nearness[row, column] == pytest.approx(best, rel=1e-9)


def test_a_mesh_has_no_cracks_between_its_triangles() -> None:
    rng = np.random.default_rng(1)
    y, x = np.meshgrid(np.linspace(-1, 65, 30), np.linspace(-1, 65, 30), indexing="ij")
    x[1:-1, 1:-1] += rng.uniform(-0.5, 0.5, (28, 28))
    y[1:-1, 1:-1] += rng.uniform(-0.5, 0.5, (28, 28))
    faces = scene._grid_faces(np.zeros((30, 30, 3)))
    visible = rasterise(np.stack([y, x], axis=2).reshape(-1, 2), np.ones(900), faces, 64, 64)
    assert (visible.face >= 0).all()


def test_depth_and_attributes_are_those_of_the_ray_through_the_pixel_centre() -> None:
    camera = camera_at(30, 35)
    vertices, faces = mesh_of(box((0.9, 0.7, 0.5), (0, 0, 0.3), 0.02))
    visible = rasterise(*project(camera, vertices), faces, camera.width, camera.height)
    rows, columns, points = visible.interpolate(vertices, faces)
    assert len(rows) > 1000
    pixels, depth = camera.project(points)
    np.testing.assert_allclose(pixels, np.stack([columns, rows], axis=1) + 0.5, atol=1e-7)
    np.testing.assert_allclose(depth, 1 / visible.nearness[rows, columns], rtol=1e-9)
    flat = (np.abs(points[:, :2]) < 0.3).all(1) & (points[:, 2] > 0.5)
    assert flat.sum() > 300
    np.testing.assert_allclose(points[flat, 2], 0.55, atol=1e-9)


def test_a_panel_shows_the_texel_that_each_ray_meets_even_where_it_passes_the_camera() -> None:
    camera = camera_at(10, 30, 1.5)
    texels, half = 20, 6.0  # the ground reaches far behind the camera
    y, x = np.mgrid[0 : int(2 * half * texels), 0 : int(2 * half * texels)]
    texture = np.stack([x, y, 0 * x], axis=2).astype(np.uint8)  # a ramp: colour = texel index (mod 256)
    corner = np.array([-half, -half, 0.0])
    outline = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    panel = Panel(corner, np.array([1 / texels, 0, 0]), np.array([0, 1 / texels, 0]), outline, texture)
    image = np.full((camera.height, camera.width, 3), 7, np.uint8)
    panel.draw(image, camera)
    columns, rows = (a.ravel() for a in np.meshgrid(np.arange(camera.width), np.arange(camera.height)))
    nearness = panel.nearness(camera, columns + 0.5, rows + 0.5)
    ground = nearness > 1 / 8
    points = camera.unproject(np.stack([columns, rows], axis=1)[ground] + 0.5, 1 / nearness[ground])
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-9)
    expected = (points[:, :2] + half) * texels - 0.5
    inside = ((expected > 1) & (expected < 238)).all(1)
    shown = image[rows[ground], columns[ground], :2][inside]
    assert inside.sum() > 10_000
    assert np.abs(shown - expected[inside]).max() < 0.6
    sky = nearness < -0.02
    assert (image[rows[sky], columns[sky]] == 7).all()


def test_what_lies_before_the_near_plane_is_dropped() -> None:
    camera = Camera(10, 10, np.diag([10.0, 10, 1]), np.zeros(4), np.eye(3), np.zeros(3))
    _, nearness = project(camera, np.array([[0, 0, 2.0], [0, 0, NEAR / 2], [0, 0, -2]]))
    np.testing.assert_allclose(nearness, [0.5, -1, -1])


# ---- shapes


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return -float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)  # faces are clockwise from outside


def test_solids_have_the_volumes_of_their_formulas() -> None:
    assert volume(*mesh_of(box((1, 2, 3), (5, 5, 5), 0.001))) == pytest.approx(6, rel=0.01)
    assert volume(*mesh_of(cylinder(0.5, 1, 3))) == pytest.approx(np.pi * 0.25 * 2, rel=0.01)
    assert volume(*mesh_of(ellipsoid((1, 2, 0.5), (3, 0, 0)))) == pytest.approx(4 / 3 * np.pi, rel=0.02)
    tube = sweep(
        np.stack([np.linspace(0, 2, 9), 0 * np.arange(9), 0 * np.arange(9)], axis=1), 0.3, sides=64, sharp=True
    )
    assert volume(*mesh_of(tube)) == pytest.approx(np.pi * 0.09 * 2, rel=0.01)
    for axis in (0, 1):
        rod = loft([(-1, 0.2, 0.5, 3, 0.25), (1, 0.2, 0.5, 3, 0.25)], axis=axis, sides=64)
        assert volume(*mesh_of(rod)) == pytest.approx(np.pi * 0.5 * 0.25 * 2, rel=0.01)


@pytest.mark.parametrize("family", shapes.FAMILIES)
def test_objects_are_closed_and_face_outwards(family: str) -> None:
    for seed in range(3):
        parts = shapes.make_object(family, seed)
        vertices, faces = mesh_of(tuple(grid for part in parts for grid in part.grids))
        assert np.isfinite(vertices).all()
        assert vertices[:, 2].min() == pytest.approx(0, abs=1e-9)
        assert np.linalg.norm(vertices - vertices.mean(0), axis=1).max() < shapes.DIAMETER
        assert {part.name for part in parts} <= set(textures.PART_HUES)
        assert len(parts) == len({part.name for part in parts}) >= 2
        assert volume(vertices, faces) > 0.005
        for azimuth in (20, 140, 260):
            camera = camera_at(azimuth, 30)
            seen = project(camera, vertices)
            culled = rasterise(*seen, faces, camera.width, camera.height)
            whole = rasterise(*seen, faces, camera.width, camera.height, cull=False)
            # through a hole or an inside-out patch, culling would show the far side
            assert (np.abs(culled.nearness - whole.nearness) > 1e-3).sum() <= 3


def test_instances_of_a_family_differ_and_a_seed_repeats_them() -> None:
    first, again, other = (shapes.make_object("chair", seed) for seed in (0, 0, 1))
    assert all(
        np.array_equal(a, b) for p, q in zip(first, again, strict=True) for a, b in zip(p.grids, q.grids, strict=True)
    )
    assert not np.allclose(first[0].grids[0], other[0].grids[0], atol=0.01)


def test_an_unknown_family_names_the_closest() -> None:
    with pytest.raises(UsageError, match="Did you mean 'hammer'"):
        shapes.make_object("hamer", 0)


# ---- textures


def test_noise_is_the_lattice_at_integers_and_linear_between() -> None:
    rng = np.random.default_rng(0)
    corner = rng.integers(-100, 100, 3).astype(float)
    along = noise_at = textures.noise(corner + np.array([[0, 0, 0], [0, 0.25, 0], [0, 1, 0], [64, 0, -128]]))
    assert along[1] == pytest.approx(0.75 * noise_at[0] + 0.25 * noise_at[2], abs=1e-6)
    assert along[3] == noise_at[0]
    many = textures.noise(rng.uniform(-99, 99, (5000, 3)))
    assert 0 <= many.min() < 0.1 and 0.9 < many.max() <= 1 and abs(many.mean() - 0.5) < 0.02


def test_cells_change_only_where_the_border_is() -> None:
    line = np.stack([np.linspace(0, 30, 6001), np.full(6001, 3.3), np.full(6001, 7.7)], axis=1)
    value, border = textures.cells(line)
    changes = np.flatnonzero(np.diff(value) != 0)
    assert 15 < len(changes) < 90
    assert (np.minimum(border[changes], border[changes + 1]) < 0.02).all()
    assert border.max() > 0.3 and border.min() >= 0


def test_a_part_keeps_its_hue_over_instances_and_patterns() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (4000, 3))
    for part in ("handle", "leg", "body"):
        for pattern in textures.PATTERNS:
            texture = replace(textures.random_texture(rng, part), pattern=pattern)
            colours = texture.colour(points)
            mean = colours.mean(0)[None, None].astype(np.float32)
            hue = cv2.cvtColor(mean, cv2.COLOR_RGB2HSV)[0, 0, 0] / 360
            assert abs((hue - textures.PART_HUES[part] + 0.5) % 1 - 0.5) < 0.07
            assert colours.mean(1).std() > 0.04  # something for features to hold on to


# ---- views


def test_two_views_agree_in_geometry_and_colour(mug: scene.Scene) -> None:
    first, second = camera_at(40, 30, width=320, height=240), camera_at(52, 36, width=320, height=240)
    rgb1, mask1, depth1 = scene.render_view(mug, first)
    rgb2, _, depth2 = scene.render_view(mug, second)
    assert (depth1 > 0).all() and mask1.any() and not mask1.all()
    rows, columns = np.nonzero(np.ones_like(mask1))
    pixels = np.stack([columns, rows], axis=1) + 0.5
    points = first.unproject(pixels, depth1[rows, columns])
    there, z = second.project(points)
    x, y = (there - 0.5).astype(np.float32).T

    def at(image: np.ndarray) -> np.ndarray:
        flat = cv2.remap(image.astype(np.float32), x.reshape(depth1.shape), y.reshape(depth1.shape), cv2.INTER_LINEAR)
        return flat.reshape(len(x), -1)

    z2 = at(depth2)[:, 0]
    both = (there > 1).all(1) & (there < (319, 239)).all(1) & (np.abs(z2 / z - 1) < 0.004)
    back, _ = first.project(second.unproject(there[both], z2[both]))
    error = np.linalg.norm(back - pixels[both], axis=1)
    assert both.mean() > 0.6
    assert np.median(error) < 0.01 and np.percentile(error, 95) < 0.1
    colour = rgb1.reshape(-1, 3)[both].astype(float)
    difference = np.abs(at(rgb2)[both] - colour).mean()
    shifted = np.abs(np.roll(at(rgb2), 2, axis=0)[both] - colour).mean()
    assert difference < 9 and difference < 0.6 * shifted


def test_nothing_hides_the_object_from_the_lowest_camera(mug: scene.Scene) -> None:
    alone = replace(mug, faces=mug.faces[mug.is_object], is_object=mug.is_object[mug.is_object])
    for azimuth in range(0, 360, 24):
        camera = camera_at(azimuth, surroundings.LOWEST_ELEVATION_DEG)
        np.testing.assert_array_equal(scene.render_mask(mug, camera), scene.render_mask(alone, camera))


def test_the_camera_walks_round_the_object_within_its_bounds() -> None:
    config = FilmConfig()
    for seed in range(5):
        cameras = film.camera_path(config, 0.8, seed)
        assert len(cameras) == config.frames
        offsets = np.array([c.centre - (0, 0, 0.4) for c in cameras])
        distance = np.linalg.norm(offsets, axis=1)
        elevation = np.degrees(np.arcsin(offsets[:, 2] / distance))
        azimuth = np.degrees(np.unwrap(np.arctan2(offsets[:, 1], offsets[:, 0])))
        assert config.distance[0] <= distance.min() and distance.max() <= config.distance[1]
        assert config.elevation_deg[0] - 1e-6 <= elevation.min() and elevation.max() <= config.elevation_deg[1] + 1e-6
        assert config.arc_deg[0] - 3 < np.ptp(azimuth) < config.arc_deg[1] + 3
        assert all(rotation_angle_deg(b.R @ a.R.T) < 20 for a, b in pairwise(cameras))
        for camera in cameras:
            np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(camera.R) > 0
            assert camera.R[1, 2] < 0  # the world's up is the image's up
            (pixel,), _ = camera.project(np.array([[0, 0, 0.4]]))
            assert np.abs(pixel - (320, 240)).max() < 80


# ---- films


def demo(**changes: object) -> DemoConfig:
    config = DemoConfig(("mug",), ("plane",), per_family=2, containers=("mp4", "avi", "mkv", "webm"), film=SMALL)
    return replace(config, **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("films")
    videos = film_objects(out, demo(), workers=1)
    names = ["mug/mug_0.mp4", "mug/mug_1.avi", "plane/plane_0.mkv", "plane/plane_1.webm"]
    assert [video.relative_to(out).as_posix() for video in videos] == names
    return out


def contents(folder: Path) -> dict[str, str]:
    return {p.relative_to(folder).as_posix(): files.sha256_of(p) for p in sorted(folder.rglob("*")) if p.is_file()}


def test_films_are_the_same_bytes_whatever_the_workers(filmed: Path, tmp_path: Path) -> None:
    seen: list[str] = []
    film_objects(tmp_path, demo(), workers=2, progress=seen.append)
    assert sorted(seen) == ["mug_0", "mug_1", "plane_0", "plane_1"]
    assert contents(tmp_path) == contents(filmed)


def test_every_container_plays_what_was_rendered_with_true_cameras_and_masks(filmed: Path) -> None:
    for truth in sorted((filmed / "truth").glob("*.json")):
        value, cameras = files.read_json(truth), film.read_truth(truth)
        world = scene.build_scene(value["family"], value["settings"]["seed"], SMALL.detail)
        capture = cv2.VideoCapture(str(filmed / value["video"]))
        assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(SMALL.fps)
        images = []
        for number, camera in enumerate(cameras):
            ok, frame = capture.read()
            assert ok and frame.shape == (SMALL.height, SMALL.width, 3)
            rendered = scene.render_colours(world, camera, SMALL.samples)
            images.append((rendered, np.ascontiguousarray(frame[..., ::-1])))
            mask = cv2.imread(str(filmed / value["masks"] / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(mask, scene.render_mask(world, camera))
            assert set(np.unique(mask)) == {0, 255}
        assert not capture.read()[0]
        likeness = np.array([[cv2.PSNR(rendered, shown) for _, shown in images] for rendered, _ in images])
        assert likeness.diagonal().min() > 21 and (likeness.argmax(1) == np.arange(SMALL.frames)).all()


def test_what_is_there_is_kept_and_what_is_missing_or_changed_is_made(
    filmed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents(filmed)
    made: list[str] = []
    original = film.film_one
    monkeypatch.setattr(film, "film_one", lambda out, job: (made.append(job.id), original(out, job)))
    film_objects(filmed, demo(), workers=1)
    assert made == []
    (filmed / "masks/mug_1/000002.png").unlink()
    film_objects(filmed, demo(), workers=1)
    assert made == ["mug_1"] and contents(filmed) == before
    film_objects(filmed, demo(novel_families=(), per_family=1, film=replace(SMALL, noise=3.0)), workers=1)
    assert made == ["mug_1", "mug_0"] and contents(filmed) != before
    film_objects(filmed, demo(), workers=1)
    assert contents(filmed) == before


def test_matroska_files_of_equal_pictures_are_equal_and_still_play(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 255, (3, 48, 64, 3), dtype=np.uint8)
    raw, fixed = [], []
    for name in ("a.mkv", "b.mkv"):
        writer = cv2.VideoWriter(str(tmp_path / name), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 5, (64, 48))
        for frame in frames:
            writer.write(frame)
        writer.release()
        raw.append((tmp_path / name).read_bytes())
        matroska.make_reproducible(tmp_path / name)
        fixed.append((tmp_path / name).read_bytes())
    assert raw[0] != raw[1] and fixed[0] == fixed[1]
    capture = cv2.VideoCapture(str(tmp_path / "a.mkv"))
    for frame in frames:
        np.testing.assert_array_equal(capture.read()[1], frame)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (demo(containers=("mp5",)), "mp5"),
        (demo(novel_families=("mgu",)), "mgu"),
        (demo(novel_families=("mug",)), "twice"),
        (demo(film=replace(SMALL, elevation_deg=(5.0, 40.0))), "elevation"),
        (demo(film=replace(SMALL, distance=(2.0, 5.0))), "distance"),
        (demo(film=replace(SMALL, width=97)), "even"),
    ],
)
def test_impossible_films_are_refused_before_anything_is_made(config: DemoConfig, message: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=message):
        film_objects(tmp_path, config, workers=1)
    assert not list(tmp_path.iterdir())


def test_a_video_that_cannot_be_read_back_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film.matroska, "make_reproducible", lambda path: path.write_bytes(path.read_bytes()[:2000]))
    config = demo(novel_families=(), per_family=1, containers=("mkv",))
    with pytest.raises(film.BadInput, match="of 4 frames"):
        film_objects(tmp_path, config, workers=1)
    assert not list(tmp_path.rglob("*.mkv")) and not list(tmp_path.rglob("*.json"))
