"""Training: `train` streams shards into a network, by whatever method, on one process or each that torchrun started."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

from dope import damage, guard
from dope.augmentation import Share
from dope.common import files
from dope.config import TrainConfig, check
from dope.distributed import ranks_of
from dope.heap import keep_heap
from dope.memory import MemoryWatch
from dope.meter import Meter
from dope.profiling import StepProfiler
from dope.run import open_run
from dope.state import highest_rate, learning_rate, set_learning_rate, wrap
from dope.stop_signals import StopRequest
from dope.storage import Shards
from dope.streaming import PairLoader


def train(
    shards: Shards,
    out: Path,
    config: TrainConfig,
    *,
    resume: str | Path = "auto",
    stop_after: int | None = None,
    profile: int = 0,
) -> dict[str, Any]:
    """Train on SHARDS and leave checkpoints, settings and metrics in the folder `out`.

    Args:
        shards: folder of shards, or an fsspec URL of it; split `train` is trained on, split `val` validates.
        out: the run's folder: config.yaml, checkpoints/, metrics.jsonl, tensorboard/.
        config: all settings (see `dope.config.load_config`).
        resume: `auto` goes on where `out` stopped, or begins, and passes over damaged checkpoints; `never` insists on
            a new folder; a path names a checkpoint of `out`, or one or a run to begin a new `out` from, and when given
            again goes on like `auto`.
        stop_after: stop with a checkpoint after so many steps of this call; the schedule stays that of the whole run.
        profile: steps of this call that are profiled, see `dope.profiling`.

    Returns:
        `status` (finished, or stopped by a signal or `stop_after`), `step`, `steps_of_this_call`, `epoch`, `loss`,
        `score_name`, `score`, `score_untrained` (for DOPE also `pck`, `pck_untrained`, `mask_iou`), `damaged`
        (samples), `checkpoint`, `seconds`, `pairs_per_second`; None where there is none.

    Raises:
        BadInput: shards or checkpoint missing or damaged, or more samples than `data.max_bad_samples` are.
        UsageError: settings that do not fit them.
        DopeError: loss or gradient are not finite (the message names the step and the samples), the disk is full, or
            another process trains into `out`.
    """
    check(config)
    keep_heap()
    with (
        files.explaining_full_disk(out),
        ranks_of(config.device) as ranks,
        StopRequest() as stop,
        open_run(shards, out, config, ranks, resume) as run,
    ):
        state, method, last_step = run.state, run.method, run.total_steps
        if stop_after is not None:
            last_step = min(last_step, state.step + stop_after)
        rows = run.order.batches(state.place, config.schedule.epochs, rank=ranks.rank, world=ranks.world)
        pin, share = ranks.device.type == "cuda", Share(ranks.rank, ranks.world)
        loader = PairLoader(run.dataset, rows, workers=config.data.workers, pin_memory=pin, fill_damaged=True)
        online, meter = wrap(method.online(state.network), ranks), Meter(state.step)
        with run.begin() as log, StepProfiler(out, profile, ranks, log.say) as profiler:
            stopping = state.step >= last_step
            for batch in meter.waiting_for(loader) if not stopping else ():
                lr = learning_rate(config, state.step, run.order.steps_per_epoch)
                set_learning_rate(state.optimiser, lr, highest_rate(config))
                prepared = method.prepare(batch.to(ranks.device), state.step, share)
                news = stop.requested or bool(batch.damaged)
                with MemoryWatch(online, ranks.device) if state.step == meter.first_step else nullcontext() as memory:
                    losses = method.losses(online, state.momentum, prepared, ranks, step=state.step, stop=news)
                    asked_to_stop = losses.stop and damage.heed(run, stop.requested, batch, log)
                    state.optimiser.zero_grad(set_to_none=True)
                    losses.backward()
                report = {**losses.report, "grad_norm": guard.gradient_norm(state.network.parameters()), "lr": lr}
                guard.require_finite(run, report, batch, log)
                state.optimiser.step()
                method.after_step(state.network, state.momentum)

                state.step, state.place = state.step + 1, run.order.after(state.place)
                # other ranks would have to be asked first, which the next step does
                asked_to_stop |= ranks.world == 1 and stop.requested
                stopping = asked_to_stop or state.step >= last_step
                if memory is not None:
                    log.event("memory", state.step, state.place.epoch, memory.report())
                meter.add(config.data.batch_size, report["loss"])
                profiler.step()
                run.after_step(report, meter, log, stopping=stopping, hurry=asked_to_stop)
                if stopping:
                    break
            return run.end(meter, log)
