"""Damaged samples: reported with shard and key, counted over all ranks and resumes, and only so many put up with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dope.batch import DamagedSample, PairBatch
from dope.common.errors import BadInput
from dope.tar_samples import REMAKE

if TYPE_CHECKING:
    from dope.run import Run
    from dope.run_logging import RunLog, SilentLog


def heed(run: Run, stop: bool, batch: PairBatch, log: RunLog | SilentLog) -> bool:
    """Where any rank has news: hear all of them, count damaged samples, and say whether to stop, alike on all.

    Raises `BadInput` on all ranks where too many samples are damaged, or a rank's whole share.
    """
    damaged = list(batch.damaged.values())
    said = run.ranks.collect((stop, damaged, len(damaged) == len(batch)))
    count(run, [one for _, some, _ in said for one in some], log)
    for rank, (_, some, whole_share) in enumerate(said):
        if whole_share:
            if run.state.step:
                run.save(log, hurry=True)  # as in `count`
            raise BadInput(
                f"all {len(some)} samples of rank {rank} at step {run.state.step} are damaged, the first one: "
                f"{some[0].reason}",
                where=f"{run.dataset.index.storage.where(some[0].shard)}, sample {some[0].key}",
                remedy="See whether the shards can be read at all, or write them anew with `dope prep shards`",
            )
    return any(stop for stop, _, _ in said)


def count(run: Run, samples: list[DamagedSample], log: RunLog | SilentLog) -> None:
    """Report samples that were not known to be damaged; with more than `data.max_bad_samples`, save and raise."""
    known, limit = run.state.damaged, run.config.data.max_bad_samples
    for sample in samples:
        if sample.key in known:
            continue
        known.add(sample.key)
        facts = {"shard": sample.shard, "key": sample.key, "reason": sample.reason, "known": len(known)}
        log.event("damaged", run.state.step, run.state.place.epoch, facts)
        log.say(f"damaged sample {sample.key} of {sample.shard}: {sample.reason} ({len(known)} of at most {limit})")
    if len(known) > limit:
        if run.state.step:
            # nothing is lost for one who goes on with a higher limit. The other ranks end at once, and soon after them
            # the first one is ended: it would not come to an end with what takes minutes
            run.save(log, hurry=True)
        storage, what = run.dataset.index.storage, f"{len(known)} damaged, data.max_bad_samples is {limit}"
        newest = samples[-1] if samples else None  # none: they were met before, under a higher limit
        raise BadInput(
            f"{newest.reason} ({what})" if newest else what,
            where=f"{storage.where(newest.shard)}, sample {newest.key}" if newest else storage.address,
            remedy=f"{REMAKE}; or go on without, by --max-bad-samples {len(known)} or more",
        )
