"""Training in which one rank's gradient or images turn to NaN in step 2. Run by torchrun, see test_distributed."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch
from tiny_runs import tiny

from dope import trainer
from dope.augmentation import Share
from dope.common.errors import DopeError
from dope.distributed import Ranks
from dope.methods import dope as dope_method


def main(what: str, shards: Path, out: Path) -> None:
    """Train, and write OUT/said-<rank>.txt: how it ended, and a number that tells the weights."""
    torch.set_num_threads(1)
    seen: dict[str, Any] = {}
    real_sample, real_wrap = dope_method.sample_batch, trainer.wrap

    def sample(batch: Any, config: Any, step: int, share: Share) -> Any:
        sampled = real_sample(batch, config, step, share)
        seen["step"], seen["rank"] = step, share.rank
        if what == "loss" and step == 2 and share.rank == 1:
            sampled.views.images1[0, 0, 0, 0] = float("nan")
        seen["weights"] = sum(float(p.detach().double().sum()) for p in seen["network"].parameters())
        return sampled

    def wrap(network: Any, ranks: Ranks) -> torch.nn.Module:
        seen["network"] = network
        spoil = what == "gradient" and ranks.rank == 1
        next(network.parameters()).register_hook(lambda g: g * float("nan") if spoil and seen["step"] == 2 else g)
        return real_wrap(network, ranks)

    dope_method.sample_batch, trainer.wrap = sample, wrap
    try:
        trainer.train(shards, out, tiny("validation.every=0"))
        said = "finished"
    except DopeError as error:
        said = str(error)
    after = sum(float(p.detach().double().sum()) for p in seen["network"].parameters())
    (out / f"said-{seen['rank']}.txt").write_text(f"{said}\n{after == seen['weights']} {after}")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
