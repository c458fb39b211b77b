"""Correspondences against an analytic scene, where the true place of every pixel is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from synthetic import OBJECT, Scene, orbit, write_sequence
from test_farthest_points import naive

from pipeline.correspond.match import (
    CorrespondConfig,
    CorrespondenceConfig,
    Surface,
    _consistent,
    correspond,
    estimate_overlap,
    match,
    match_views,
)
from pipeline.correspond.pairs import PairsConfig
from pipeline.correspond.views import View, ViewsConfig, build_views, read_views, view_camera, view_to_source_pixels
from pipeline.sequence import Sequence, read_image

DISTORTION = (-0.18, 0.06, 0.002, -0.003)
CONFIG = CorrespondConfig(ViewsConfig(every=1), PairsConfig(max_pairs=12))
MATCH = CONFIG.match


@pytest.fixture(scope="module", params=["sphere", "box"])
def scene(request: pytest.FixtureRequest) -> Scene:
    return Scene(request.param)


@pytest.fixture(scope="module")
def sequence(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    cameras = orbit(6, arc_deg=150, distortion=DISTORTION)
    return write_sequence(tmp_path_factory.mktemp("correspond") / scene.shape, cameras, scene)


@pytest.fixture(scope="module")
def views(sequence: Sequence) -> list[View]:
    return list(build_views(sequence, CONFIG.views))


@pytest.fixture(scope="module")
def surfaces(views: list[View]) -> list[Surface]:
    return [Surface(view) for view in views]


def true_error_px(scene: Scene, one: Surface, two: Surface, points: NDArray) -> tuple[NDArray, NDArray]:
    truth, visible = scene.transfer(one.camera, points[:, :2].astype(float), two.camera)
    return np.linalg.norm(truth - points[:, 2:], axis=1), visible


@pytest.mark.parametrize(("gap", "median", "within_1px"), [(1, 0.02, 0.99), (2, 0.05, 0.985), (3, 0.05, 0.97)])
def test_points_lie_where_they_should(
    scene: Scene, surfaces: list[Surface], gap: int, median: float, within_1px: float
) -> None:
    errors, seen = [], []
    for one, two in zip(surfaces, surfaces[gap:], strict=False):
        points = match_views(one, two, MATCH)
        assert points.dtype == np.float32 and points.shape == (512, 4)
        error, visible = true_error_px(scene, one, two, points)
        errors.append(error)
        seen.append(visible)
    assert np.median(np.concatenate(errors)) < median
    assert np.mean(np.concatenate(errors) < 1) > within_1px
    assert np.mean(np.concatenate(seen)) > 0.995  # what is hidden in view 2 has no match


@pytest.mark.parametrize(("gap", "seen_share", "hidden_share"), [(1, 0.94, 0.04), (4, 0.6, 0.01)])
def test_what_both_views_see_is_matched_and_nothing_else(
    scene: Scene, surfaces: list[Surface], gap: int, seen_share: float, hidden_share: float
) -> None:
    one, two = surfaces[0], surfaces[gap]
    found = _consistent(one, two, MATCH)
    _, visible = scene.transfer(one.camera, one.xy.T.astype(float), two.camera)
    matched = np.zeros(len(one.pixels), bool)
    matched[found.index] = True
    assert (matched & visible).sum() > seen_share * visible.sum()
    assert (matched & ~visible).sum() <= hidden_share * (~visible).sum()
    assert gap == 1 or (~visible).sum() > 3000
    assert match(one, two, MATCH).overlap == pytest.approx(len(found.index) / one.n_mask)
    assert estimate_overlap(one, two, MATCH) == pytest.approx(len(found.index) / one.n_mask, abs=0.04)


def test_a_view_matches_itself_exactly(surfaces: list[Surface]) -> None:
    points = match_views(surfaces[0], surfaces[0], MATCH)
    np.testing.assert_allclose(points[:, :2], points[:, 2:], atol=1e-3)


def test_points_are_in_farthest_point_order_on_view_1(surfaces: list[Surface]) -> None:
    one, two = surfaces[0], surfaces[1]
    points = match_views(one, two, replace(MATCH, max_points=40))
    assert ((points[:, :2] % 1) == 0.5).all()
    candidates = one.pixels[_consistent(one, two, MATCH).index]
    start = int(np.flatnonzero((candidates + 0.5 == points[0, :2]).all(axis=1))[0])
    np.testing.assert_array_equal(points[:, :2], candidates[naive(candidates, 40, start)] + 0.5)
    starts = {tuple(match_views(one, two, replace(MATCH, seed=seed))[0, :2]) for seed in range(8)}
    assert len(starts) > 4  # the start is drawn, not fixed


def test_wrong_depth_has_no_matches(views: list[View]) -> None:
    """Each check by itself: depth that disagrees by more than its tolerance, and a cycle that does not close."""
    one = Surface(views[0])
    assert views[1].depth is not None
    farther = Surface(replace(views[1], depth=views[1].depth * np.float32(1.03)))
    loose = replace(MATCH, depth_tolerance=0.5, cycle_px=1e6)
    agreeing = match(one, farther, replace(loose, depth_tolerance=0.02)).overlap
    assert agreeing < 0.03 * match(one, farther, loose).overlap  # a few hidden points happen to be that much farther
    shaken = np.random.default_rng(0).normal(1, 0.01, views[1].depth.shape).astype(np.float32)
    noisy = Surface(replace(views[1], depth=views[1].depth * shaken))
    unchecked = match(one, noisy, loose)
    checked = match(one, noisy, replace(loose, cycle_px=1.0))
    assert 0 < checked.overlap < 0.8 * unchecked.overlap
    assert checked.cycle_px < 0.7


def test_unknown_depth_and_empty_masks_have_no_matches(views: list[View]) -> None:
    one, two = Surface(views[0]), Surface(views[1])
    assert views[1].depth is not None
    blind = Surface(replace(views[1], depth=np.zeros_like(views[1].depth)))
    hidden = Surface(replace(views[1], mask=np.zeros_like(views[1].mask)))
    for other in (blind, hidden):
        assert match_views(one, other, MATCH).shape == (0, 4)
        assert match_views(other, two, MATCH).shape == (0, 4)
        assert estimate_overlap(other, two, MATCH) == 0


def test_views_that_look_away_from_each_other_have_no_matches(views: list[View]) -> None:
    one, two = Surface(views[0]), Surface(views[1])
    turned = np.diag([-1.0, 1, -1])  # the object is behind this camera
    two.camera = replace(two.camera, R=turned @ two.camera.R, t=turned @ two.camera.t)
    assert match_views(one, two, MATCH).shape == (0, 4)


@pytest.fixture(scope="module")
def written(sequence: Sequence) -> tuple[Sequence, dict]:
    return sequence, correspond(sequence, CONFIG)


def test_the_stage_writes_what_it_says(written: tuple[Sequence, dict], scene: Scene) -> None:
    sequence, details = written
    rows = read_views(sequence)
    pairs = pq.read_table(sequence.correspondences).to_pylist()
    assert details["views"] == len(rows) == 6
    assert details["pairs"] == len(pairs) <= 12
    assert details["median_correspondences"] == 512 and "empty" not in details
    by_frame = {row["frame"]: row for row in rows}
    frames = {frame.frame: frame for frame in sequence.read_frames()}
    for row in rows:
        image, mask = (read_image(sequence.folder / row[name]) for name in ("image", "mask"))
        assert image.shape == mask.shape == (224, 224, 3)
        assert set(np.unique(mask)) == {0, 255}
        assert row["mask_share"] == pytest.approx((mask[..., 0] > 0).mean())
        assert row["depth_share"] > 0.98
    for pair in pairs:
        points = np.array(pair["points"], np.float32).reshape(-1, 4)
        assert len(points) == pair["n_correspondences"]
        assert 5 <= pair["angle_deg"] <= 90 and 0.05 <= pair["overlap"] <= 1 and pair["cycle_px"] < 0.5
        one, two = by_frame[pair["frame1"]], by_frame[pair["frame2"]]
        # through the stored, distorted images, as one would check against cameras of another tool
        source1 = view_to_source_pixels(one, frames[pair["frame1"]], points[:, :2])
        source2 = view_to_source_pixels(two, frames[pair["frame2"]], points[:, 2:])
        truth, _ = scene.transfer(frames[pair["frame1"]].camera, source1, frames[pair["frame2"]].camera)
        assert np.median(np.linalg.norm(truth - source2, axis=1)) < 0.1
        assert view_camera(one).width == 224


def test_again_gives_the_same_bytes(written: tuple[Sequence, dict]) -> None:
    sequence, details = written
    files = [*sequence.views.iterdir(), sequence.correspondences, sequence.folder / "views.parquet"]
    before = {path: path.read_bytes() for path in files}
    assert correspond(sequence, CONFIG) == details
    assert {path: path.read_bytes() for path in files} == before


def test_nothing_to_pair_is_empty_with_a_reason(tmp_path: Path) -> None:
    small = orbit(4, width=160, height=120, focal=190)
    details = correspond(write_sequence(tmp_path / "flat", small, depths=False), CONFIG)
    assert details["empty"] == "only 0 of 4 views have depth on the object" and details["views"] == 4
    details = correspond(write_sequence(tmp_path / "one", small[:1]), CONFIG)
    assert details["empty"].startswith("only 1 of the sampled frames")
    sequence = write_sequence(tmp_path / "still", [small[0]] * 3)
    details = correspond(sequence, CONFIG)
    assert details["empty"] == "no two views are apart by an angle in the wanted range"
    assert pq.read_table(sequence.correspondences).num_rows == 0
    opposite = [orbit(2, width=160, height=120, focal=190, elevation_deg=5, wobble=0.0)[i] for i in (0, 1)]
    wide = replace(CONFIG, pairs=PairsConfig(max_angle_deg=180))
    details = correspond(write_sequence(tmp_path / "opposite", opposite), wide)
    assert details["empty"] == "none of 1 candidate pairs remains (1 overlap too small)"


def test_pairs_with_too_few_points_are_dropped_and_counted(sequence: Sequence, tmp_path: Path) -> None:
    few = replace(CONFIG, match=CorrespondenceConfig(max_points=20))
    copy = write_sequence(tmp_path / "ball", orbit(3, arc_deg=60, width=160, height=120, focal=190))
    details = correspond(copy, few)
    assert details["pairs"] == 0 and details["pairs_dropped"] == {"too few correspondences": 3}
    assert details["share_of_chosen_with_enough_points"] == 0


def test_the_scene_is_what_it_claims(scene: Scene) -> None:
    """The yardstick itself: a point on the object, projected, is hit by the ray through its pixel."""
    first, second = orbit(2, arc_deg=40, distortion=DISTORTION)
    points, depth, what = scene.trace(first, np.array([[160.0, 120.0], [150.0, 110.0]]))
    assert (what == OBJECT).all()
    np.testing.assert_allclose(first.project(points)[1], depth, rtol=1e-9)
    moved, _ = scene.transfer(first, np.array([[160.0, 120.0], [150.0, 110.0]]), second)
    np.testing.assert_allclose(moved, second.project(points)[0], atol=1e-9)
