import pytest

from dope import meter
from dope.meter import Meter


class Clock:
    """Time passes only where a test says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(meter.time, "perf_counter", lambda: self.now)


def test_speed_and_waiting_leave_the_first_step_out(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    measured = Meter(first_step=0)
    assert (measured.pairs_per_second, measured.data_wait) == (0.0, 0.0)

    def batches():  # type: ignore[no-untyped-def]
        for seconds in (100.0, 1.0, 2.0):
            clock.now += seconds
            yield seconds
        clock.now += 50.0  # the end of the data is no step

    seen = []
    for batch in measured.waiting_for(batches()):
        clock.now += 9.0 - batch if batch < 100 else 20.0
        measured.add(8, loss=batch)
        seen.append(batch)
    assert seen == [100.0, 1.0, 2.0] and measured.loss == 2.0
    assert measured.pairs_per_second == pytest.approx(16 / 18)
    assert measured.data_wait == pytest.approx(3 / 18)
    assert measured.seconds == 188.0


def test_only_the_last_steps_count(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, measured = Clock(monkeypatch), Meter(first_step=0, window=4)
    for seconds in [5.0] * 6 + [1.0] * 4:
        for _ in measured.waiting_for([None]):
            clock.now += seconds
            measured.add(2, loss=0.0)
    assert measured.pairs_per_second == pytest.approx(2.0)


def test_a_broken_off_loop_closes_the_data() -> None:
    closed = []

    def batches():  # type: ignore[no-untyped-def]
        try:
            yield from range(9)
        finally:
            closed.append(True)

    for batch in Meter(first_step=0).waiting_for(batches()):
        if batch == 1:
            break
    assert closed == [True]
