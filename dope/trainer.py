"""Training: `train` streams shards into a DOPE network, on one process or on each of those that torchrun started."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import yaml

from dope import checkpoints
from dope.batch import PairBatch
from dope.common import files, settings
from dope.common.errors import DopeError, UsageError
from dope.config import TrainConfig, check
from dope.distributed import Ranks, ranks_of
from dope.heap import keep_heap
from dope.order import SampleOrder
from dope.run_logging import Meter, RunLog, SilentLog
from dope.state import TrainState, learning_rate, new_state, wrap
from dope.step import compute_losses, sample_batch
from dope.stop_signals import StopRequest
from dope.streaming import PairDataset, PairLoader
from dope.validation import pck


def train(
    shards: Path, out: Path, config: TrainConfig, *, resume: str | Path = "auto", stop_after: int | None = None
) -> dict[str, Any]:
    """Train on SHARDS and leave checkpoints, settings and metrics in the folder `out`.

    Args:
        shards: folder of shards; split `train` is trained on, split `val` validates.
        out: the run's folder: config.yaml, checkpoints/, metrics.jsonl, tensorboard/.
        config: all settings (see `dope.config.load_config`).
        resume: `auto` goes on where `out` stopped, or begins; `never` insists on a new folder; a path names a
            checkpoint or another run to go on from.
        stop_after: stop with a checkpoint after so many steps of this call; the schedule stays that of the whole run.

    Returns:
        `status` (finished, or stopped by a signal or `stop_after`), `step`, `epoch`, `loss`, `pck`, `pck_untrained`,
        `mask_iou`, `checkpoint`, `seconds`, `pairs_per_second`.

    Raises:
        BadInput: shards or checkpoint missing or damaged. UsageError: settings that do not fit them.
        DopeError: the loss is not finite; the message names the step and the samples.
    """
    check(config)
    keep_heap()
    with ranks_of(config.device) as ranks, StopRequest() as stop:
        dataset = PairDataset(shards, "train", image_size=config.data.image_size, max_points=config.data.max_points)
        order = SampleOrder(
            dataset.index.objects,
            config.data.batch_size,
            pairs_per_object=config.data.pairs_per_object,
            seed=config.seed,
        )
        held_out = read_held_out(shards, config, ranks)
        state = new_state(config, ranks)
        found = checkpoint_to_resume(out, resume)
        if found is not None:
            checkpoints.resume(found, state, config, dataset.index.fingerprint)
        rows = order.batches(state.place, config.schedule.epochs, rank=ranks.rank, world=ranks.world)
        online = wrap(state.network, ranks)
        begun, first_step = time.perf_counter(), state.step
        total = config.schedule.epochs * order.steps_per_epoch
        last_step = total if stop_after is None else min(total, state.step + stop_after)
        if ranks.is_first:
            write_config(out, config)
        log: RunLog | SilentLog = RunLog(out, start=state.step, total=total) if ranks.is_first else SilentLog()
        with log:
            start = {"world": ranks.world, "device": str(ranks.device), "config_hash": settings.config_hash(config)}
            log.event("start", state.step, state.place.epoch, {**start, "resumed_from": found and str(found)})
            if state.step == 0:
                state.untrained = state.validation = validate(state, held_out, config, ranks, log)
            meter, stopping = Meter(), state.step >= last_step
            loader = PairLoader(dataset, rows, workers=config.data.workers, pin_memory=ranks.device.type == "cuda")
            for batch in loader if not stopping else ():
                lr = learning_rate(config, state.step, order.steps_per_epoch)
                for group in state.optimiser.param_groups:
                    group["lr"] = lr
                sampled = sample_batch(batch.to(ranks.device), config, state.step, ranks.rank)
                losses = compute_losses(
                    online, state.momentum, sampled, config, ranks, step=state.step, stop=stop.requested
                )
                report = losses.report
                if not math.isfinite(report["loss"]):
                    raise not_finite(report, batch, state, out, ranks, log)
                state.optimiser.zero_grad(set_to_none=True)
                losses.backward.backward()
                state.optimiser.step()
                state.momentum.update(state.network)

                state.step, state.place = state.step + 1, order.after(state.place)
                stopping = losses.stop or state.step >= last_step
                meter.add(config.data.batch_size, report["loss"])
                log.progress(state.step, report["loss"], meter.pairs_per_second)
                if state.step % config.log_every == 0 or stopping:
                    values = {**report, "lr": lr, "pairs_per_second": round(meter.pairs_per_second, 2)}
                    log.event("step", state.step, state.place.epoch, values)
                epoch_done = state.place.consumed == 0
                if state.step == total or (epoch_done and _due(state.place.epoch, config.validation.every)):
                    state.validation = validate(state, held_out, config, ranks, log)
                if stopping or (epoch_done and _due(state.place.epoch, config.checkpoint.every)):
                    save(out, state, config, dataset.index.fingerprint, ranks, log)
                if stopping:
                    break
            newest = checkpoints.latest_checkpoint(out)
            result = {
                "status": "finished" if state.step >= total else "stopped",
                "step": state.step,
                "epoch": state.place.epoch,
                "loss": meter.last_loss,
                "pck": (state.validation or {}).get("pck"),
                "pck_untrained": (state.untrained or {}).get("pck"),
                "mask_iou": (state.validation or {}).get("mask_iou"),
                "checkpoint": newest and str(newest),
                "seconds": round(time.perf_counter() - begun, 1),
                "steps_of_this_call": state.step - first_step,
                "pairs_per_second": round(meter.pairs_per_second, 2),
            }
            log.event("end", state.step, state.place.epoch, result)
        ranks.wait()
        return result


def read_held_out(shards: Path, config: TrainConfig, ranks: Ranks) -> list[PairBatch]:
    """This rank's share of the validation pairs, decoded once and kept; empty without validation or split `val`."""
    if config.validation.every == 0:
        return []
    dataset = PairDataset(shards, "val", image_size=config.data.image_size, max_points=config.data.points)
    mine = list(range(min(config.validation.pairs, len(dataset))))[ranks.rank :: ranks.world]
    size = config.validation.batch_size
    return list(PairLoader(dataset, [mine[i : i + size] for i in range(0, len(mine), size)]))


