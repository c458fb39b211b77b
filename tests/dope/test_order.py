import itertools
import logging

import numpy as np
import pytest

from dope.common.errors import UsageError
from dope.order import Order, Place, SampleOrder

BOTH = pytest.mark.parametrize("kind", ["shuffled", "sequential"])
OBJECTS = np.repeat(np.arange(10) * 3, [4, 1, 3, 4, 4, 2, 4, 4, 5, 4])[np.random.default_rng(0).permutation(35)]
SHUFFLED = [
    [3, 26, 30, 28, 14, 16, 24],
    [7, 0, 27, 21, 26, 4, 12],
    [0, 20, 11, 1, 15, 8, 3],
    [22, 28, 32, 25, 29, 14, 19],
]


def all_batches(order: SampleOrder, start: Place, epochs: int, **ranks: int) -> list[list[int]]:
    return list(order.batches(start, epochs, **ranks))


@BOTH
def test_an_epoch_shows_each_object_once_with_a_pair_of_its_own(kind: Order) -> None:
    order = SampleOrder(OBJECTS, 5, order=kind, block=2)
    assert order.steps_per_epoch == 2
    epoch = order.epoch(3)
    assert epoch.shape == (2, 5)
    assert sorted(OBJECTS[epoch.ravel()]) == list(np.arange(10) * 3)


def test_incomplete_batches_are_dropped() -> None:
    assert SampleOrder(OBJECTS, 4).epoch(0).shape == (2, 4)


