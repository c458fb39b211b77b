"""Training: `train` streams shards into a DOPE network, on one process or on each of those that torchrun started."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dope import checkpoints
from dope.augmentation import Share, no_augmentation
from dope.batch import PairBatch
from dope.common import files, settings
from dope.common.errors import DopeError, UsageError
from dope.config import TrainConfig, check
from dope.distributed import Ranks, ranks_of, restarts
from dope.heap import keep_heap
from dope.memory import MemoryWatch
from dope.networks import DopeNetwork
from dope.networks.untrained import settle_batchnorm
from dope.order import SampleOrder
from dope.queries import micro_batches
from dope.run_logging import Meter, RunLog, SilentLog
from dope.state import TrainState, learning_rate, new_state, total_steps, wrap
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
        `status` (finished, or stopped by a signal or `stop_after`), `step`, `steps_of_this_call`, `epoch`, `loss`,
        `pck`, `pck_untrained`, `mask_iou`, `checkpoint`, `seconds`, `pairs_per_second`; None where there is none.

    Raises:
        BadInput: shards or checkpoint missing or damaged. UsageError: settings that do not fit them.
        DopeError: the loss is not finite (the message names the step and the samples), or the disk is full.
    """
    check(config)
    keep_heap()
    with files.explaining_full_disk(out), ranks_of(config.device) as ranks, StopRequest() as stop:
        run = open_run(shards, out, config, ranks, resume)
        state, last_step = run.state, run.total_steps
        if stop_after is not None:
            last_step = min(last_step, state.step + stop_after)
        rows = run.order.batches(state.place, config.schedule.epochs, rank=ranks.rank, world=ranks.world)
        loader = PairLoader(run.dataset, rows, workers=config.data.workers, pin_memory=ranks.device.type == "cuda")
        online, meter = wrap(state.network, ranks, compiled=config.compile), Meter(state.step)
        share = Share(ranks.rank, ranks.world)
        with run.begin() as log:
            stopping = state.step >= last_step
            for batch in loader if not stopping else ():
                lr = learning_rate(config, state.step, run.order.steps_per_epoch)
                for group in state.optimiser.param_groups:
                    group["lr"] = lr
                sampled = sample_batch(batch.to(ranks.device), config, state.step, share)
                with MemoryWatch(online, ranks.device) if state.step == meter.first_step else nullcontext() as memory:
                    losses = compute_losses(
                        online, state.momentum, sampled, config, ranks, step=state.step, stop=stop.requested
                    )
                    if not math.isfinite(losses.report["loss"]):
                        raise run.not_finite(losses.report, batch, log)
                    state.optimiser.zero_grad(set_to_none=True)
                    losses.backward()
                state.optimiser.step()
                state.momentum.update(state.network)

                state.step, state.place = state.step + 1, run.order.after(state.place)
                stopping = losses.stop or state.step >= last_step
                if memory is not None:
                    log.event("memory", state.step, state.place.epoch, memory.report())
                meter.add(config.data.batch_size, losses.report["loss"])
                log.progress(state.step, meter.loss, meter.pairs_per_second)
                if stopping or state.step % config.log_every == 0:
                    speed = {"lr": lr, "pairs_per_second": round(meter.pairs_per_second, 2)}
                    log.event("step", state.step, state.place.epoch, {**losses.report, **speed})
                if state.step == run.total_steps or run.is_due(config.validation.every):
                    run.validate(log)
                if stopping or run.is_due(config.checkpoint.every):
                    run.save(log)
                if stopping:
                    break
            return run.end(meter, log)


