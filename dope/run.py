"""What a call of `dope.trainer.train` works on: shards, network, place in the run, and what is due between steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dope import checkpoints, damage
from dope.batch import DamagedSample
from dope.common import files, settings
from dope.common.errors import BadInput, DopeError
from dope.config import TrainConfig, write_config
from dope.distributed import Ranks
from dope.figures.held_out import held_out_sheet
from dope.meter import Meter
from dope.methods import method_of
from dope.methods.base import Method, Order
from dope.networks import DopeNetwork
from dope.networks.untrained import settle_batchnorm
from dope.queries import micro_batches, resolved_precision
from dope.run_lock import only_one
from dope.run_logging import RunLog, SilentLog, describe_start
from dope.state import TrainState, new_state, total_steps
from dope.storage import Shards
from dope.streaming import PairLoader
from dope.validation import evaluating
from dope.wandb_run import require_wandb


@dataclass
class Run:
    """What a call of `train` works on, and what it does besides the steps themselves.

    Attributes:
        held_out: this rank's share of the validation pairs, and those of it that are damaged.
        resumed_from: the checkpoint that it goes on from, or None.
        damaged_checkpoints: what is wrong with newer checkpoints that were passed over.
    """

    out: Path
    config: TrainConfig
    ranks: Ranks
    method: Method
    dataset: Any
    order: Order
    held_out: list[Any]
    held_out_damaged: list[DamagedSample]
    state: TrainState
    resumed_from: Path | None
    damaged_checkpoints: list[BadInput]

    @property
    def total_steps(self) -> int:
        """Steps of the whole run."""
        return total_steps(self.config, self.order.steps_per_epoch)

    def is_due(self, every: int, every_steps: int = 0) -> bool:
        """True at the end of each `every`-th epoch and after each `every_steps`-th step; never for 0."""
        epoch_is_over = self.state.place.consumed == 0
        return (every > 0 and epoch_is_over and self.state.place.epoch % every == 0) or (
            every_steps > 0 and self.state.step % every_steps == 0
        )

    def begin(self) -> RunLog | SilentLog:
        """Write the settings, open the log, say what is trained, and validate the untrained network."""
        step, epoch, config = self.state.step, self.state.place.epoch, self.config
        log: RunLog | SilentLog = SilentLog()
        if self.ranks.is_first:
            write_config(self.out / "config.yaml", config)
            for folder in (self.out, self.out / "checkpoints"):
                files.clear_leftovers(folder)
            plain = settings.to_dict(config)
            log = RunLog(self.out, start=step, total=self.total_steps, wandb=config.log.wandb, config=plain)
        facts = self.facts()
        log.say(describe_start(facts))
        log.event("start", step, epoch, facts)
        for error in self.damaged_checkpoints:
            log.say(f"WARNING: {error.where}: {error.what}. Going on from an older one, {self.resumed_from}")
            log.event("damaged_checkpoint", step, epoch, {"file": error.where, "reason": error.what})
        damage.count(self, [one for some in self.ranks.collect(self.held_out_damaged) for one in some], log)
        if step == 0:
            self.validate(log)
            self.state.untrained = self.state.validation
        return log

    def facts(self) -> dict[str, Any]:
        """What is trained on what, from where to where."""
        return {
            "method": self.method.name,
            "samples": "pairs" if self.method.pairs else "views",
            "batch_of": self.method.batch_of,
            "pairs": len(self.dataset),
            "left_out": self.dataset.index.left_out,
            "objects": self.order.n_objects,
            "batch_size": self.config.data.batch_size,
            "steps_per_epoch": self.order.steps_per_epoch,
            "total_steps": self.total_steps,
            "warmup_steps": self.config.schedule.warmup_steps,
            "parameters": sum(parameter.numel() for parameter in self.state.network.parameters()),
            "precision": resolved_precision(self.config.precision, self.ranks.device),
            "world": self.ranks.world,
            "device": str(self.ranks.device),
            "config_hash": settings.config_hash(self.config),
            "dataset": self.dataset.index.fingerprint,
            "resumed_from": None if self.resumed_from is None else str(self.resumed_from),
            "resumed_at": self.state.step,
        }

    def after_step(
        self, report: dict[str, float], meter: Meter, log: RunLog | SilentLog, *, stopping: bool, hurry: bool = False
    ) -> None:
        """What is due after a step: progress, a line of metrics, validation, a checkpoint; `hurry` as for `save`."""
        step, policy = self.state.step, self.config.checkpoint
        log.progress(step, meter)
        if stopping or step % self.config.log.every == 0:
            speed = {"pairs_per_second": round(meter.pairs_per_second, 2), "data_wait": round(meter.data_wait, 4)}
            log.event("step", step, self.state.place.epoch, {**report, **speed})
        is_best = False
        if step == self.total_steps or self.is_due(self.config.validation.every):
            is_best = self.validate(log) and policy.keep_best
        if stopping or is_best or self.is_due(policy.every, policy.every_steps):
            self.save(log, is_best=is_best, hurry=hurry and step < self.total_steps)

    def validate(self, log: RunLog | SilentLog) -> bool:
        """The method's score on all ranks' held-out samples, logged, drawn and kept for the checkpoint.

        Returns:
            Whether it is higher than that of the run's best checkpoint.
        """
        if self.config.validation.every == 0:
            return False
        network, step = self.state.network, self.state.step
        if step == 0:  # random weights without the statistics of real images would be no baseline at all
            network = self.method.new_network(self.state.facts)  # plain: the ranks' numbers of batches may differ
            network.load_state_dict(self.state.network.state_dict())
            network.to(self.ranks.device)
            held_out = (batch.to(self.ranks.device) for batch in self.held_out)
            settle_batchnorm(network, self.method.plain_images(held_out))
        self.ranks.copy_from_first(network)  # the ranks' BatchNorm statistics differ by their last batch
        result = self.method.validate(network, self.held_out, self.ranks)
        if result["pairs"] == 0:
            if step == 0:
                log.say("nothing is held out (split val): nothing is validated")
            return False
        self.state.validation = result
        log.event("validation", step, self.state.place.epoch, result)
        if self.ranks.is_first and self.config.log.pictures and isinstance(network, DopeNetwork):
            title, device = f"held-out pairs at step {step}", self.ranks.device
            with evaluating(network):
                sheet = held_out_sheet(network, self.held_out, self.config.log.pictures, title=title, device=device)
            if sheet is not None:
                log.picture("validation/pairs", step, sheet)
        return result[self.method.score] > checkpoints.best_score(self.out, before=step)

    def save(self, log: RunLog | SilentLog, *, is_best: bool = False, hurry: bool = False) -> None:
        """Write a checkpoint on the first rank; with `hurry`, after a signal or error, without what takes minutes."""
        if self.ranks.is_first:
            best = self.state.validation[self.method.score] if is_best and self.state.validation else None
            fingerprint = self.dataset.index.fingerprint
            self.method.before_save(self.state.network, self.dataset, hurry=hurry)
            path = checkpoints.save_checkpoint(self.out, self.state, self.method, fingerprint, best=best)
            log.event("checkpoint", self.state.step, self.state.place.epoch, {"file": path.name, "best": is_best})

    def end(self, meter: Meter, log: RunLog | SilentLog) -> dict[str, Any]:
        """The result of `train`, once all ranks are done."""
        self.ranks.wait()
        newest, score = checkpoints.latest_checkpoint(self.out), self.method.score
        result = {
            "status": "finished" if self.state.step >= self.total_steps else "stopped",
            "step": self.state.step,
            "steps_of_this_call": self.state.step - meter.first_step,
            "epoch": self.state.place.epoch,
            "loss": None if math.isnan(meter.loss) else meter.loss,  # a finished run has nothing left to measure
            "score_name": score,
            "score": (self.state.validation or {}).get(score),
            "score_untrained": (self.state.untrained or {}).get(score),
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


@contextmanager
def open_run(shards: Shards, out: Path, config: TrainConfig, ranks: Ranks, resume: str | Path) -> Iterator[Run]:
    """Check the shards, make the network, and go back to where the run stopped; `out` is this run's own meanwhile.

    Nothing is written yet but RUN/.lock, and where the run begins from another checkpoint.
    """
    if config.log.wandb:
        require_wandb()
    data, method = config.data, method_of(config)
    dataset = method.dataset(shards, "train")
    if not len(dataset):
        where = dataset.index.storage.where("index.parquet" if method.pairs else "views.parquet")
        what = f"has no {'pairs' if method.pairs else 'views'} for training"
        raise BadInput(what, where=where, remedy="Hold out less: `dope prep shards --set`")
    order = method.order(dataset)
    if data.batch_size % ranks.world == 0:  # else `SampleOrder.batches` says so
        micro_batches(data.batch_size // ranks.world, data.micro_batch)
    held_out, held_out_damaged = read_held_out(shards, method, ranks)
    state = new_state(method, ranks, method.facts(dataset))
    with _on_first(ranks, lambda: only_one(out)):
        fingerprint = dataset.index.fingerprint
        found, damaged = checkpoints.go_on_from(resume, out, state, method, fingerprint)
        if len(set(ranks.collect(state.step))) > 1:
            what = "the ranks do not see the same checkpoints"
            raise DopeError(what, where=out / "checkpoints", remedy="All machines must share this folder")
        if found is None:
            method.refuse_unread()
            state.facts = method.start(state.network, state.facts)
        if ranks.is_first:
            checkpoints.note_origin(resume, out, found)
        yield Run(out, config, ranks, method, dataset, order, held_out, held_out_damaged, state, found, damaged)


@contextmanager
def _on_first(ranks: Ranks, entered: Callable[[], AbstractContextManager[None]]) -> Iterator[None]:
    """Hold something on the first rank; where it cannot be had, the error is raised on all ranks alike."""
    with ExitStack() as stack:
        error: DopeError | None = None
        if ranks.is_first:
            try:
                stack.enter_context(entered())
            except DopeError as refused:
                error = refused
        error = ranks.collect(error)[0]
        if error is not None:
            raise error
        yield


def read_held_out(shards: Shards, method: Method, ranks: Ranks) -> tuple[list[Any], list[DamagedSample]]:
    """This rank's share of the validation samples, decoded once and kept, without the damaged ones, and these.

    Empty without validation or split `val`.
    """
    settings = method.config.validation
    if settings.every == 0:
        return [], []
    dataset = method.dataset(shards, "val")
    mine = method.held_out_rows(dataset, settings.pairs)[ranks.rank :: ranks.world]
    rows = [mine[i : i + settings.batch_size] for i in range(0, len(mine), settings.batch_size)]
    batches = list(PairLoader(dataset, rows, fill_damaged=True))
    whole = [batch.without_damaged() for batch in batches]
    return [batch for batch in whole if len(batch)], [one for batch in batches for one in batch.damaged.values()]
