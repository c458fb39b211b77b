"""Runs of the methods that describe whole views: of a moment, and of some seconds in which they learn."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch
from tiny_runs import TINY, losses_of

from dope.checkpoints import read_checkpoint
from dope.config import TrainConfig, load_config
from dope.methods import method_class
from dope.methods.base import OF_SOME_METHODS
from dope.trainer import train

SMALL = [
    "moco.queue=16", "moco.head=[16, 8]", "supmoco.queue=16", "supmoco.head=8", "simsiam.projector=16",
    "simsiam.predictor=8",
]  # fmt: skip
LEARNING = [
    "network.width=0.125", "data.image_size=32", "data.workers=0", "data.batch_size=32", "validation.every=100000",
    "checkpoint.every=0", "device=cpu", "schedule.max_steps=150", "augmentation.colour_p=0", "augmentation.jitter_p=0",
    "augmentation.grey_p=0", "augmentation.blur_p=0", "augmentation.noise_p=0",
    "momentum=0.9", "moco.queue=64", "supmoco.queue=64",
]  # fmt: skip
"""The drawn objects differ in their colours: changes of these would ask for far longer training."""


def tiny_method(method: str, *overrides: str) -> TrainConfig:
    return load_config("nano", None, [*TINY, *_read_by(method, SMALL), *overrides], method=method)


def _read_by(method: str, overrides: list[str]) -> list[str]:
    """Those that are not of other methods."""
    others = set(OF_SOME_METHODS) - set(method_class(method).sections)
    return [setting for setting in overrides if setting.split(".")[0] not in others]


def same_after_a_stop(shards: Path, folder: Path, config: TrainConfig) -> None:
    """A run, and one that is stopped in the middle and goes on: weights, companion and losses are bitwise the same."""
    whole = train(shards, folder / "whole", config)
    first = train(shards, folder / "parts", config, stop_after=3)
    assert first["status"] == "stopped"
    second = train(shards, folder / "parts", replace(config, data=replace(config.data, workers=1)))
    assert second["status"] == "finished" and whole["loss"] == second["loss"]
    assert losses_of(folder / "whole") == losses_of(folder / "parts")
    ours, theirs = (read_checkpoint(folder / name) for name in ("whole", "parts"))
    for part in ("network", "momentum"):
        assert ours[part].keys() == theirs[part].keys()
        assert all(torch.equal(ours[part][name], theirs[part][name]) for name in ours[part])


def better_than_chance(shards: Path, out: Path, method: str, *overrides: str) -> None:
    """The lower end of the 95% confidence interval (Wilson) is above chance and above the untrained network's score."""
    result = train(shards, out, load_config("nano", None, [*_read_by(method, LEARNING), *overrides], method=method))
    last = read_checkpoint(out)["validation"]
    assert result["score"] == last[result["score_name"]]
    n, share, z = last["pairs"], result["score"], 1.96
    middle = share + z * z / (2 * n)
    low = (middle - z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))) / (1 + z * z / n)
    assert low > max(last["chance"], result["score_untrained"]), (result, last)
