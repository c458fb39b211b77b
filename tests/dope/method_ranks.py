"""What each rank of test_methods_ranks does, by torchrun: fixed batches in, losses, gradients and queue out."""

from __future__ import annotations

import sys
from dataclasses import replace
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

SETTINGS = [
    "network.width=0.125", "data.image_size=32", "data.batch_size=8", "data.pairs_per_object=1", "device=cpu",
    "moco.queue=20", "moco.head=[16, 8]", "supmoco.queue=20", "supmoco.head=8", "simsiam.projector=16",
    "simsiam.predictor=8",
]  # fmt: skip
METHODS = ("vispe", "vispe_moco", "vispe_simsiam", "supmoco")
VARIANTS = {
    **{method: [] for method in METHODS},
    **{f"{method} synchronised": ["distributed.sync_batchnorm=true"] for method in METHODS},
}


def config_of(variant: str) -> TrainConfig:
    return load_config("nano", None, [*SETTINGS, *VARIANTS[variant]], method=variant.split()[0])


def outcome(shards: Path, variant: str, ranks: Ranks) -> dict[str, Any]:
    """Two steps' losses, the gradients of the second and what the queue holds after it.

    Where BatchNorm is synchronised it takes the batch's statistics; it is frozen otherwise. All computes in float64:
    in float32, merely another order of the images changes gradients by over 1e-5.
    """
    config = config_of(variant)
    method = method_of(config)
    dataset = method.dataset(shards, "train")
    order = method.order(dataset)
    state = new_state(method, ranks)
    state.network.double(), state.momentum.double()
    training = config.distributed.sync_batchnorm
    online = wrap(method.online(state.network), ranks).train(training)
    state.momentum.train(training)
    reports, share = [], Share(ranks.rank, ranks.world)
    for step, rows in enumerate(order.batches(Place(), 2, rank=ranks.rank, world=ranks.world)):
        batch = doubled(method.prepare(dataset.batch(rows), step, share))
        losses = method.losses(online, state.momentum, batch, ranks, step=step, stop=ranks.rank == 1)
        state.optimiser.zero_grad(set_to_none=True)
        losses.backward()
        reports.append(losses.report)
        if step == 1:
            break
        method.after_step(state.network, state.momentum)
    method.after_step(state.network, state.momentum)
    return {
        "reports": reports,
        "stop": losses.stop,
        "gradients": {name: p.grad for name, p in state.network.named_parameters()},
        "companion": method.companion_state(state.momentum),
        "statistics": [b.clone() for norm in batchnorms(state.network) for b in norm.buffers()],
    }


def doubled(batch: Any) -> Any:
    """Its images in float64."""
    if hasattr(batch, "keys") and hasattr(batch, "queries"):
        return replace(batch, queries=doubled(batch.queries), keys=doubled(batch.keys))
    names = [name for name in ("images", "images1", "images2") if hasattr(batch, name)]
    return replace(batch, **{name: getattr(batch, name).double() for name in names})


def main(shards: Path, views: Path, out: Path) -> None:
    """Write out/<variant>-<rank>.pt."""
    torch.set_num_threads(1)
    with ranks_of("cpu") as ranks:
        for variant in VARIANTS:
            result = outcome(views if variant.startswith("supmoco") else shards, variant, ranks)
            torch.save(result, out / f"{variant}-{ranks.rank}.pt")


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:]))
