import os
import signal
from collections.abc import Iterator

import pytest

from dope.stop_signals import STOP_SIGNALS, StopRequest


class Untouched(Exception):
    """What the handler raises that was there before."""


@pytest.fixture(autouse=True)
def own_handlers() -> Iterator[None]:
    """Handlers that tell that a signal "acts as usual", instead of ending the tests."""

    def usual(number: int, frame: object) -> None:
        raise Untouched(signal.Signals(number).name)

    before = {number: signal.signal(number, usual) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_they_are_the_batch_systems_and_the_terminals() -> None:
    assert set(STOP_SIGNALS) == {signal.SIGTERM, signal.SIGUSR1, signal.SIGINT, signal.SIGHUP}


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_is_a_request_and_acts_as_usual_afterwards(number: int) -> None:
    with StopRequest() as stop:
        assert not stop.requested
        os.kill(os.getpid(), number)
        assert stop.requested
    with pytest.raises(Untouched, match=signal.Signals(number).name):
        os.kill(os.getpid(), number)


def test_a_batch_system_may_repeat_itself_in_any_way() -> None:
    with StopRequest() as stop:
        for number in (signal.SIGUSR1, signal.SIGTERM, signal.SIGUSR1, signal.SIGTERM, signal.SIGINT):
            os.kill(os.getpid(), number)
        assert stop.requested


def test_a_second_ctrl_c_does_not_wait() -> None:
    with StopRequest():
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(Untouched, match="SIGINT"):
            os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(Untouched, match="SIGTERM"):
        os.kill(os.getpid(), signal.SIGTERM)


def test_nohup_stays_in_force() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with StopRequest() as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        assert not stop.requested
