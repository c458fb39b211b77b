"""`dope train --profile N`: a few steps under PyTorch's profiler, as a trace and a small table."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import torch
from torch.profiler import ProfilerActivity, profile, schedule

from dope.common import files
from dope.distributed import Ranks

WARM_UP = 2  # steps left out: the first ones allocate, choose algorithms and compile
ROWS = 12


class StepProfiler:
    """Profiles `steps` steps of a training after two others; use as a context manager, call `step` after each one.

    RUN/profile/trace.json opens in https://ui.perfetto.dev or chrome://tracing; several ranks write
    trace-rank0.json, trace-rank1.json and so on. A run that ends earlier writes the steps it had; one that ends within
    the first two says that it writes none, and an older trace stays.

    Args:
        run: the run's folder.
        steps: how many; 0 does nothing at all.
        say: takes the table, on the first rank.
    """

    def __init__(self, run: Path, steps: int, ranks: Ranks, say: Callable[[str], None]) -> None:
        name = "trace.json" if ranks.world == 1 else f"trace-rank{ranks.rank}.json"
        self._path, self._ranks, self._say = run / "profile" / name, ranks, say
        self._left = WARM_UP + steps if steps else 0
        self._written = False
        self._profile: profile | None = None
        if steps:
            on_gpu = [ProfilerActivity.CUDA] if ranks.device.type == "cuda" else []
            self._profile = profile(
                activities=[ProfilerActivity.CPU, *on_gpu],
                schedule=schedule(wait=0, warmup=WARM_UP, active=steps, repeat=1),
                on_trace_ready=self._write,
            )

    def __enter__(self) -> StepProfiler:
        if self._profile:
            self._profile.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._profile:
            self._profile.stop()
            self._profile = None
            if not self._written and self._ranks.is_first:
                self._say(f"the run ended within the {WARM_UP} steps that --profile leaves out: no trace was written")

    def step(self) -> None:
        """Note the end of a training step."""
        if self._profile:
            self._profile.step()
            self._left -= 1
            if self._left == 0:
                self.__exit__(None, None, None)

    def _write(self, finished: profile) -> None:
        with files.atomic_path(self._path) as partial:
            finished.export_chrome_trace(str(partial))
        self._written = True
        if self._ranks.is_first:
            self._say(f"{slowest_operators(finished)}\nprofile: {self._path}")


def slowest_operators(finished: profile) -> str:
    """The operators that took the most time of their own on the device, one a line."""
    on_gpu = torch.profiler.ProfilerActivity.CUDA in finished.activities
    spent = {
        event.key: ((event.self_device_time_total if on_gpu else event.self_cpu_time_total) / 1000, event.count)
        for event in finished.key_averages()
        if not event.key.startswith("ProfilerStep")
    }
    total = sum(ms for ms, _ in spent.values()) or 1.0
    ranked = sorted(spent.items(), key=lambda item: -item[1][0])[:ROWS]
    lines = [f"{ms:10.1f} ms {ms / total:6.1%} {calls:7d} x  {name[:70]}" for name, (ms, calls) in ranked]
    return "\n".join([f"slowest operators, {'GPU' if on_gpu else 'CPU'} time of their own:", *lines])