@dataclass
class Run:
    """What a call of `train` works on."""

    out: Path
    config: TrainConfig
    ranks: Ranks
    dataset: PairDataset
    order: SampleOrder
    held_out: list[PairBatch]
    state: TrainState
    resumed_from: Path | None

    @property
    def total_steps(self) -> int:
        """Steps of the whole run."""
        return total_steps(self.config, self.order.steps_per_epoch)

    def is_due(self, every: int) -> bool:
        """True at the end of each `every`-th epoch; never for 0."""
        return every > 0 and self.state.place.consumed == 0 and self.state.place.epoch % every == 0

    def begin(self) -> RunLog | SilentLog:
        """Write the settings, open the log and validate the untrained network."""
        if not self.ranks.is_first:
            log: RunLog | SilentLog = SilentLog()
        else:
            write_config(self.out, self.config)
            log = RunLog(self.out, start=self.state.step, total=self.total_steps)
        facts = {
            "world": self.ranks.world,
            "device": str(self.ranks.device),
            "config_hash": settings.config_hash(self.config),
            "dataset": self.dataset.index.fingerprint,
            "resumed_from": None if self.resumed_from is None else str(self.resumed_from),
        }
        log.event("start", self.state.step, self.state.place.epoch, facts)
        if self.state.step == 0:
            self.validate(log)
            self.state.untrained = self.state.validation
        return log

    def validate(self, log: RunLog | SilentLog) -> None:
        """PCK and mask IoU on all ranks' held-out pairs, logged and kept for the checkpoint."""
        if self.config.validation.every == 0:
            return
        network = self.state.network
        if self.state.step == 0:  # random weights without the statistics of real images would be no baseline at all
            network = DopeNetwork(network.config)  # a plain copy: the ranks' numbers of batches may differ
            network.load_state_dict(self.state.network.state_dict())
            network.to(self.ranks.device)
            images = (no_augmentation(batch.to(self.ranks.device)).images1 for batch in self.held_out)
            settle_batchnorm(network, images)
        self.ranks.copy_from_first(network)  # the ranks' BatchNorm statistics differ by their last batch
        result = pck(network, self.held_out, points=self.config.data.points, ranks=self.ranks)
        if result["pairs"] > 0:
            self.state.validation = result
            log.event("validation", self.state.step, self.state.place.epoch, result)
        elif self.state.step == 0:
            log.say("no held-out pairs (split val): nothing is validated")

    def save(self, log: RunLog | SilentLog) -> None:
        """Write a checkpoint on the first rank."""
        if self.ranks.is_first:
            fingerprint, keep = self.dataset.index.fingerprint, self.config.checkpoint.keep
            path = checkpoints.save_checkpoint(self.out, self.state, self.config, fingerprint, keep)
            log.event("checkpoint", self.state.step, self.state.place.epoch, {"file": path.name})

    def not_finite(self, report: dict[str, float], batch: PairBatch, log: RunLog | SilentLog) -> DopeError:
        """The error of a loss that is NaN or infinite; the weights are still those before it."""
        step, keys = self.state.step, [key for part in self.ranks.collect(list(batch.keys)) for key in part]
        log.event("not_finite", step, self.state.place.epoch, {"keys": keys})
        some = ", ".join(keys[:16]) + (f" and {len(keys) - 16} more (see metrics.jsonl)" if len(keys) > 16 else "")
        newest = checkpoints.latest_checkpoint(self.out)
        return DopeError(
            f"the loss is {report['loss']} at step {step} (contrastive {report['contrastive']}, "
            f"mask {report['mask']}); the batch held {some}",
            where=self.out,
            remedy="Lower --set optimiser.lr or raise --set schedule.warmup_steps, and look at these samples"
            + (f"; {newest.name} was written before" if newest else ""),
        )

    def end(self, meter: Meter, log: RunLog | SilentLog) -> dict[str, Any]:
        """The result of `train`, once all ranks are done."""
        self.ranks.wait()
        newest = checkpoints.latest_checkpoint(self.out)
        result = {
            "status": "finished" if self.state.step >= self.total_steps else "stopped",
            "step": self.state.step,
            "steps_of_this_call": self.state.step - meter.first_step,
            "epoch": self.state.place.epoch,
            "loss": None if math.isnan(meter.loss) else meter.loss,  # a finished run has nothing left to measure
            "pck": (self.state.validation or {}).get("pck"),
            "pck_untrained": (self.state.untrained or {}).get("pck"),
            "mask_iou": (self.state.validation or {}).get("mask_iou"),
            "checkpoint": None if newest is None else str(newest),
            "seconds": round(meter.seconds, 1),
            "pairs_per_second": round(meter.pairs_per_second, 2),
        }
        log.event("end", self.state.step, self.state.place.epoch, result)
        return result


def open_run(shards: Path, out: Path, config: TrainConfig, ranks: Ranks, resume: str | Path) -> Run:
    """Check the shards, make the network, and go back to where the run stopped; nothing is written yet."""
    data = config.data
    dataset = PairDataset(shards, "train", image_size=data.image_size, max_points=data.max_points)
    order = SampleOrder(
        dataset.index.objects, data.batch_size, pairs_per_object=data.pairs_per_object, seed=config.seed
    )
    if data.batch_size % ranks.world == 0:  # else `SampleOrder.batches` says so
        micro_batches(data.batch_size // ranks.world, data.micro_batch)
    held_out = read_held_out(shards, config, ranks)
    state = new_state(config, ranks)
    found = checkpoint_to_resume(out, resume)
    if found is not None:
        checkpoints.resume(found, state, config, dataset.index.fingerprint)
    return Run(out, config, ranks, dataset, order, held_out, state, found)


def read_held_out(shards: Path, config: TrainConfig, ranks: Ranks) -> list[PairBatch]:
    """This rank's share of the validation pairs, decoded once and kept; empty without validation or split `val`."""
    if config.validation.every == 0:
        return []
    dataset = PairDataset(shards, "val", image_size=config.data.image_size, max_points=config.data.points)
    mine = list(range(min(config.validation.pairs, len(dataset))))[ranks.rank :: ranks.world]
    size = config.validation.batch_size
    return list(PairLoader(dataset, [mine[i : i + size] for i in range(0, len(mine), size)]))


def checkpoint_to_resume(out: Path, resume: str | Path) -> Path | None:
    """The checkpoint to go on from, or None to begin. Raises as `train` does."""
    newest = checkpoints.latest_checkpoint(out)
    if resume == "auto" or (newest is not None and restarts()):
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
    text = yaml.safe_dump(_plain(settings.to_dict(config)), sort_keys=False, allow_unicode=True)
    files.write_bytes(out / "config.yaml", f"# hash {settings.config_hash(config)}\n{text}".encode())


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, (list, tuple)) else value
