"""Views: exact cameras, no aliasing, no invented depth, and clear words where there can be none."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import OBJECT, Scene, orbit, pixel_centres, write_sequence

from dope.common.errors import BadInput
from pipeline.correspond.depth_sampling import DepthSampler
from pipeline.correspond.views import (
    View,
    ViewsConfig,
    build_views,
    object_extent,
    sample_frames,
    source_to_view_pixels,
    view_camera,
    view_to_source_pixels,
    write_view,
)
from pipeline.geometry import Camera
from pipeline.sequence import Frame, Sequence, write_image

DISTORTION = (-0.18, 0.06, 0.002, -0.003)
SCENE = Scene("box")
ALL = ViewsConfig(every=1)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    folder = tmp_path_factory.mktemp("views") / "box"
    return write_sequence(folder, orbit(3, distortion=DISTORTION), SCENE, supersample=2)


@pytest.fixture(scope="module")
def views(sequence: Sequence) -> list[View]:
    return list(build_views(sequence, ALL))


def test_the_camera_of_a_view_is_exact(sequence: Sequence, views: list[View], tmp_path: Path) -> None:
    """A world point projects to the same place through the view's pinhole camera and through the stored image."""
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 3))
    for view, frame in zip(views, sequence.read_frames(), strict=True):
        row = write_view(tmp_path, view, ALL)
        in_view, _ = view_camera(row).project(points)
        in_source, _ = frame.camera.project(points)
        np.testing.assert_allclose(view_to_source_pixels(row, frame, in_view), in_source, atol=1e-6)
        np.testing.assert_allclose(source_to_view_pixels(row, frame, in_source), in_view, atol=1e-5)
        assert np.abs(in_source - frame.camera.K[:2, 2]).max() > 20
        assert np.abs(in_view - view_to_source_pixels(row, frame, in_view)).max() > 5  # the crop is not the identity


@pytest.mark.parametrize("size", [48, 96])
def test_pixels_are_those_a_camera_there_would_see(sequence: Sequence, size: int) -> None:
    """Compared with the scene rendered by the view's own camera: equal, and worse when shifted by a quarter pixel."""
    view = next(build_views(sequence, ViewsConfig(every=1, size=size)))
    inner = np.zeros((size, size), bool)
    inner[8:-8, 8:-8] = True
    inner &= view.mask

    def difference(shift: float) -> float:
        K = view.camera.K + np.array([[0, 0, shift], [0, 0, shift], [0, 0, 0]])
        camera = type(view.camera)(size, size, K, np.zeros(4), view.camera.R, view.camera.t)
        points, _, what = SCENE.trace(camera, pixel_centres(size * 4, size * 4) / 4)
        seen = SCENE.colour(points, what).reshape(size, 4, size, 4, 3).mean(axis=(1, 3))
        return float(np.abs(seen - view.image)[inner].mean())

    there = difference(0)
    assert there < 12
    assert there < 0.8 * min(difference(-0.25), difference(0.25))


def test_shrinking_does_not_alias(tmp_path: Path) -> None:
    """Stripes finer than the view's pixels become grey; point sampling would make a pattern of them."""
    sequence = write_sequence(tmp_path / "ball", orbit(1), Scene("sphere"))
    frame = sequence.read_frames()[0]
    image = np.zeros((240, 320, 3), np.uint8)
    image[:, ::2] = 255
    write_image(sequence.images / "000000.jpg", image, jpeg_quality=100)
    view = next(build_views(sequence, ViewsConfig(every=1, size=32)))
    assert frame.image == "images/000000.jpg"
    assert view.image[4:-4, 4:-4].std() < 20
    assert abs(view.image.mean() - 127) < 4


