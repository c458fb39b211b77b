"""Structure from motion: a ladder of attempts, checks of what comes out, and the object's own frame.

`reconstruct` reads a sequence's images (and masks) and writes its cameras, its sparse model and what was tried. The
first rung is the cheap one that most captures need; each next rung costs more and holds on to less texture. COLMAP's
global mapper is no rung: on a real capture it registered every frame with rotations 10 degrees off, which no check
on points or angles tells from a good model.
"""

from __future__ import annotations

import shutil
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from dope.common.errors import BadInput
from dope.common.files import TEMPORARY, atomic_folder, explaining_full_disk
from dope.common.seeds import derive_seed
from pipeline import colmap, matching
from pipeline.model_checks import CheckConfig, Outcome, judge, split_warning
from pipeline.normalise import find_object
from pipeline.sequence import Frame, Sequence
from pipeline.stages import cpu_seconds

MIN_FRAMES = 3


@dataclass(frozen=True)
class SfmConfig:
    """Settings of structure from motion."""

    matching: Literal["auto", "sequential", "exhaustive", "similar"] = "auto"
    """Which frames are matched: neighbours in time, all, or those that look alike; auto chooses by order and number."""
    mask_features: bool = False
    """Use only features inside the masks, where there are any (turntables: the object turns, the background does not).
    Without this they are used all the same when whole images give no model that can be believed."""
    camera_model: colmap.CameraModel = "SIMPLE_RADIAL"
    """COLMAP's camera model."""
    share_camera: bool = True
    """One camera for all frames of a size; false where focal lengths differ (zoom, photos of several cameras)."""
    focal_factor: float | None = None
    """Known focal length in multiples of the longer image side; null = start from 1.2 and refine."""
    refine_focal: bool = True
    """Refine the focal length in bundle adjustment."""
    max_image_size: int = 640
    """Longer side at which features are found, px; cameras are those of the stored images all the same."""
    fallback_image_size: int = 1024
    """The same for the last rung of the ladder."""
    first_octave: int = 0
    """First octave of SIFT in the first attempt; the next ones use -1, four times the pixels."""
    max_features: int = 2000
    """Features of an image before orientations are assigned (an image has up to twice as many)."""
    gaps: tuple[int, ...] = (1, 2, 4, 8)
    """Sequential matching: distances in frames between the two of a pair."""
    wrap_around: bool = True
    """Sequential matching: the last frames are matched with the first ones, as if the orbit were closed."""
    similar_neighbours: int = 8
    """Similarity matching: how many look-alikes each frame is matched with (sequential: half as many)."""
    exhaustive_limit: int = 24
    """auto: unordered sets up to this size are matched exhaustively."""
    exhaustive_fallback_limit: int = 100
    """The last attempt matches sets up to this size exhaustively."""
    target_share: float = 0.97
    """Share of registered frames (rounded down to whole frames) at which no further attempt is made."""
    max_rungs: int = 3
    """Rungs of the ladder tried: default, fine (finer scales, guided matching), large (more pixels, all pairs)."""
    checks: CheckConfig = field(default_factory=CheckConfig)
    """What a model must have to be believed."""
    threads: int = 1
    """Threads of COLMAP; with one the same input gives the same bytes."""
    seed: int = 0
    """Seed of all random sampling."""


@dataclass(frozen=True)
class Rung:
    """One set of features and matches to map from."""

    name: str
    first_octave: int | None = None
    """None: as configured."""
    guided: bool = False
    large: bool = False
    """Features at the fallback size."""
    exhaustive: bool = False
    """All pairs, where the set is small."""


LADDER = (
    Rung("default"),
    Rung("fine", first_octave=-1, guided=True),
    Rung("large", first_octave=-1, guided=True, large=True, exhaustive=True),
)


