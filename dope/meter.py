"""How fast a training is, and how much of its time it waits for data."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple, TypeVar

Batch = TypeVar("Batch")


class Mark(NamedTuple):
    """The clock after a step, and pairs and seconds of waiting until then."""

    time: float
    pairs: int
    waited: float


class Meter:
    """Loss and speed of a call of `train`; speed over the last steps, without the first, which warms up."""

    def __init__(self, first_step: int, window: int = 50) -> None:
        self.first_step, self.loss = first_step, float("nan")
        self._began = time.perf_counter()
        self._waited = 0.0
        self._marks, self._window = [Mark(self._began, 0, 0.0)], window

    def waiting_for(self, batches: Iterable[Batch]) -> Iterator[Batch]:
        """The same batches; how long each lets one wait is counted."""
        iterator = iter(batches)
        while True:
            began = time.perf_counter()
            try:
                batch = next(iterator)
            except StopIteration:
                return
            self._waited += time.perf_counter() - began
            yield batch

    def add(self, pairs: int, loss: float) -> None:
        """Note a step."""
        self.loss = loss
        self._marks = [
            *self._marks[-self._window :], Mark(time.perf_counter(), self._marks[-1].pairs + pairs, self._waited)
        ]  # fmt: skip

    @property
    def seconds(self) -> float:
        """Since the beginning."""
        return time.perf_counter() - self._began

    @property
    def pairs_per_second(self) -> float:
        """Of all ranks together; 0 before the first step."""
        first, last = self._ends
        return (last.pairs - first.pairs) / max(1e-9, last.time - first.time)

    @property
    def data_wait(self) -> float:
        """Share of this rank's time, in [0, 1], in which it waits for its next batch."""
        first, last = self._ends
        return (last.waited - first.waited) / max(1e-9, last.time - first.time)

    @property
    def _ends(self) -> tuple[Mark, Mark]:
        marks = self._marks[1:] if len(self._marks) > 2 else self._marks
        return marks[0], marks[-1]
