"""What each rank of test_methods_feat does: a fixed step of the methods that learn from classes. Run by torchrun."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch

from dope.augmentation import Share
from dope.config import TrainConfig, load_config
from dope.distributed import Ranks, ranks_of
from dope.methods import method_of
from dope.networks.batchnorm import batchnorms
from dope.order import Place
from dope.state import new_state, wrap

METHODS = ("simpleshot", "feat")
SETTINGS = ["network.width=0.125", "data.image_size=32", "data.workers=0", "device=cpu", "validation.pairs=24"]
OF_METHOD = {
    "simpleshot": ["data.batch_size=8"],
    "feat": ["data.batch_size=2", "feat.ways=3", "feat.queries=2", "feat.episodes=4", "feat.balance=0.5"],
}


def config_of(method: str) -> TrainConfig:
    return load_config("nano", None, [*SETTINGS, *OF_METHOD[method]], method=method)


def outcome(shards: Path, name: str, ranks: Ranks) -> dict[str, Any]:
    """Report, gradients and held-out score of the run's first step, with dropout and with BatchNorm frozen."""
    method = method_of(config_of(name))
    dataset = method.dataset(shards, "train")
    state = new_state(method, ranks, method.facts(dataset))
    rows = next(iter(method.order(dataset).batches(Place(), 1, rank=ranks.rank, world=ranks.world)))
    batch = method.prepare(dataset.batch(rows), 3, Share(ranks.rank, ranks.world))
    if name == "simpleshot":  # ranks then learn from different numbers of views
        batch.labels[0 if ranks.world == 1 else slice(0, 1 - ranks.rank)] = -1
    online = wrap(method.online(state.network), ranks)
    for norm in batchnorms(state.network):
        norm.eval()
    losses = method.losses(online, state.momentum, batch, ranks, step=3, stop=ranks.rank == ranks.world - 1)
    losses.backward()
    held_out = method.dataset(shards, "val")
    mine = method.held_out_rows(held_out, 24)[ranks.rank :: ranks.world]
    return {
        "report": losses.report,
        "stop": losses.stop,
        "gradients": {key: p.grad for key, p in state.network.named_parameters()},
        "validation": method.validate(state.network, [held_out.batch(mine)], ranks),
    }


def main(shards: Path, out: Path) -> None:
    """Write out/<method>-<rank>.pt."""
    torch.set_num_threads(1)
    with ranks_of("cpu") as ranks:
        for name in METHODS:
            torch.save(outcome(shards, name, ranks), out / f"{name}-{ranks.rank}.pt")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