def reconstruct(sequence: Sequence, config: SfmConfig) -> dict[str, Any]:
    """Find the cameras of a sequence; write `sparse/`, frames.parquet and sequence.json in the object's frame.

    Returns:
        What happened: attempts, registered share, points, errors, the normalising similarity, warnings.

    Raises:
        BadInput: too few frames, or nothing sensible registers; the attempts are in sequence.json all the same.
    """
    frames = sequence.read_frames()
    warnings: list[str] = []
    used = [frame for frame in frames if frame.image is not None]
    masked = [frame for frame in used if frame.mask is not None]
    if len(masked) < MIN_FRAMES:
        if config.mask_features:
            warnings.append(f"mask_features: {len(masked)} frames have a mask, whole images were used")
        masked = []
    with _scratch(sequence) as scratch:
        outcomes: list[Outcome] = []
        if not (config.mask_features and masked):
            outcomes = _climb(sequence, used, config, scratch / "whole", masked=False)
        if masked and all(outcome.objection for outcome in outcomes):
            if outcomes:
                warnings.append(f"only features inside the masks were used: with all, {outcomes[-1].objection}")
            if len(masked) < len(used):
                warnings.append(f"{len(used) - len(masked)} frames without a mask were left out")
            outcomes += _climb(sequence, masked, config, scratch / "masked", masked=True)
    best = max(outcomes, key=lambda outcome: outcome.rank)
    attempts = [outcome.report for outcome in outcomes]
    if best.objection is not None:
        _store(sequence, frames, attempts, None)
        raise BadInput(best.objection, where=sequence.folder, remedy=_remedy(config, best.objection))
    warnings += split_warning(best.models)
    model = best.models[0]
    found = find_object(model.points().xyz, *_cameras_and_masks(sequence, frames, model))
    model.transform(found.similarity)
    _store(sequence, frames, attempts, model)
    chosen = {key: best.report[key] for key in ("rung", "mapper", "n_frames", "n_registered", "registered_share")}
    quality = {key: best.report[key] for key in ("n_points", "mean_error_px", "median_angle_deg")}
    return {
        **chosen,
        **quality,
        "n_attempts": len(attempts),
        "object": {
            "centre": [round(float(v), 6) for v in found.centre],
            "radius": round(found.radius, 6),
            "n_points": found.n_points,
            "method": found.method,
        },
        "warnings": warnings,
    }


def _climb(sequence: Sequence, used: list[Frame], config: SfmConfig, scratch: Path, *, masked: bool) -> list[Outcome]:
    """Attempt after attempt, until one is good enough or no further one can help."""
    if len(used) < MIN_FRAMES:
        raise BadInput(
            f"{len(used)} usable frames; a reconstruction needs at least {MIN_FRAMES}",
            where=sequence.folder,
            remedy="Take more views, or keep more frames of the video",
        )
    scratch.mkdir()
    enough = int(config.target_share * len(used))  # rounded down: one frame of twenty may be missing
    outcomes: list[Outcome] = []
    for rung in LADDER[: config.max_rungs]:
        for outcome in _attempts(sequence, used, config, rung, scratch, masked=masked):
            outcomes.append(outcome)
            if outcome.two_motions or (outcome.objection is None and outcome.report["n_registered"] >= enough):
                return outcomes
    return outcomes


def _attempts(
    sequence: Sequence, used: list[Frame], config: SfmConfig, rung: Rung, scratch: Path, *, masked: bool
) -> Iterator[Outcome]:
    """Features and matches of a rung, mapped strictly and then in a relaxed way."""
    seconds, cpu = time.perf_counter(), cpu_seconds()
    database = scratch / f"{rung.name}.db"
    how = _match(
        sequence, used, config, rung, database, masks=_mask_folder(sequence, used, scratch) if masked else None
    )
    verified = colmap.read_verified_pairs(database)
    position = {_name(frame): i for i, frame in enumerate(used)}
    graph = matching.largest_component(len(used), [(position[a], position[b]) for a, b, _ in verified])
    size = max(max(frame.width, frame.height) for frame in used)
    motion = matching.second_motion_share(colmap.read_matched_pairs(database), size)
    for mapper in ("strict", "relaxed"):
        models: list[colmap.Model] = []
        if graph >= 2 and motion <= config.checks.max_second_motion:
            models = colmap.map_incrementally(
                database,
                sequence.images,
                scratch / f"{rung.name}.{mapper}",
                relaxed=mapper == "relaxed",
                min_model_size=3,
                refine_focal=config.refine_focal,
                seed=_seed(config, rung.name, mapper),
                threads=config.threads,
            )
        outcome = judge(models, used, config.checks, int(how["max_image_size"]), motion)
        outcome.report.update(
            {"rung": rung.name, "mapper": mapper, **how, "n_verified_pairs": len(verified), "connected": graph}
        )
        outcome.report["seconds"] = round(time.perf_counter() - seconds, 2)
        outcome.report["cpu_seconds"] = round(cpu_seconds() - cpu, 2)
        yield outcome
        seconds, cpu = time.perf_counter(), cpu_seconds()
        if graph <= outcome.report["n_registered"]:
            break  # a relaxed mapper cannot cross a gap without matches


