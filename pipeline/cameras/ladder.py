"""The ladder of attempts: match and map, rung after rung, until a model is good enough or no further one can help.

Each rung is mapped strictly and then in a relaxed way. Models that overlap are merged, frames that stay out of an
accepted model get a second chance, and every attempt is judged and reported. COLMAP's global mapper is off by default:
on a real capture matched exhaustively it placed every frame, with a quarter of them turned by 77 degrees, as no
check on points or angles shows. Asked for, it is the last rung, and the pairs' own rotations say what it is worth.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dope.common.errors import BadInput
from pipeline.cameras import colmap, matching
from pipeline.cameras.config import SfmConfig
from pipeline.cameras.model_checks import Outcome, judge
from pipeline.cameras.pairing import frame_name, match_frames, match_stragglers, seed_of
from pipeline.cameras.rungs import LADDER, Rung
from pipeline.cameras.store import mask_folder
from pipeline.sequence import Frame, Sequence
from pipeline.stages import cpu_seconds

MIN_FRAMES = 3


def climb(sequence: Sequence, used: list[Frame], config: SfmConfig, scratch: Path, *, masked: bool) -> list[Outcome]:
    """Attempt after attempt, until one is good enough or no further one can help.

    Args:
        used: the frames to register.
        scratch: a folder for databases, not there yet.
        masked: use only features inside the masks.

    Raises:
        BadInput: there are too few frames.
    """
    if len(used) < MIN_FRAMES:
        raise BadInput(
            f"{len(used)} usable frames; a reconstruction needs at least {MIN_FRAMES}",
            where=sequence.folder,
            remedy="Take more views, or keep more frames of the video",
        )
    scratch.mkdir()
    enough = int(config.target_share * len(used))  # rounded down: one frame of twenty may be missing
    outcomes: list[Outcome] = []
    matched: dict[str, Matched] = {}
    rungs, ended = LADDER[: config.max_rungs], False
    for rung in rungs:
        matched[rung.name] = _match(sequence, used, config, rung, scratch, masked=masked)
        mappers = ["strict", "relaxed"] + (["global"] if config.global_mapper and rung is rungs[-1] else [])
        for outcome in matched[rung.name].attempts(mappers):
            outcomes.append(outcome)
            good = outcome.objection is None and outcome.report["n_registered"] >= enough
            if ended := good or outcome.two_motions:
                break
        if ended:
            break
    place, best = max(enumerate(outcomes), key=lambda numbered: numbered[1].rank)
    if best.objection is None:  # on whichever rung: a later one may have found less
        outcomes[place] = matched[best.report["rung"]].finish(best)
    return outcomes


def _match(
    sequence: Sequence, used: list[Frame], config: SfmConfig, rung: Rung, scratch: Path, *, masked: bool
) -> Matched:
    seconds, cpu = time.perf_counter(), cpu_seconds()
    database = scratch / f"{rung.name}.db"
    masks = mask_folder(sequence, used, scratch) if masked else None
    how = match_frames(sequence, used, config, rung, database, masks=masks)
    verified = colmap.read_verified_pairs(database)
    position = {frame_name(frame): i for i, frame in enumerate(used)}
    connected = matching.largest_component(len(used), [(position[a], position[b]) for a, b, _ in verified])
    size = max(max(frame.width, frame.height) for frame in used)
    motion = matching.second_motion_share(colmap.read_matched_pairs(database), size)
    how |= {"n_verified_pairs": len(verified), "connected": connected}
    return Matched(sequence, used, config, rung, database, how, motion, (seconds, cpu))


@dataclass(frozen=True)
class Matched:
    """A rung's database, from which models are made.

    Attributes:
        how: the settings of features and matches, and what came of them, for the reports.
        motion: share of the pairs that show two motions.
        started: wall and CPU time when matching began.
    """

    sequence: Sequence
    used: list[Frame]
    config: SfmConfig
    rung: Rung
    database: Path
    how: dict[str, Any]
    motion: float
    started: tuple[float, float]

    def attempts(self, mappers: list[str]) -> Iterator[Outcome]:
        """Map with one mapper after the other; what overlaps is merged."""
        seconds, cpu = self.started
        connected, config = self.how["connected"], self.config
        outcome = None
        for mapper in mappers:
            stuck = outcome is not None and connected <= outcome.report["n_registered"]
            if outcome is not None and stuck and (mapper == "relaxed" or outcome.objection is None):
                continue  # no mapper can cross a gap without matches
            models: list[colmap.Model] = []
            merged = 1
            if connected >= 2 and self.motion <= config.checks.max_second_motion:
                models = self._map(mapper)
                models, merged = colmap.merge_models(
                    self.database, self.sequence.images, models, self._folder(mapper, "merged"), self._mapping(mapper)
                )
            outcome = self._judge(models, {"mapper": mapper, "merged": merged})
            outcome.report["seconds"] = round(time.perf_counter() - seconds, 2)
            outcome.report["cpu_seconds"] = round(cpu_seconds() - cpu, 2)
            yield outcome
            seconds, cpu = time.perf_counter(), cpu_seconds()

    def finish(self, outcome: Outcome) -> Outcome:
        """A believed model with its stragglers and a last refinement, or the outcome as it was where that is worse."""
        seconds, cpu = time.perf_counter(), cpu_seconds()
        model, mapper = outcome.models[0], outcome.report["mapper"]
        pairs, before = 0, len(model.frames)
        if self.config.straggler_pairs and before < len(self.used):
            pairs = match_stragglers(self.database, self.used, model.frames, self.config)
            how = self._mapping("relaxed")
            model = colmap.extend_model(self.database, self.sequence.images, model, self._folder(mapper, "more"), how)
        if self.config.robust_refinement:
            model = colmap.refine(model, self._mapping(mapper))
        finished = self._judge([model, *outcome.models[1:]], {"mapper": mapper, "merged": outcome.report["merged"]})
        finished.report["stragglers"] = {"n_pairs": pairs, "n_registered": len(model.frames) - before}
        for key, spent in (("seconds", time.perf_counter() - seconds), ("cpu_seconds", cpu_seconds() - cpu)):
            finished.report[key] = round(outcome.report[key] + spent, 2)
        return finished if finished.rank >= (*outcome.rank[:2], 0) else outcome

    def _judge(self, models: list[colmap.Model], report: dict[str, Any]) -> Outcome:
        outcome = judge(
            models, self.used, self.config.checks, int(self.how["max_image_size"]), self.motion, self.database
        )
        outcome.report.update({"rung": self.rung.name, **report, **self.how})
        return outcome

    def _map(self, mapper: str) -> list[colmap.Model]:
        run = colmap.map_globally if mapper == "global" else colmap.map_incrementally
        return run(self.database, self.sequence.images, self._folder(mapper), self._mapping(mapper))

    def _mapping(self, mapper: str) -> colmap.Mapping:
        config = self.config
        fixed = config.intrinsics is not None and not config.refine_intrinsics
        return colmap.Mapping(
            relaxed=mapper == "relaxed",
            refine_focal=config.refine_focal and not fixed,
            refine_distortion=not fixed,
            seed=seed_of(config, self.rung.name, mapper),
            threads=config.threads,
        )

    def _folder(self, *parts: str) -> Path:
        return self.database.parent / ".".join((self.rung.name, *parts))
