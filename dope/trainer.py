"""Training: `train` streams shards into a DOPE network, on one process or on each of those that torchrun started."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dope import checkpoints
from dope.augmentation import no_augmentation
from dope.batch import DamagedSample, PairBatch
from dope.common import files, settings
from dope.common.errors import BadInput, DopeError, UsageError
from dope.config import TrainConfig, check
from dope.distributed import Ranks, ranks_of
from dope.heap import keep_heap
from dope.networks.untrained import settle_batchnorm
from dope.order import SampleOrder
from dope.run_logging import Meter, RunLog, SilentLog
from dope.state import TrainState, learning_rate, new_state, total_steps, wrap
from dope.step import compute_losses, sample_batch
from dope.stop_signals import StopRequest
from dope.storage import Shards
from dope.streaming import PairDataset, PairLoader
from dope.tar_samples import REMAKE
from dope.validation import pck


def train(
    shards: Shards, out: Path, config: TrainConfig, *, resume: str | Path = "auto", stop_after: int | None = None
) -> dict[str, Any]:
    """Train on SHARDS and leave checkpoints, settings and metrics in the folder `out`.

    Args:
        shards: folder of shards, or an fsspec URL of it; split `train` is trained on, split `val` validates.
        out: the run's folder: config.yaml, checkpoints/, metrics.jsonl, tensorboard/.
        config: all settings (see `dope.config.load_config`).
        resume: `auto` goes on where `out` stopped, or begins; `never` insists on a new folder; a path names a
            checkpoint or another run to go on from.
        stop_after: stop with a checkpoint after so many steps of this call; the schedule stays that of the whole run.

    Returns:
        `status` (finished, or stopped by a signal or `stop_after`), `step`, `steps_of_this_call`, `epoch`, `loss`,
        `pck`, `pck_untrained`, `mask_iou`, `damaged` (samples), `checkpoint`, `seconds`, `pairs_per_second`; None
        where there is none.

    Raises:
        BadInput: shards or checkpoint missing or damaged, or more samples than `data.max_bad_samples` are.
        UsageError: settings that do not fit them.
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
        pin = ranks.device.type == "cuda"
        loader = PairLoader(run.dataset, rows, workers=config.data.workers, pin_memory=pin, fill_damaged=True)
        online, meter = wrap(state.network, ranks), Meter(state.step)
        with run.begin() as log:
            stopping = state.step >= last_step
            for batch in loader if not stopping else ():
                lr = learning_rate(config, state.step, run.order.steps_per_epoch)
                for group in state.optimiser.param_groups:
                    group["lr"] = lr
                sampled = sample_batch(batch.to(ranks.device), config, state.step, ranks.rank)
                news = stop.requested or bool(batch.damaged)
                losses = compute_losses(online, state.momentum, sampled, config, ranks, step=state.step, stop=news)
                asked_to_stop = losses.stop and run.heed(stop.requested, batch, log)
                if not math.isfinite(losses.report["loss"]):
                    raise run.not_finite(losses.report, batch, log)
                state.optimiser.zero_grad(set_to_none=True)
                losses.backward.backward()
                state.optimiser.step()
                state.momentum.update(state.network)

                state.step, state.place = state.step + 1, run.order.after(state.place)
                stopping = asked_to_stop or state.step >= last_step
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
    held_out_damaged: list[DamagedSample]
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
        if self.dataset.index.left_out:
            facts["left_out"] = self.dataset.index.left_out
            least = self.config.data.min_correspondences
            log.say(f"{facts['left_out']} pairs with fewer than {least} correspondences are left out")
        log.event("start", self.state.step, self.state.place.epoch, facts)
        self.count_damaged([one for some in self.ranks.collect(self.held_out_damaged) for one in some], log)
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
            network = copy.deepcopy(network)
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

    def heed(self, stop: bool, batch: PairBatch, log: RunLog | SilentLog) -> bool:
        """Where any rank has news: hear all of them, count damaged samples, and say whether to stop, alike on all.

        Raises `BadInput` on all ranks where too many samples are damaged, or a rank's whole share.
        """
        damaged = list(batch.damaged.values())
        said = self.ranks.collect((stop, damaged, len(damaged) == len(batch)))
        self.count_damaged([one for _, some, _ in said for one in some], log)
        for rank, (_, some, whole_share) in enumerate(said):
            if whole_share:
                raise BadInput(
                    f"all {len(some)} samples of rank {rank} at step {self.state.step} are damaged, the first one: "
                    f"{some[0].reason}",
                    where=f"{self.dataset.index.storage.where(some[0].shard)}, sample {some[0].key}",
                    remedy="See whether the shards can be read at all, or write them anew with `dope prep shards`",
                )
        return any(stop for stop, _, _ in said)

    def count_damaged(self, samples: list[DamagedSample], log: RunLog | SilentLog) -> None:
        """Report samples that were not known to be damaged; with more than `data.max_bad_samples`, save and raise."""
        known, limit = self.state.damaged, self.config.data.max_bad_samples
        for sample in samples:
            if sample.key in known:
                continue
            known.add(sample.key)
            facts = {"shard": sample.shard, "key": sample.key, "reason": sample.reason, "known": len(known)}
            log.event("damaged", self.state.step, self.state.place.epoch, facts)
            log.say(f"damaged sample {sample.key} of {sample.shard}: {sample.reason} ({len(known)} of at most {limit})")
        if len(known) > limit:
            if self.state.step:
                self.save(log)  # nothing is lost for one who goes on with a higher limit
            storage, what = self.dataset.index.storage, f"{len(known)} damaged, data.max_bad_samples is {limit}"
            newest = samples[-1] if samples else None  # none: they were met before, under a higher limit
            raise BadInput(
                f"{newest.reason} ({what})" if newest else what,
                where=f"{storage.where(newest.shard)}, sample {newest.key}" if newest else storage.address,
                remedy=f"{REMAKE}; or go on without, by --max-bad-samples {len(known)} or more",
            )

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
            "damaged": len(self.state.damaged),
            "checkpoint": None if newest is None else str(newest),
            "seconds": round(meter.seconds, 1),
            "pairs_per_second": round(meter.pairs_per_second, 2),
        }
        log.event("end", self.state.step, self.state.place.epoch, result)
        return result