def test_mask_and_depth_are_the_true_ones(views: list[View]) -> None:
    for view in views:
        _, depth, what = SCENE.trace(view.camera, pixel_centres(224, 224))
        depth, mask = depth.reshape(224, 224), (what == OBJECT).reshape(224, 224)
        assert (view.mask & mask).sum() / (view.mask | mask).sum() > 0.985
        assert view.depth is not None
        both = view.mask & mask & (view.depth > 0)
        error = np.abs(view.depth - depth)[both] / depth[both]
        assert np.median(error) < 2e-4
        assert np.mean(error < 0.01) > 0.995
        assert both.sum() > 0.99 * mask.sum()


def test_smaller_depth_maps_are_sampled_at_the_right_place(tmp_path: Path) -> None:
    sequence = write_sequence(tmp_path / "ball", orbit(1, distortion=DISTORTION), Scene(), depth_size=(160, 120))
    view = next(build_views(sequence, ALL))
    _, depth, _ = Scene().trace(view.camera, pixel_centres(224, 224))
    assert view.depth is not None
    inner = view.mask & (np.hypot(*np.indices((224, 224)) - 112) < 70)
    assert np.median(np.abs(view.depth - depth.reshape(224, 224))[inner]) < 1e-3


def test_the_square_holds_the_object_with_its_margin(views: list[View]) -> None:
    for view in views:
        rows, columns = np.nonzero(view.mask)
        extent = max(np.ptp(rows), np.ptp(columns)) + 1
        assert abs(extent - 224 / 1.2) < 4
        centre = (columns.min() + columns.max() + 1) / 2, (rows.min() + rows.max() + 1) / 2
        np.testing.assert_allclose(centre, 112, atol=2)
        x, y, size = view.crop
        assert 0 < size < 240
        assert -size < x < 320 and -size < y < 240


def moved(camera: Camera, dx: float, dy: float, height: int = 240) -> Camera:
    """The same camera with its image shifted, and maybe cut."""
    return replace(camera, height=height, K=camera.K + np.array([[0, 0, dx], [0, 0, dy], [0, 0, 0]]))


def test_the_square_stays_inside_the_image_where_it_can(tmp_path: Path) -> None:
    camera = moved(orbit(1, wobble=0.0)[0], 75, 0)
    sequence = write_sequence(tmp_path / "edge", [camera], Scene())
    view = next(build_views(sequence, ALL))
    rows, columns = np.nonzero(view.mask)
    assert view.inside_share == 1
    assert 224 / 1.2 - 6 < np.ptp(columns) < 224 and columns.max() > 210 > rows.max()
    np.testing.assert_allclose(rows.mean(), 112, atol=6)


def test_what_the_image_does_not_cover_is_known(tmp_path: Path) -> None:
    """A ball wider than the image is high: the square reaches beyond, and nothing is claimed of what is there."""
    camera = moved(orbit(1, wobble=0.0)[0], 0, -70, height=100)
    view = next(build_views(write_sequence(tmp_path / "strip", [camera], Scene()), ALL))
    side = view.crop[2]
    assert side > 140
    assert view.inside_share == pytest.approx(100 / side, abs=0.02)
    assert view.depth is not None
    for name, values in (("mask", view.mask), ("depth", view.depth)):
        covered = np.flatnonzero(values.any(axis=1))
        assert np.ptp(covered) + 1 == pytest.approx(224 * 100 / side, abs=2), name
        assert covered.mean() == pytest.approx(112, abs=2), name


def test_specks_do_not_widen_the_crop() -> None:
    mask = np.zeros((100, 120), bool)
    mask[40:70, 50:80] = True
    mask[3, 3] = mask[95:97, 110] = True
    extent = object_extent(mask)
    assert extent is not None
    assert extent.min(axis=0).tolist() == [50.5, 40.5] and extent.max(axis=0).tolist() == [79.5, 69.5]
    assert object_extent(np.zeros((5, 5), bool)) is None


def _frames(n: int, dropped: tuple[int, ...] = ()) -> list[Frame]:
    return [Frame(i, f"{i}", 10, 10, dropped="blurred" if i in dropped else None) for i in range(n)]


