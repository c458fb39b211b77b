"""Training runs that take a moment: six steps of a tiny network on `tiny_shards`."""

from __future__ import annotations

from pathlib import Path

from dope.config import TrainConfig, load_config
from dope.run_logging import read_metrics

TINY = [
    "network.width=0.125", "network.pyramid=16", "network.projector=[16, 8]", "data.image_size=32", "data.points=8",
    "data.batch_size=4", "data.pairs_per_object=1", "data.workers=0", "schedule.epochs=3", "validation.every=1",
    "checkpoint.every=0", "log.every=1", "device=cpu",
]  # fmt: skip


def tiny(*overrides: str) -> TrainConfig:
    return load_config("nano", None, [*TINY, *overrides])


def losses_of(run: Path) -> list[float]:
    return [line["loss"] for line in read_metrics(run, "step")]
