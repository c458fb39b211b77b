"""What each rank of test_distributed does: fixed batches in, losses, gradients and keys out. Run by torchrun."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from dope.augmentation import no_augmentation
from dope.batch import TENSORS, PairBatch
from dope.config import TrainConfig, load_config
from dope.distributed import Ranks, ranks_of
from dope.methods import method_of
from dope.networks.batchnorm import batchnorms
from dope.state import new_state, wrap
from dope.step import SampledBatch, choose_cells, compute_losses, momentum_keys
from dope.streaming import PairDataset, collate

VARIANTS = {
    "plain": ["distributed.shuffle_batchnorm=false"],
    "shuffled": [],
    "local": ["distributed.local_negatives=true"],
    "second_view": ["loss.negatives=second_view"],
    "same_objects": [],
    "micro": ["data.micro_batch=1"],
    "synchronised": ["distributed.sync_batchnorm=true"],
}
SETTINGS = [
    "network.width=0.125", "network.pyramid=16", "network.projector=[16, 8]", "data.image_size=32", "data.points=8",
    "device=cpu",
]  # fmt: skip


def config_of(variant: str) -> TrainConfig:
    return load_config("nano", None, [*SETTINGS, *VARIANTS[variant]])


def global_batch(shards: Path, variant: str) -> SampledBatch:
    """Eight pairs with 51 points; in one variant two objects are there twice."""
    dataset = PairDataset(shards, "train", image_size=32)
    batch = no_augmentation(collate([dataset[row] for row in range(8)]))
    batch.valid[2, 3:] = False
    batch.valid[3] = False
    if variant == "same_objects":
        batch = replace(batch, objects=torch.tensor([0, 1, 2, 3, 0, 1, 4, 5]))
    return choose_cells(batch, 8, torch.linspace(0, 0.9, 8))


def part(batch: PairBatch, rank: int, world: int) -> PairBatch:
    """A rank's contiguous share."""
    size = len(batch) // world
    rows = slice(rank * size, (rank + 1) * size)
    return replace(batch, keys=batch.keys[rows], **{name: getattr(batch, name)[rows] for name in TENSORS})


def sampled_part(batch: SampledBatch, rank: int, world: int) -> SampledBatch:
    """A rank's contiguous share, points included."""
    tensors = (tensor.chunk(world)[rank] for tensor in (batch.cells1, batch.cells2, batch.ok))
    return SampledBatch(part(batch.views, rank, world), *tensors)


def outcome(batch: SampledBatch, config: TrainConfig, ranks: Ranks, *, training: bool = False) -> dict[str, Any]:
    """Loss, gradients and BatchNorm's statistics after a step, and the keys of a momentum encoder in training mode.

    Args:
        training: whether BatchNorm takes the batch's statistics in the step; it is frozen otherwise. The encoders
            then compute in float64: in float32, merely another order of the images changes gradients by over 1e-5.
    """
    state = new_state(method_of(config), ranks)
    if training:
        state.network.double(), state.momentum.double()
        views = replace(batch.views, images1=batch.views.images1.double(), images2=batch.views.images2.double())
        batch = replace(batch, views=views)
    online = wrap(method_of(config).online(state.network), ranks).train(training)
    state.momentum.train(training)
    losses = compute_losses(online, state.momentum, batch, config, ranks, step=5, stop=ranks.rank == 1)
    losses.backward()
    networks = (state.network, state.momentum.network)
    statistics = [buffer.clone() for network in networks for norm in batchnorms(network) for buffer in norm.buffers()]
    state.momentum.train()
    return {
        "report": losses.report,
        "stop": losses.stop,
        "gradients": {name: p.grad for name, p in state.network.named_parameters()},
        "statistics": statistics,
        "keys": momentum_keys(state.momentum, batch, ranks, shuffle_seed=3, parts=[slice(0, len(batch.ok))]),
    }


def main(shards: Path, out: Path) -> None:
    """Write out/<variant>-<rank>.pt."""
    torch.set_num_threads(1)
    with ranks_of("cpu") as ranks:
        for variant in VARIANTS:
            mine = sampled_part(global_batch(shards, variant), ranks.rank, ranks.world)
            result = outcome(mine, config_of(variant), ranks, training=variant == "synchronised")
            torch.save(result, out / f"{variant}-{ranks.rank}.pt")
        assert ranks.collect(("rank", ranks.rank)) == [("rank", r) for r in range(ranks.world)]


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
