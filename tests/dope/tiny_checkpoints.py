"""Small states of training, and where they are saved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from dope.checkpoints import (
    list_checkpoints,
)
from dope.config import CheckpointConfig, TrainConfig, load_config
from dope.distributed import Ranks
from dope.methods import method_of
from dope.order import Place
from dope.state import TrainState, new_state

SMALL = ["network.width=0.125", "network.pyramid=8", "network.projector=[8, 4]", "data.image_size=32"]
CONFIG = load_config("nano", None, SMALL)
ALONE = Ranks(0, 1, torch.device("cpu"))


def keeping(**policy: Any) -> TrainConfig:
    return replace(CONFIG, checkpoint=CheckpointConfig(**policy))


def at(step: int) -> TrainState:
    return replace(new_state(method_of(CONFIG), ALONE), step=step)


def steps_of(run: Path) -> list[int]:
    return [int(path.stem[-8:]) for path in list_checkpoints(run)]


def trained(config: TrainConfig = CONFIG, steps: int = 2) -> TrainState:
    state = new_state(method_of(config), ALONE)
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        images = torch.rand(2, 3, 32, 32, generator=generator)
        state.network.descriptors(images).square().sum().backward()
        state.optimiser.step()
        state.momentum.update(state.network)
        state.step += 1
    state.place = Place(1, 32)
    state.validation = {"pck": 0.5}
    return state
