"""Peak memory of this process and of all its children together, watched while a block runs (Linux)."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from types import TracebackType

INTERVAL = 0.05
"""Seconds between two looks: a child that lives less is not seen."""


class PeakMemory:
    """Watches the peaks that the kernel keeps of each process.

    Attributes:
        peaks_kib: the highest resident memory of each process so far, by process id.
    """

    def __init__(self) -> None:
        self.peaks_kib: dict[int, int] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> PeakMemory:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._over.set()
        self._thread.join()
        self._look()

    @property
    def largest_mib(self) -> float:
        """The peak of the largest process."""
        return round(max(self.peaks_kib.values()) / 1024, 1)

    @property
    def sum_mib(self) -> float:
        """The sum of all processes' peaks: no moment had more, since they need not fall together."""
        return round(sum(self.peaks_kib.values()) / 1024, 1)

    def _watch(self) -> None:
        while not self._over.wait(INTERVAL):
            self._look()

    def _look(self) -> None:
        waiting = [os.getpid()]
        while waiting:
            process = waiting.pop()
            try:
                for line in Path(f"/proc/{process}/status").read_text().splitlines():
                    if line.startswith("VmHWM:"):
                        self.peaks_kib[process] = max(self.peaks_kib.get(process, 0), int(line.split()[1]))
                for children in Path(f"/proc/{process}/task").glob("*/children"):
                    waiting += map(int, children.read_text().split())
            except OSError:  # it has ended
                continue
