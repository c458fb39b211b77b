"""Features of a sequence's frames and the matches between them, in a new database."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dope.common.seeds import derive_seed
from pipeline.cameras import colmap, matching
from pipeline.cameras.config import SfmConfig
from pipeline.cameras.intrinsics import starting_lenses
from pipeline.cameras.rungs import Rung
from pipeline.sequence import Frame, Sequence

VOTING_FEATURES = 300
"""The largest features of each frame, by which look-alikes are found."""


def match_frames(
    sequence: Sequence, used: list[Frame], config: SfmConfig, rung: Rung, database: Path, *, masks: Path | None
) -> dict[str, Any]:
    """Features and verified matches of one rung in a new database; returns the settings that were used."""
    names = [frame_name(frame) for frame in used]
    colmap.import_images(database, sequence.images, starting_lenses(used, config))
    settings: dict[str, Any] = {
        "max_image_size": getattr(config, rung.size),
        "first_octave": config.first_octave if rung.first_octave is None else rung.first_octave,
        "max_features": config.max_features,
    }
    colmap.extract_features(database, sequence.images, names, masks=masks, threads=config.threads, **settings)
    matched, pairs = _choose_pairs(sequence, database, names, config, rung)
    colmap.match_pairs(
        database,
        [(names[a], names[b]) for a, b in pairs],
        guided=rung.guided,
        seed=seed_of(config, rung.name, "matching"),
        threads=config.threads,
    )
    return {**settings, "guided": rung.guided, "masked": masks is not None, "matching": matched, "n_pairs": len(pairs)}


def _choose_pairs(
    sequence: Sequence, database: Path, names: list[str], config: SfmConfig, rung: Rung
) -> tuple[str, list[matching.Pair]]:
    n, kind = len(names), config.matching
    if kind == "auto":
        kind = (
            "sequential"
            if sequence.read_info().ordered
            else "exhaustive"
            if n <= config.exhaustive_limit
            else "similar"
        )
    if kind == "exhaustive" or (rung.exhaustive and n <= config.exhaustive_fallback_limit):
        return "exhaustive", matching.exhaustive_pairs(n)
    votes = _votes(database, names)
    if kind == "sequential":
        near = matching.neighbour_pairs(n, config.gaps, wrap_around=config.wrap_around)
        alike = matching.most_similar_pairs(votes, config.similar_neighbours // 2)
    else:  # names of photos usually follow the order of shooting
        near = matching.neighbour_pairs(n, (1, 2), wrap_around=False)
        alike = matching.most_similar_pairs(votes, config.similar_neighbours)
    return kind, sorted({*near, *alike})


def match_stragglers(database: Path, used: list[Frame], registered: list[int], config: SfmConfig) -> int:
    """Match frames that are not registered with more of those that are, guided; returns how many pairs were matched.

    Half of `straggler_pairs` are the nearest in time, half those that look most alike. Pairs matched before are
    matched again: guided matching finds more.
    """
    names, inside = [frame_name(frame) for frame in used], set(registered)
    there = [i for i, frame in enumerate(used) if frame.frame in inside]
    votes, pairs = _votes(database, names), set()
    for i in sorted(set(range(len(used))) - set(there)):
        near = sorted(there, key=lambda j: (abs(i - j), j))
        alike = sorted(there, key=lambda j: (-votes[i, j], j))
        for j in (*near[: config.straggler_pairs // 2], *alike[: config.straggler_pairs // 2]):
            pairs.add((names[min(i, j)], names[max(i, j)]))
    colmap.forget_pairs(database, sorted(pairs))
    colmap.match_pairs(database, sorted(pairs), guided=True, seed=seed_of(config, "stragglers"), threads=config.threads)
    return len(pairs)


def _votes(database: Path, names: list[str]) -> Any:
    features = colmap.read_features(database)
    return matching.similarity_votes([features[name] for name in names], n_features=VOTING_FEATURES)


def frame_name(frame: Frame) -> str:
    """Name of a frame's image in COLMAP's database."""
    return Path(str(frame.image)).name


def seed_of(config: SfmConfig, *what: str) -> int:
    """Seed of one step of the reconstruction."""
    return derive_seed(config.seed, "sfm", *what) % 2**31