def test_every_third_frame_by_number() -> None:
    shuffled = [_frames(100)[i] for i in np.random.default_rng(1).permutation(100)]
    chosen = [frame.frame for frame in sample_frames(shuffled, ViewsConfig(every=3))]
    assert chosen == list(range(0, 100, 3)) and len(chosen) == 34  # the paper's 34 of about 100
    dropped = sample_frames(_frames(100, dropped=(0, 3)), ViewsConfig(every=3))
    assert [frame.frame for frame in dropped[:3]] == [1, 5, 8]


def test_short_sequences_are_sampled_more_densely() -> None:
    assert len(sample_frames(_frames(45), ViewsConfig(every=3, min_views=20))) == 23
    assert len(sample_frames(_frames(8), ViewsConfig(every=3, min_views=20))) == 8
    assert len(sample_frames(_frames(45), ViewsConfig(every=3, min_views=0))) == 15


def test_what_cannot_become_a_view_is_counted(tmp_path: Path) -> None:
    sequence = write_sequence(tmp_path / "ball", orbit(5, width=160, height=120, focal=190), Scene())
    frames = sequence.read_frames()
    frames[0].mask = None
    frames[1].clear_camera()
    tiny = np.zeros((120, 160), bool)
    sequence.write_mask(frames[2], tiny)
    tiny[50:60, 50:60] = True
    sequence.write_mask(frames[3], tiny)
    sequence.write_frames(frames)
    skipped: Counter[str] = Counter()
    assert [view.frame for view in build_views(sequence, ALL, skipped)] == [4]
    expected = {"no mask": 1, "not registered": 1, "empty mask": 1, "object smaller than 24 px": 1}
    assert skipped == expected


def test_a_sequence_without_masks_or_cameras_says_what_to_run(tmp_path: Path) -> None:
    small = orbit(2, width=80, height=60, focal=90)
    sequence = write_sequence(tmp_path / "bare", small, masks=False)
    with pytest.raises(BadInput, match=r"bare: .*masks.*dope prep masks"):
        next(build_views(sequence, ALL))
    frames = sequence.read_frames()
    for frame in frames:
        frame.clear_camera()
    sequence.write_frames(frames)
    with pytest.raises(BadInput, match="dope prep colmap"):
        next(build_views(sequence, ALL))


def test_a_mask_of_another_size_is_named(tmp_path: Path) -> None:
    sequence = write_sequence(tmp_path / "ball", orbit(1, width=160, height=120, focal=190))
    frames = sequence.read_frames()
    sequence.write_mask(frames[0], np.ones((60, 80), bool))
    with pytest.raises(BadInput, match=r"000000\.png.*160 x 120"):
        next(build_views(sequence, ALL))


def test_depth_is_exact_on_planes_and_never_between_surfaces() -> None:
    camera = orbit(1, wobble=0.0)[0]
    normal = np.array([0.3, -0.2, 1.0])
    grid = pixel_centres(320, 240)
    plane = 4.0 / (np.concatenate([camera.to_normalised(grid), np.ones((len(grid), 1))], 1) @ normal)
    places = np.random.default_rng(0).uniform([1, 1], [319, 239], (500, 2))
    truth = 4.0 / (np.concatenate([camera.to_normalised(places), np.ones((500, 1))], 1) @ normal)
    sampler = DepthSampler(plane.reshape(240, 320).astype(np.float32))
    np.testing.assert_allclose(sampler(places[:, 0], places[:, 1]), truth, rtol=2e-6)

    step = np.full((20, 20), 2.0, np.float32)
    step[:, 10:], step[5, 5] = 4.0, 0.0
    x, y = np.random.default_rng(1).uniform(0, 20, (2, 4000))
    found = DepthSampler(step)(x, y)
    assert set(np.unique(found)) == {0.0, 2.0, 4.0}
    np.testing.assert_array_equal(found, step[y.astype(int), x.astype(int)])