def validate(
    state: TrainState, held_out: list[PairBatch], config: TrainConfig, ranks: Ranks, log: RunLog | SilentLog
) -> dict[str, float] | None:
    """PCK and mask IoU on all ranks' held-out pairs, logged; None where there are none."""
    if config.validation.every == 0:
        return None
    ranks.copy_from_first(state.network)  # the ranks' BatchNorm statistics differ by their last batch
    result = pck(state.network, held_out, points=config.data.points, ranks=ranks)
    if result["pairs"] == 0:
        if state.step == 0:
            log.say("no held-out pairs (split val): nothing is validated")
        return None
    log.event("validation", state.step, state.place.epoch, result)
    return result


def save(
    out: Path, state: TrainState, config: TrainConfig, dataset: str, ranks: Ranks, log: RunLog | SilentLog
) -> None:
    """Write a checkpoint on the first rank."""
    if ranks.is_first:
        path = checkpoints.save_checkpoint(out, state, config, dataset, config.checkpoint.keep)
        log.event("checkpoint", state.step, state.place.epoch, {"file": path.name})


def checkpoint_to_resume(out: Path, resume: str | Path) -> Path | None:
    """The checkpoint to go on from, or None to begin. Raises as `train` does."""
    newest = checkpoints.latest_checkpoint(out)
    if resume == "auto":
        return newest
    if resume == "never":
        if newest is not None:
            raise UsageError(
                f"already holds a run ({newest.name})",
                where=out,
                remedy="Give another --out, delete this folder, or go on with --resume auto",
            )
        return None
    return checkpoints.find_checkpoint(Path(resume))


def write_config(out: Path, config: TrainConfig) -> None:
    """RUN/config.yaml, which `--config` reads again, with its hash in the first line."""
    values = settings.to_dict(config)
    text = yaml.safe_dump(_plain(values), sort_keys=False, allow_unicode=True)
    files.write_bytes(out / "config.yaml", f"# hash {settings.config_hash(config)}\n{text}".encode())


def not_finite(
    report: dict[str, float], batch: PairBatch, state: TrainState, out: Path, ranks: Ranks, log: RunLog | SilentLog
) -> DopeError:
    """The error of a loss that is NaN or infinite; the weights are still those before it."""
    keys = [key for part in ranks.collect(list(batch.keys)) for key in part]
    log.event(
        "not_finite", state.step, state.place.epoch, {"losses": {k: str(v) for k, v in report.items()}, "keys": keys}
    )
    some = ", ".join(keys[:16]) + (f" and {len(keys) - 16} more (in metrics.jsonl)" if len(keys) > 16 else "")
    newest = checkpoints.latest_checkpoint(out)
    return DopeError(
        f"the loss is {report['loss']} at step {state.step} (contrastive {report['contrastive']}, mask "
        f"{report['mask']}); the batch held {some}",
        where=out,
        remedy="Lower --set optimiser.lr or raise --set schedule.warmup_steps, and look at these samples"
        + (f"; {newest.name} was written before" if newest else ""),
    )


def _due(epoch: int, every: int) -> bool:
    return every > 0 and epoch % every == 0


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, (list, tuple)) else value