def _match(
    sequence: Sequence, used: list[Frame], config: SfmConfig, rung: Rung, database: Path, *, masks: Path | None
) -> dict[str, Any]:
    """Features and verified matches of one rung in a new database; returns the settings that were used."""
    names = [_name(frame) for frame in used]
    by_size: dict[tuple[int, int], list[str]] = defaultdict(list)
    for frame in used:
        by_size[frame.width, frame.height].append(_name(frame))
    intrinsics = colmap.Intrinsics(config.camera_model, config.share_camera, config.focal_factor)
    colmap.import_images(database, sequence.images, by_size, intrinsics)
    settings: dict[str, Any] = {
        "max_image_size": config.fallback_image_size if rung.large else config.max_image_size,
        "first_octave": config.first_octave if rung.first_octave is None else rung.first_octave,
        "max_features": config.max_features,
    }
    colmap.extract_features(database, sequence.images, names, masks=masks, threads=config.threads, **settings)
    matched, pairs = _choose_pairs(sequence, database, names, config, rung)
    colmap.match_pairs(
        database,
        [(names[a], names[b]) for a, b in pairs],
        guided=rung.guided,
        seed=_seed(config, rung.name, "matching"),
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
    features = colmap.read_features(database)
    votes = matching.similarity_votes([features[name] for name in names], n_features=400)
    if kind == "sequential":
        near = matching.neighbour_pairs(n, config.gaps, wrap_around=config.wrap_around)
        alike = matching.most_similar_pairs(votes, config.similar_neighbours // 2)
    else:  # names of photos usually follow the order of shooting
        near = matching.neighbour_pairs(n, (1, 2), wrap_around=False)
        alike = matching.most_similar_pairs(votes, config.similar_neighbours)
    return kind, sorted({*near, *alike})


def _cameras_and_masks(sequence: Sequence, frames: list[Frame], model: colmap.Model) -> tuple[list[Any], list[Any]]:
    by_number = {frame.frame: frame for frame in frames}
    cameras = model.cameras()
    return list(cameras.values()), [sequence.read_mask(by_number[number]) for number in cameras]


def _store(sequence: Sequence, frames: list[Frame], attempts: list[dict[str, Any]], model: colmap.Model | None) -> None:
    """Write a model, frames and info; without a model, forget the one that was there."""
    for frame in frames:
        frame.clear_camera()
    cameras = model.cameras() if model else {}
    if model is None:
        shutil.rmtree(sequence.sparse, ignore_errors=True)
    else:
        with atomic_folder(sequence.sparse) as partial:
            model.write(partial)
    by_number = {frame.frame: frame for frame in frames}
    for number, camera in cameras.items():
        by_number[number].set_camera(camera)
    sequence.write_frames(frames)
    info = sequence.read_info()
    info.attempts, info.n_registered = attempts, len(cameras)
    info.registered_share = round(len(cameras) / max(1, attempts[0]["n_frames"]), 4)
    info.unit = "object radius" if model else "arbitrary"
    sequence.write_info(info)


def _mask_folder(sequence: Sequence, used: list[Frame], scratch: Path) -> Path:
    """Masks under the names that COLMAP looks for: that of `a.jpg` is `a.jpg.png`."""
    folder = scratch / "masks"
    folder.mkdir(exist_ok=True)
    for frame in used:
        link = folder / f"{_name(frame)}.png"
        if frame.mask is not None and not link.exists():
            link.symlink_to((sequence.folder / frame.mask).resolve())
    return folder


@contextmanager
def _scratch(sequence: Sequence) -> Iterator[Path]:
    """A folder beside the sequence's files for databases; what a killed run left there goes first."""
    folder = sequence.folder / f".sfm{TEMPORARY}"
    shutil.rmtree(folder, ignore_errors=True)
    with explaining_full_disk(sequence.folder):
        folder.mkdir(parents=True)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def _name(frame: Frame) -> str:
    return Path(str(frame.image)).name


def _seed(config: SfmConfig, *what: str) -> int:
    return derive_seed(config.seed, "sfm", *what) % 2**31


def _remedy(config: SfmConfig, objection: str) -> str:
    masks = "if the object turns before a still background, give masks and --mask-features"
    if "moves by itself" in objection:
        return f"{masks[0].upper()}{masks[1:]}; if all is still, set sfm.checks.max_second_motion=1"
    if "hardly moves" in objection:
        advice = "Move the camera around the object instead of turning it on the spot"
    else:
        advice = "Take more views with more overlap, in sharp focus and good light"
    return advice if config.mask_features else f"{advice}; {masks}"
