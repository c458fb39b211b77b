"""All that changes while training: weights, momentum copy, optimiser, and the place in the run."""

from __future__ import annotations

import inspect
import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from dope.common.seeds import derive_seed
from dope.config import TrainConfig
from dope.distributed import Ranks
from dope.methods.base import Facts, Method
from dope.networks import synchronise_batchnorm
from dope.order import Place


@dataclass
class TrainState:
    """What a checkpoint holds.

    Attributes:
        momentum: what goes with the network without gradient (`Method.new_companion`).
        step: optimiser steps done.
        place: place in the order of samples.
        validation: newest result of `Method.validate`, and that of the untrained network.
        damaged: keys of the damaged samples that were met.
        facts: what the network's shape takes from its data.
    """

    network: nn.Module
    momentum: Any
    optimiser: torch.optim.Optimizer
    step: int = 0
    place: Place = field(default_factory=Place)
    validation: dict[str, Any] | None = None
    untrained: dict[str, Any] | None = None
    damaged: set[str] = field(default_factory=set)
    facts: Facts = field(default_factory=dict)


def new_state(method: Method, ranks: Ranks, facts: Facts | None = None) -> TrainState:
    """An untrained network with its companion and optimiser, the same on every rank."""
    config = method.config
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(config.seed, "weights"))
        network = method.new_network(facts or {})
    if config.distributed.sync_batchnorm and ranks.world > 1:
        network = synchronise_batchnorm(network, ranks.device)
    layout = torch.channels_last if config.channels_last else torch.contiguous_format
    network = network.to(device=ranks.device, memory_format=layout).train()  # type: ignore[call-overload]
    companion = method.new_companion(network).to(ranks.device)
    options = config.optimiser
    groups = method.parameter_groups(network)
    optimiser: torch.optim.Optimizer
    if options.name == "adamw":
        optimiser = torch.optim.AdamW(
            groups, options.lr, betas=options.betas, weight_decay=options.weight_decay, fused=True
        )
    else:
        optimiser = torch.optim.SGD(
            groups,
            options.lr,
            momentum=options.momentum,
            weight_decay=options.weight_decay,
            nesterov=options.nesterov,
            fused=True,
        )
    optimiser.register_load_state_dict_post_hook(_match_layout)
    return TrainState(network, companion, optimiser, facts=facts or {})


def _match_layout(optimiser: torch.optim.Optimizer) -> None:
    """Lay out loaded moments as their parameters are: the fused step walks over the memory of both at once."""
    for parameter, values in optimiser.state.items():
        for name, value in values.items():
            if value is None:  # of SGD without momentum
                continue
            if value.shape == parameter.shape and value.stride() != parameter.stride():
                values[name] = torch.empty_like(parameter).copy_(value)


def wrap(online: nn.Module, ranks: Ranks) -> nn.Module:
    """What is called in a step, its gradients averaged over ranks where there are several."""
    if ranks.world == 1:
        return online
    known = inspect.signature(DistributedDataParallel).parameters
    broadcast = "forward_sync_buffers" if "forward_sync_buffers" in known else "broadcast_buffers"  # as it was called
    options: dict[str, Any] = {broadcast: False}
    return DistributedDataParallel(
        online,
        device_ids=[ranks.device] if ranks.device.type == "cuda" else None,
        gradient_as_bucket_view=True,
        **options,  # running statistics take no part in training and are the first rank's where they count
    )


def total_steps(config: TrainConfig, steps_per_epoch: int) -> int:
    """Steps of a whole run: all epochs, or `schedule.max_steps` where that is less."""
    steps = config.schedule.epochs * steps_per_epoch
    return min(steps, config.schedule.max_steps) if config.schedule.max_steps else steps


def highest_rate(config: TrainConfig) -> float:
    """The highest learning rate of a run, for its batch size."""
    optimiser = config.optimiser
    return optimiser.lr * (config.data.batch_size / optimiser.lr_batch if optimiser.lr_batch else 1)


def learning_rate(config: TrainConfig, step: int, steps_per_epoch: int) -> float:
    """The learning rate of step `step` (from 0): linear warm-up, then cosine to 0, constant, or falling in steps."""
    schedule, peak = config.schedule, highest_rate(config)
    if step < schedule.warmup_steps:
        return peak * (step + 1) / (schedule.warmup_steps + 1)
    if schedule.shape == "constant":
        return peak
    total = total_steps(config, steps_per_epoch)
    if schedule.per == "epoch":
        share = step // steps_per_epoch * steps_per_epoch / total
    else:
        share = (step - schedule.warmup_steps) / max(1, total - schedule.warmup_steps)
    if schedule.shape == "steps":
        return peak * schedule.factor ** sum(share >= milestone for milestone in schedule.milestones)
    return peak * 0.5 * (1 + math.cos(math.pi * share))


def set_learning_rate(optimiser: torch.optim.Optimizer, lr: float, peak: float) -> None:
    """Give each group of parameters the step's learning rate, as `Method.parameter_groups` wants it."""
    for group in optimiser.param_groups:
        group["lr"] = (peak if group.get("lr_constant") else lr) * group.get("lr_scale", 1.0)
