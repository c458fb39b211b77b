"""Pairs of views: in range, spread over angles and views, the same every time."""

import numpy as np
import pytest
from synthetic import look_at, orbit

from pipeline.correspond.pairs import PairsConfig, candidate_pairs, select_pairs, view_angles_deg
from pipeline.geometry import Camera

ORIGIN = np.zeros(3)
RING = orbit(36, elevation_deg=0, wobble=0.0)


def test_angles_in_closed_form() -> None:
    angles = view_angles_deg(RING, ORIGIN)
    steps = np.abs(np.subtract.outer(np.arange(36), np.arange(36)))
    np.testing.assert_allclose(angles, 10.0 * np.minimum(steps, 36 - steps), atol=1e-9)


def test_the_angle_is_seen_from_the_object_not_between_axes() -> None:
    """Two cameras side by side with parallel axes see the object from different sides."""
    R, _ = look_at(np.array([0.0, -5, 0]), ORIGIN)
    cameras = [Camera(320, 240, np.eye(3), np.zeros(4), R, -R @ np.array([x, -5.0, 0])) for x in (-5.0, 5.0)]
    assert view_angles_deg(cameras, ORIGIN)[0, 1] == pytest.approx(90)


def test_every_pair_is_in_range_and_there_once() -> None:
    config = PairsConfig(min_angle_deg=15, max_angle_deg=61, max_pairs=1000)
    pairs = select_pairs(RING, ORIGIN, None, config)
    angles = view_angles_deg(RING, ORIGIN)[pairs[:, 0], pairs[:, 1]]
    assert angles.min() >= 15 and angles.max() <= 61
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len({tuple(pair) for pair in pairs.tolist()}) == len(pairs) == 36 * 5  # 20, 30, 40, 50 and 60 degrees


def test_the_same_view_twice_is_no_pair() -> None:
    near = np.array([0.0, -4, 0.001])
    R, t = look_at(near, ORIGIN)
    twin = Camera(320, 240, RING[0].K, np.zeros(4), R, t)
    closer = Camera(320, 240, RING[0].K, np.zeros(4), *look_at(near * 0.5, ORIGIN))
    assert len(select_pairs([twin, twin, closer], ORIGIN, None, PairsConfig())) == 0


def test_a_camera_that_returns_to_its_place_is_the_same_view_however_it_is_turned() -> None:
    """Two laps, the second a little off, rolled about the viewing axis and aimed elsewhere: no pair across the laps."""
    places = [camera.centre for camera in RING[:12]]
    laps = []
    for lap, (roll, nearer) in enumerate(((0.0, 1.0), (80.0, 0.9))):
        for k, centre in enumerate(places):
            off = 0.03 * lap * np.array([np.sin(k), np.cos(k), 1.0])
            R, t = look_at(centre * nearer + off, 0.3 * lap * np.ones(3), roll_deg=roll)
            laps.append(Camera(320, 240, RING[0].K, np.zeros(4), R, t))
    pairs = select_pairs(laps, ORIGIN, None, PairsConfig(max_pairs=10_000))
    assert len(pairs) > 200
    assert not {(int(i), int(j)) for i, j in pairs} & {(k, k + 12) for k in range(12)}


def test_angles_and_views_are_used_evenly() -> None:
    config = PairsConfig(max_pairs=72, angle_bins=4, min_angle_deg=5, max_angle_deg=85)
    pairs = select_pairs(RING, ORIGIN, None, config)
    assert len(pairs) == 72
    uses = np.bincount(pairs.ravel(), minlength=36)
    assert uses.min() >= 3 and uses.max() <= 5
    angles = view_angles_deg(RING, ORIGIN)[pairs[:, 0], pairs[:, 1]]
    assert np.histogram(angles, [5, 25, 45, 65, 85])[0].tolist() == [18] * 4


def test_little_overlap_is_replaced_by_other_pairs() -> None:
    asked = []

    def overlap(i: int, j: int) -> float:
        asked.append((i, j))
        return 0.0 if (i + j) % 2 else 0.5

    config = PairsConfig(max_pairs=40)
    pairs = select_pairs(RING, ORIGIN, overlap, config)
    assert len(pairs) == 40
    assert not ((pairs.sum(axis=1)) % 2).any()
    assert len(asked) == len(set(asked)) < len(candidate_pairs(view_angles_deg(RING, ORIGIN), config))
    assert len(select_pairs(RING, ORIGIN, lambda i, j: 0.0, config)) == 0


def test_hopeless_ranges_of_angle_are_given_up() -> None:
    """Without this, thousands of wide pairs of a long video would be tried one by one."""
    many, asked = orbit(120, elevation_deg=0, wobble=0.0), []

    def overlap(i: int, j: int) -> float:
        asked.append((i, j))
        return float(min(j - i, 120 - j + i) < 10)  # nothing beyond 30 degrees

    pairs = select_pairs(many, ORIGIN, overlap, PairsConfig(max_pairs=100))
    assert len(pairs) == 100 and len(asked) < 700
    assert view_angles_deg(many, ORIGIN)[pairs[:, 0], pairs[:, 1]].max() < 30


def test_the_choice_depends_on_the_seed_alone() -> None:
    config = PairsConfig(max_pairs=30)
    first, again = (select_pairs(RING, ORIGIN, None, config) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    other = select_pairs(RING, ORIGIN, None, PairsConfig(max_pairs=30, seed=1))
    assert {*map(tuple, first.tolist())} != {*map(tuple, other.tolist())}


def test_fewer_than_two_views_have_no_pairs() -> None:
    assert select_pairs([], ORIGIN, None, PairsConfig()).shape == (0, 2)
    assert select_pairs(RING[:1], ORIGIN, None, PairsConfig()).shape == (0, 2)
