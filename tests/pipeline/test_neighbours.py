"""Which views are matched with which."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import look_at

from pipeline.depth.neighbours import NeighbourConfig, choose_neighbours, sees
from pipeline.geometry import Camera

ORIGIN = np.zeros(3)


def on_circle(angle_deg: float, distance: float = 5.0) -> Camera:
    angle = np.radians(angle_deg)
    R, t = look_at(distance * np.array([np.cos(angle), np.sin(angle), 0.3]), ORIGIN)
    return Camera(100, 80, np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]), np.zeros(4), R, t)


def neighbours_of_first(angles: list[float], config: NeighbourConfig | None = None) -> list[float]:
    cameras = [on_circle(angle) for angle in angles]
    chosen = choose_neighbours(cameras, np.zeros((len(cameras), 3)), config or NeighbourConfig())
    return [angles[j] for j in chosen[0]]


def test_preferred_angles_come_first_and_both_sides_are_used() -> None:
    chosen = neighbours_of_first([0, *range(-30, 0), *range(1, 31)], NeighbourConfig(count=2))
    assert sorted(np.sign(chosen)) == [-1, 1]
    assert all(6 <= abs(angle) <= 12.6 for angle in chosen)  # the camera is above the circle's plane


def test_what_exists_is_used_where_nothing_better_does() -> None:
    assert neighbours_of_first([0, 20, -45]) == [20]
    assert neighbours_of_first([0, 1, 3, 60]) == [3]
    assert neighbours_of_first([0, 1, 50]) == []


def test_neighbours_are_spread_before_they_are_doubled() -> None:
    chosen = neighbours_of_first([0, 8.0, 8.1, 8.2, 8.3, -11.0], NeighbourConfig(count=2))
    assert set(chosen) >= {-11.0}


def test_cameras_that_moved_forwards_are_skipped() -> None:
    first, beside = on_circle(0), on_circle(8)
    ahead = on_circle(8, distance=3.0)  # the baseline is 22 degrees from the viewing direction
    assert choose_neighbours([first, ahead], np.zeros((2, 3)), NeighbourConfig()) == [[], []]
    loose = NeighbourConfig(min_baseline_deg=10)
    assert choose_neighbours([first, ahead], np.zeros((2, 3)), loose) == [[1], [0]]
    assert choose_neighbours([first, beside], np.zeros((2, 3)), NeighbourConfig()) == [[1], [0]]


def test_views_that_do_not_see_the_target_are_skipped() -> None:
    first, second = on_circle(0), on_circle(8)
    turned = Camera(100, 80, second.K, second.distortion, np.diag([-1.0, 1, -1]) @ second.R, second.t * [-1, 1, -1])
    assert not sees(turned, ORIGIN) and sees(second, ORIGIN)
    assert choose_neighbours([first, turned], np.zeros((2, 3)), NeighbourConfig())[0] == []


@pytest.mark.parametrize("count", [1, 3])
def test_views_without_a_target_have_no_neighbours(count: int) -> None:
    cameras = [on_circle(a) for a in (0, 8, 16)]
    targets = np.array([[np.nan] * 3, [0, 0, 0], [0, 0, 0]])
    chosen = choose_neighbours(cameras, targets, NeighbourConfig(count=count))
    assert chosen[0] == [] and len(chosen[1]) == min(count, 2)
