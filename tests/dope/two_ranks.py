"""What each rank of test_distributed does: fixed batches in, losses, gradients and keys out. Run by torchrun."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from dope.augmentation import no_augmentation
from dope.config import TrainConfig, load_config
from dope.distributed import Ranks, ranks_of
from dope.state import new_state, wrap
from dope.step import SampledBatch, choose_cells, compute_losses, momentum_keys
from dope.streaming import PairDataset, collate

VARIANTS = {
    "plain": ["distributed.shuffle_batchnorm=false"],
    "shuffled": [],
    "local": ["distributed.local_negatives=true"],
    "second_view": ["loss.negatives=second_view"],
    "same_objects": [],
}
SETTINGS = [
    "network.width=0.125", "network.pyramid=16", "network.projector=[16, 8]", "data.image_size=32", "data.points=8",
    "device=cpu",
]  # fmt: skip


def config_of(variant: str) -> TrainConfig:
    return load_config("nano", None, [*SETTINGS, *VARIANTS[variant]])


def global_batch(shards: Path, variant: str) -> SampledBatch:
    """Four pairs; the second rank's have fewer points, and in one variant two are of one object."""
    dataset = PairDataset(shards, "train", image_size=32)
    batch = no_augmentation(collate([dataset[row] for row in range(4)]))
    batch.valid[2, 3:] = False
    batch.valid[3] = False
    if variant == "same_objects":
        batch = replace(batch, objects=torch.tensor([0, 1, 0, 1]))
    return choose_cells(batch, 8, torch.Generator().manual_seed(0))


def part(batch: SampledBatch, rank: int, world: int) -> SampledBatch:
    """A rank's contiguous share."""
    size = len(batch.ok) // world
    rows = slice(rank * size, (rank + 1) * size)
    views = batch.views
    names = ("images1", "images2", "masks1", "masks2", "points", "valid", "objects")
    views = replace(views, keys=views.keys[rows], **{name: getattr(views, name)[rows] for name in names})
    return SampledBatch(views, batch.cells1[rows], batch.cells2[rows], batch.ok[rows])


def outcome(batch: SampledBatch, config: TrainConfig, ranks: Ranks) -> dict[str, Any]:
    """Loss and gradients with frozen BatchNorm, and the keys of a momentum encoder in training mode."""
    state = new_state(config, ranks)
    online = wrap(state.network, ranks)
    online.eval()
    state.momentum.eval()
    losses = compute_losses(online, state.momentum, batch, config, ranks, step=5, stop=ranks.rank == 1)
    losses.backward.backward()
    state.momentum.train()
    return {
        "report": losses.report,
        "stop": losses.stop,
        "gradients": {name: p.grad for name, p in state.network.named_parameters()},
        "keys": momentum_keys(state.momentum, batch, ranks, shuffle_seed=3),
    }


def main(shards: Path, out: Path) -> None:
    """Write out/<variant>-<rank>.pt."""
    torch.set_num_threads(1)
    with ranks_of("cpu") as ranks:
        for variant in VARIANTS:
            mine = part(global_batch(shards, variant), ranks.rank, ranks.world)
            torch.save(outcome(mine, config_of(variant), ranks), out / f"{variant}-{ranks.rank}.pt")
        assert ranks.collect(("rank", ranks.rank)) == [("rank", 0), ("rank", 1)]


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