def test_pairs_of_an_object_are_not_repeated_before_all_were_shown() -> None:
    order = SampleOrder(OBJECTS, 10)
    shown = [int(row) for epoch in range(12) for row in order.epoch(epoch).ravel()]
    for number in np.unique(OBJECTS):
        own = [row for row in shown if OBJECTS[row] == number]
        n_pairs = int(np.count_nonzero(number == OBJECTS))
        for cycle in range(12 // n_pairs):
            assert len(set(own[cycle * n_pairs : (cycle + 1) * n_pairs])) == n_pairs


def test_the_pairs_come_in_another_order_in_each_cycle() -> None:
    order = SampleOrder(np.zeros(50, int), 2, pairs_per_object=50)
    first, second = order.epoch(0).ravel(), order.epoch(1).ravel()
    assert sorted(first) == sorted(second) == list(range(50))
    assert (first != second).mean() > 0.8


@BOTH
@pytest.mark.parametrize("block", [1, 2, 3, 32])
def test_batches_that_span_rounds_hold_no_object_twice_and_lose_nothing(kind: Order, block: int) -> None:
    order = SampleOrder(OBJECTS, 7, pairs_per_object=7, order=kind, block=block)
    epoch = order.epoch(2)
    assert epoch.shape == (10, 7)
    for batch in epoch:
        assert len(set(OBJECTS[batch])) == 7
    assert np.bincount(OBJECTS[epoch.ravel()])[::3].tolist() == [7] * 10


@BOTH
def test_epochs_and_seeds_differ_and_repeat(kind: Order) -> None:
    order, same, other = (SampleOrder(OBJECTS, 5, seed=seed, order=kind, block=2) for seed in (0, 0, 1))
    assert (order.epoch(4) == same.epoch(4)).all()
    assert (order.epoch(4) != order.epoch(5)).any()
    assert (order.epoch(4) != other.epoch(4)).any()


@BOTH
@pytest.mark.parametrize("world", [1, 2, 4])
def test_going_on_with_any_number_of_ranks_gives_the_samples_not_yet_seen(world: int, kind: Order) -> None:
    order = SampleOrder(OBJECTS, 4, pairs_per_object=2, order=kind, block=3)
    whole = all_batches(order, Place(), 3)
    place = Place()
    for _ in range(7):
        place = order.after(place)
    assert place == Place(1, 8)
    shares = [all_batches(order, place, 3, rank=rank, world=world) for rank in range(world)]
    joined = [[row for share in shares for row in share[step]] for step in range(len(shares[0]))]
    assert joined == whole[7:]


def test_place_moves_to_the_next_epoch_after_the_last_whole_batch() -> None:
    order = SampleOrder(OBJECTS, 4)  # 10 objects: two batches, two objects dropped
    assert order.after(order.after(Place(5, 0))) == Place(6, 0)


def test_less_than_one_batch_is_an_error_that_names_both_settings() -> None:
    with pytest.raises(UsageError, match=r"data\.batch_size=10 .* data\.pairs_per_object=3"):
        SampleOrder(OBJECTS, 24)


@BOTH
def test_several_pairs_an_object_make_up_for_few_objects(kind: Order, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert SampleOrder(OBJECTS, 24, pairs_per_object=5, order=kind).epoch(0).shape == (2, 24)
    assert "10 objects fill a batch of 24" in caplog.text


def test_a_batch_that_ranks_cannot_share_is_an_error() -> None:
    with pytest.raises(UsageError, match=r"data\.batch_size=3"):
        SampleOrder(OBJECTS, 5).batches(Place(), 1, world=3)


def test_the_shuffled_order_is_that_of_runs_before() -> None:
    rows = SampleOrder(OBJECTS, 7, pairs_per_object=3).epoch(1)
    assert rows.tolist() == SHUFFLED  # a checkpoint's place means the same samples in every version


def in_rounds(n_objects: int, pairs: int) -> np.ndarray:
    """The objects as `dope prep shards` writes them: every object once, shuffled, then every object again."""
    generator = np.random.default_rng(1)
    return np.concatenate([generator.permutation(n_objects) for _ in range(pairs)])


@pytest.mark.parametrize(("batch", "world"), [(64, 1), (64, 4), (96, 1)])
def test_sequential_shares_are_a_few_runs_of_neighbours(batch: int, world: int) -> None:
    objects = in_rounds(480, 4)
    runs = {}
    for kind in ("shuffled", "sequential"):
        order = SampleOrder(objects, batch, pairs_per_object=4, order=kind, block=16)  # type: ignore[arg-type]
        shares = [share for rank in range(world) for share in order.batches(Place(), 2, rank=rank, world=world)]
        runs[kind] = np.mean([1 + np.count_nonzero(np.diff(sorted(share)) > 1) for share in shares])
    assert runs["sequential"] < 2.2 * batch / 16 / world + 2 < runs["shuffled"]


def test_a_sequential_round_is_one_of_the_shards_and_all_get_their_turn() -> None:
    order = SampleOrder(in_rounds(60, 5), 60, order="sequential", block=8)
    for cycle in range(3):
        rounds = [set((order.epoch(5 * cycle + step) // 60).ravel().tolist()) for step in range(5)]
        assert sorted(rounds, key=min) == [{0}, {1}, {2}, {3}, {4}]
    turns = [int(order.epoch(step).min()) // 60 for step in range(15)]
    assert turns[:5] != turns[5:10] or turns[5:10] != turns[10:]


def test_objects_with_fewer_pairs_show_all_of_them_equally_often() -> None:
    order = SampleOrder(OBJECTS, 10, order="sequential", block=4)  # at most 5 pairs
    shown = np.concatenate([order.epoch(epoch).ravel() for epoch in range(5 * 12)])
    assert set(shown.tolist()) == set(range(35))
    for number in np.unique(OBJECTS):
        times = np.bincount(shown, minlength=35)[number == OBJECTS]
        assert times.sum() == 60 and times.max() - times.min() <= 1


def test_sequential_batches_are_of_several_places_and_blocks_are_cut_elsewhere_each_round() -> None:
    order = SampleOrder(in_rounds(960, 1), 64, order="sequential", block=32)
    assert not (order.epoch(0)[0] == np.arange(64) + order.epoch(0)[0].min()).all()
    cuts = []
    for seed in (0, 1):
        rows = order._in_blocks(np.arange(960), np.random.default_rng(seed)).tolist()
        assert sorted(rows) == list(range(960))
        ends = {row % 32 for row, after in itertools.pairwise(rows) if after != row + 1}
        cuts.append(ends - {959 % 32})
    assert cuts[0] != cuts[1]


def test_large_orders_are_fast() -> None:
    objects = np.repeat(np.arange(20_000), 20)
    import time

    for kind in ("shuffled", "sequential"):
        order = SampleOrder(objects, 256, order=kind)  # type: ignore[arg-type]
        start = time.process_time()
        order.epoch(7)
        assert time.process_time() - start < 1.0
