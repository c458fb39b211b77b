"""Which views make up a training episode."""

from __future__ import annotations

import numpy as np
import pytest

from dope.common.errors import UsageError
from dope.methods.configs import FeatConfig
from dope.methods.episode_order import EpisodeOrder, population
from dope.order import Place
from dope.view_index import ViewIndex


def an_index(objects: dict[str, int], views: int = 2) -> ViewIndex:
    """Classes with so many objects each."""
    names = sorted(objects)
    rows = [(c, o) for c, name in enumerate(names) for o in range(objects[name]) for _ in range(views)]
    labels = np.array([c for c, _ in rows])
    numbers = np.array([100 * c + o for c, o in rows])
    order = np.random.default_rng(0).permutation(len(rows))
    nothing = np.array([""] * len(rows))
    zeros = np.zeros(len(rows), np.int64)
    return ViewIndex(
        None, nothing, nothing, nothing, zeros, zeros, labels[order], tuple(names), numbers[order], ""  # type: ignore[arg-type]
    )  # fmt: skip


PLENTY = an_index({"a": 7, "b": 6, "c": 9, "d": 6, "e": 5})
SMALL = FeatConfig(ways=3, shots=2, queries=3, episodes=12)


def test_an_episode_holds_distinct_classes_and_distinct_objects_of_them() -> None:
    order = EpisodeOrder(PLENTY, 4, SMALL, seed=1)
    assert (order.steps_per_epoch, order.n_objects, order.left_out) == (3, 33, ())
    episodes = order.epoch(0)
    assert episodes.shape == (3, 4, 3, 5)
    for episode in episodes.reshape(-1, 3, 5):
        labels = PLENTY.labels[episode]
        assert (labels == labels[:, :1]).all() and len(set(labels[:, 0].tolist())) == 3
        assert len(set(PLENTY.objects[episode].ravel().tolist())) == 15
    assert set(PLENTY.labels[episodes].ravel().tolist()) == set(range(5))
    assert len(set(episodes.ravel().tolist())) > 33  # not always the same view of an object


def test_episodes_are_a_function_of_the_seed_and_of_the_epoch() -> None:
    order = EpisodeOrder(PLENTY, 4, SMALL, seed=1)
    assert np.array_equal(order.epoch(2), EpisodeOrder(PLENTY, 4, SMALL, seed=1).epoch(2))
    assert not np.array_equal(order.epoch(2), order.epoch(3))
    assert not np.array_equal(order.epoch(2), EpisodeOrder(PLENTY, 4, SMALL, seed=2).epoch(2))
    # how many episodes make up a step decides nothing else
    assert np.array_equal(
        order.epoch(2).reshape(12, 3, 5), EpisodeOrder(PLENTY, 2, SMALL, seed=1).epoch(2).reshape(12, 3, 5)
    )


def test_episodes_go_on_at_any_step() -> None:
    order = EpisodeOrder(PLENTY, 4, SMALL, seed=1)
    whole = list(order.batches(Place(), 3))
    assert len(whole) == 9 and all(len(rows) == 4 * 15 for rows in whole)
    place = Place()
    for step in range(9):
        assert list(order.batches(place, 3)) == whole[step:]
        place = order.after(place)
    assert place == Place(3, 0)


@pytest.mark.parametrize("world", [2, 4])
def test_ranks_have_whole_episodes_that_make_up_the_step(world: int) -> None:
    order = EpisodeOrder(PLENTY, 4, SMALL, seed=1)
    shares = [list(order.batches(Place(1, 4), 2, rank=rank, world=world)) for rank in range(world)]
    for step, whole in enumerate(order.batches(Place(1, 4), 2)):
        assert [row for share in shares for row in share[step]] == whole
        assert all(len(share[step]) == 4 // world * 15 for share in shares)


def test_classes_with_too_few_objects_take_no_part(caplog: pytest.LogCaptureFixture) -> None:
    index = an_index({"a": 7, "b": 4, "c": 5, "d": 6, "e": 1})
    order = EpisodeOrder(index, 1, SMALL, seed=0)
    assert order.left_out == ("b", "e") and order.n_objects == 18
    assert set(index.labels[order.epoch(0)].ravel().tolist()) == {0, 2, 3}
    assert "fewer than 5 objects take no part in episodes: b, e" in caplog.text


@pytest.mark.parametrize(
    ("objects", "batch_size", "world", "message"),
    [
        ({"a": 5, "b": 5, "c": 4}, 1, 1, "3 classes with 5 objects each .* 2 of 3 .*--set feat.queries=2 or less"),
        ({"a": 5, "b": 5, "c": 2}, 1, 1, "--set feat.ways=2 or less"),
        ({"a": 9, "b": 1}, 1, 1, "Give shards with more classes"),
        ({"a": 5, "b": 5, "c": 5}, 13, 1, "12 episodes an epoch are less than one step of 13"),
        ({"a": 5, "b": 5, "c": 5}, 3, 2, "3 episodes a step cannot be divided among 2 ranks.*batch_size=2"),
    ],
)
def test_what_cannot_be_drawn_is_said_with_what_could(
    objects: dict[str, int], batch_size: int, world: int, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        EpisodeOrder(an_index(objects), batch_size, SMALL, seed=0).batches(Place(), 1, world=world)


def test_the_population_does_not_depend_on_the_order_of_rows() -> None:
    found = population(PLENTY.labels, PLENTY.objects, PLENTY.classes)
    assert list(found) == ["a", "b", "c", "d", "e"] and [len(objects) for objects in found.values()] == [7, 6, 9, 6, 5]
    for name, objects in found.items():
        for number, rows in objects.items():
            assert {PLENTY.classes[label] for label in PLENTY.labels[rows]} == {name}
            assert PLENTY.objects[rows].tolist() == [int(number)] * 2
