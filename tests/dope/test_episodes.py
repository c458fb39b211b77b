from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from dope.common.errors import UsageError
from dope.lowshot.episodes import EpisodeConfig, Episodes, sample_episodes

CONFIG = EpisodeConfig(ways=3, shots=2, queries=4, episodes=300, seed=7)


def population(classes: int = 5, objects: int = 8, views: int = 3) -> dict[str, dict[str, list[int]]]:
    """View (c * objects + o) * views + v belongs to object o of class c; object o has views - o % 2 of them."""
    return {
        f"class{c}": {
            f"object{o}": [(c * objects + o) * views + v for v in range(views - o % 2)] for o in range(objects)
        }
        for c in range(classes)
    }


def owners(views: dict[str, dict[str, list[int]]]) -> dict[int, tuple[str, str]]:
    return {i: (name, obj) for name, objects in views.items() for obj, found in objects.items() for i in found}


def per_class(episodes: Episodes) -> list[tuple[str, list[int], list[int]]]:
    return [
        (episodes.names[episodes.classes[e, w]], episodes.support[e, w].tolist(), episodes.query[e, w].tolist())
        for e in range(len(episodes))
        for w in range(episodes.config.ways)
    ]


def test_views_are_of_the_class_and_no_object_is_both_shot_and_query() -> None:
    views = population()
    owner = owners(views)
    episodes = sample_episodes(views, CONFIG)
    assert episodes.support.shape == (300, 3, 2) and episodes.query.shape == (300, 3, 4)
    for name, shots, queries in per_class(episodes):
        assert {owner[i][0] for i in shots + queries} == {name}
        assert len({owner[i][1] for i in shots + queries}) == 6  # one view each of six objects
    assert all(len(set(row)) == 3 for row in episodes.classes.tolist())


def test_every_class_object_and_view_is_drawn_equally_often() -> None:
    views = population(classes=4, objects=6, views=3)
    episodes = sample_episodes(views, replace(CONFIG, ways=2, shots=1, queries=2, episodes=20_000))
    owner = owners(views)
    for drawn, each in ((episodes.support, 1), (episodes.query, 2)):
        share: dict[tuple[str, str], float] = dict.fromkeys(owner.values(), 0.0)
        for i, n in zip(*np.unique(drawn, return_counts=True), strict=True):
            name, obj = owner[int(i)]
            share[owner[int(i)]] += n
            mean = 20_000 * 2 * each / 4 / 6 / len(views[name][obj])
            assert abs(n - mean) < 6 * mean**0.5
        assert len({*np.unique(drawn).tolist()}) == len(owner)


def test_the_seed_decides() -> None:
    first, second = (sample_episodes(population(), CONFIG) for _ in range(2))
    np.testing.assert_array_equal(first.support, second.support)
    np.testing.assert_array_equal(first.query, second.query)
    other = sample_episodes(population(), replace(CONFIG, seed=8))
    assert (first.query != other.query).mean() > 0.8


def test_shots_of_one_object_are_distinct_views_and_queries_are_other_objects() -> None:
    views = population(views=3)  # odd objects have two views and cannot give three shots
    owner = owners(views)
    episodes = sample_episodes(views, replace(CONFIG, shots=3, shot_mode="one_instance"))
    shot_objects = set()
    for _, shots, queries in per_class(episodes):
        (shot_object,) = {owner[i] for i in shots}
        shot_objects.add(shot_object[1])
        assert len(set(shots)) == 3 and shot_object not in {owner[i] for i in queries}
        assert len({owner[i] for i in queries}) == 4
    assert shot_objects == {"object0", "object2", "object4", "object6"}


def test_instances_as_classes_share_no_view_between_shots_and_queries() -> None:
    views = population(classes=2, objects=4, views=9)
    owner = owners(views)
    episodes = sample_episodes(views, replace(CONFIG, classes="instance"))
    assert len(episodes.names) == 8
    for name, shots, queries in per_class(episodes):
        assert {"/".join(owner[i]) for i in shots + queries} == {name}
        assert len(set(shots + queries)) == 6


def test_too_few_views_say_what_is_there_and_which_flag_to_change() -> None:
    with pytest.raises(UsageError, match=r"at least 9 classes of 6 objects.* there are 5 classes.*--ways"):
        sample_episodes(population(), replace(CONFIG, ways=9))
    with pytest.raises(UsageError, match=r"too small: class0 \(8\).*--queries.*--classes instance"):
        sample_episodes(population(), replace(CONFIG, queries=15))
    with pytest.raises(UsageError, match="one of them with 5 views"):
        sample_episodes(population(), replace(CONFIG, shots=5, shot_mode="one_instance"))
    with pytest.raises(UsageError, match="--ways: must be at least 2"):
        sample_episodes(population(), replace(CONFIG, ways=1))


def test_one_small_class_is_named_and_not_silently_left_out() -> None:
    views = population()
    views["small"] = {"only": [1000, 1001]}
    with pytest.raises(UsageError, match=r"small \(1\)"):
        sample_episodes(views, CONFIG)
    episodes = sample_episodes(views, replace(CONFIG, fit=True))
    assert episodes.left_out == ("small",) and "small" not in episodes.names


def test_fit_reduces_ways_and_queries_to_what_is_there() -> None:
    episodes = sample_episodes(population(), replace(CONFIG, ways=20, queries=15, fit=True))
    assert (episodes.config.ways, episodes.config.queries, episodes.chance) == (5, 6, 0.2)
    with pytest.raises(UsageError, match="at least 2 classes"):
        sample_episodes(population(classes=1), replace(CONFIG, fit=True))


def test_the_papers_episodes_are_drawn_in_under_a_second() -> None:
    views = population(classes=20, objects=150, views=20)
    started = time.process_time()
    sample_episodes(views, EpisodeConfig(ways=10, shots=5))
    assert time.process_time() - started < 1