def open_run(shards: Shards, out: Path, config: TrainConfig, ranks: Ranks, resume: str | Path) -> Run:
    """Check the shards, make the network, and go back to where the run stopped; nothing is written yet."""
    data = config.data
    dataset = PairDataset(
        shards,
        "train",
        image_size=data.image_size,
        max_points=data.max_points,
        min_correspondences=data.min_correspondences,
    )
    if not len(dataset):
        where = dataset.index.storage.where("index.parquet")
        raise BadInput("has no pairs for training", where=where, remedy="Hold out less: `dope prep shards --set`")
    order = SampleOrder(
        dataset.index.objects,
        data.batch_size,
        pairs_per_object=data.pairs_per_object,
        seed=config.seed,
        order=data.order,
        block=data.block,
    )
    held_out, held_out_damaged = read_held_out(shards, config, ranks)
    state = new_state(config, ranks)
    found = checkpoint_to_resume(out, resume)
    if found is not None:
        checkpoints.resume(found, state, config, dataset.index.fingerprint)
    return Run(out, config, ranks, dataset, order, held_out, held_out_damaged, state, found)


def read_held_out(shards: Shards, config: TrainConfig, ranks: Ranks) -> tuple[list[PairBatch], list[DamagedSample]]:
    """This rank's share of the validation pairs, decoded once and kept, without the damaged ones, and these.

    Empty without validation or split `val`.
    """
    if config.validation.every == 0:
        return [], []
    dataset = PairDataset(shards, "val", image_size=config.data.image_size, max_points=config.data.points)
    mine = list(range(min(config.validation.pairs, len(dataset))))[ranks.rank :: ranks.world]
    size = config.validation.batch_size
    rows = [mine[i : i + size] for i in range(0, len(mine), size)]
    batches = list(PairLoader(dataset, rows, fill_damaged=True))
    whole = [batch.without_damaged() for batch in batches]
    return [batch for batch in whole if len(batch)], [one for batch in batches for one in batch.damaged.values()]


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
    text = yaml.safe_dump(_plain(settings.to_dict(config)), sort_keys=False, allow_unicode=True)
    files.write_bytes(out / "config.yaml", f"# hash {settings.config_hash(config)}\n{text}".encode())


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, (list, tuple)) else value
