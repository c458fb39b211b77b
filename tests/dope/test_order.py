import logging

import numpy as np
import pytest

from dope.common.errors import UsageError
from dope.order import Place, SampleOrder

OBJECTS = np.repeat(np.arange(10) * 3, [4, 1, 3, 4, 4, 2, 4, 4, 5, 4])[np.random.default_rng(0).permutation(35)]


def all_batches(order: SampleOrder, start: Place, epochs: int, **ranks: int) -> list[list[int]]:
    return list(order.batches(start, epochs, **ranks))


def test_an_epoch_shows_each_object_once_with_a_pair_of_its_own() -> None:
    order = SampleOrder(OBJECTS, 5)
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


def test_batches_that_span_rounds_hold_no_object_twice_and_lose_nothing() -> None:
    order = SampleOrder(OBJECTS, 7, pairs_per_object=7)
    epoch = order.epoch(2)
    assert epoch.shape == (10, 7)
    for batch in epoch:
        assert len(set(OBJECTS[batch])) == 7
    assert np.bincount(OBJECTS[epoch.ravel()])[::3].tolist() == [7] * 10


def test_epochs_and_seeds_differ_and_repeat() -> None:
    order, same, other = SampleOrder(OBJECTS, 5), SampleOrder(OBJECTS, 5), SampleOrder(OBJECTS, 5, seed=1)
    assert (order.epoch(4) == same.epoch(4)).all()
    assert (order.epoch(4) != order.epoch(5)).any()
    assert (order.epoch(4) != other.epoch(4)).any()


@pytest.mark.parametrize("world", [1, 2, 4])
def test_going_on_with_any_number_of_ranks_gives_the_samples_not_yet_seen(world: int) -> None:
    order = SampleOrder(OBJECTS, 4, pairs_per_object=2)
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


def test_several_pairs_an_object_make_up_for_few_objects(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert SampleOrder(OBJECTS, 24, pairs_per_object=5).epoch(0).shape == (2, 24)
    assert "10 objects fill a batch of 24" in caplog.text


def test_a_batch_that_ranks_cannot_share_is_an_error() -> None:
    with pytest.raises(UsageError, match=r"data\.batch_size=3"):
        SampleOrder(OBJECTS, 5).batches(Place(), 1, world=3)


def test_large_orders_are_fast() -> None:
    objects = np.repeat(np.arange(20_000), 20)
    order = SampleOrder(objects, 256)
    import time

    start = time.process_time()
    order.epoch(7)
    assert time.process_time() - start < 1.0
