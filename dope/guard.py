"""Stops a run whose loss or gradient is not finite before it reaches the weights, and writes down what led to it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from torch import nn

from dope import checkpoints
from dope.batch import PairBatch
from dope.common import files
from dope.common.errors import DopeError

if TYPE_CHECKING:
    from dope.run import Run
    from dope.run_logging import RunLog, SilentLog

NAMES = {"loss": "loss", "grad_norm": "norm of the gradient"}
"""What is watched of a step's report, and what it is called in an error."""
SHOWN = 16  # keys in the error itself; the file has all


def gradient_norm(parameters: Iterable[nn.Parameter]) -> float:
    """Euclidean norm of all gradients together; they stay what they are."""
    # with an infinite bound nothing is clipped: the public way to PyTorch's fused norms in all its versions
    return float(nn.utils.clip_grad_norm_(parameters, math.inf))


def require_finite(run: Run, report: Mapping[str, float], batch: PairBatch, log: RunLog | SilentLog) -> None:
    """Check `loss` and `grad_norm` of a step's report before the optimiser uses the gradients.

    Both are the same on all ranks, so all stop together. RUN/not_finite-<step>.json gets the values (as text where JSON
    has no such number) and the samples of all ranks.

    Raises:
        DopeError: one is NaN or infinite; the weights are still those before the step.
    """
    name = next((name for name in NAMES if not math.isfinite(report[name])), None)
    if name is None:
        return
    step, epoch, index = run.state.step, run.state.place.epoch, run.dataset.index
    sequences = dict(zip(index.objects.tolist(), index.sequences.tolist(), strict=True))
    mine = [
        {"rank": run.ranks.rank, "key": key, "sequence": sequences[number]}
        for place, (key, number) in enumerate(zip(batch.keys, batch.objects.tolist(), strict=True))
        if place not in batch.damaged  # what fills its place is another sample again, or none at all
    ]
    samples = [sample for part in run.ranks.collect(mine) for sample in part]
    keys, newest = [sample["key"] for sample in samples], checkpoints.latest_checkpoint(run.out)
    log.event("not_finite", step, epoch, {**report, "keys": keys})
    path = run.out / f"not_finite-{step}.json"
    if run.ranks.is_first:
        values = {key: value if math.isfinite(value) else str(value) for key, value in report.items()}
        facts = {"step": step, "epoch": epoch, "not_finite": name, "values": values}
        files.write_json(path, {**facts, "newest_checkpoint": newest.name if newest else None, "samples": samples})
    some = ", ".join(keys[:SHOWN]) + (f" and {len(keys) - SHOWN} more" if len(keys) > SHOWN else "")
    reported = ", ".join(f"{key} {value:g}" for key, value in report.items())
    raise DopeError(
        f"the {NAMES[name]} is {report[name]} at step {step} ({reported}); the batch held {some}; all in {path.name}",
        where=run.out,
        # going on from the newest checkpoint would do these very steps again, and a run keeps its learning rate
        remedy="Look at these samples; train anew into another --out with a lower --set optimiser.lr or a higher "
        "--set schedule.warmup_steps" + (f"; {newest.name} holds the weights of before" if newest else ""),
    )
