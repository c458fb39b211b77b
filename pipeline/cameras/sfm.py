"""Structure from motion: whole images or masked ones, the best of the attempts, and the object's own frame.

`reconstruct` reads a sequence's images (and masks) and writes its cameras, its sparse model and what was tried.
"""

from __future__ import annotations

from typing import Any

from dope.common.errors import BadInput
from pipeline.cameras import colmap
from pipeline.cameras.config import SfmConfig
from pipeline.cameras.ladder import MIN_FRAMES, climb
from pipeline.cameras.model_checks import Outcome, split_warning
from pipeline.cameras.normalise import find_object
from pipeline.cameras.project import keep_project
from pipeline.cameras.store import scratch_folder, store_model
from pipeline.sequence import Frame, Sequence


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
    with scratch_folder(sequence) as scratch:
        outcomes: list[Outcome] = []
        if not (config.mask_features and masked):
            outcomes = climb(sequence, used, config, scratch / "whole", masked=False)
        if masked and all(outcome.objection for outcome in outcomes):
            if outcomes:
                warnings.append(f"only features inside the masks were used: with all, {outcomes[-1].objection}")
            if len(masked) < len(used):
                warnings.append(f"{len(used) - len(masked)} frames without a mask were left out")
            outcomes += climb(sequence, masked, config, scratch / "masked", masked=True)
        best = max(outcomes, key=lambda outcome: outcome.rank)
        kept = keep_project(sequence, frames, best.database, wanted=config.keep_database)
    attempts = [outcome.report for outcome in outcomes]
    if best.objection is not None:
        store_model(sequence, frames, attempts, None)
        raise BadInput(best.objection, where=sequence.folder, remedy=_remedy(config, best.objection))
    warnings += split_warning(best.models)
    model = best.models[0]
    found = find_object(model.points().xyz, *_cameras_and_masks(sequence, frames, model))
    model.transform(found.similarity)
    store_model(sequence, frames, attempts, model, found.similarity.s)
    chosen = {key: best.report[key] for key in ("rung", "mapper", "n_frames", "n_registered", "registered_share")}
    quality = {key: best.report[key] for key in ("n_points", "mean_error_px", "median_angle_deg")}
    return {
        **chosen,
        **quality,
        **kept,
        "n_attempts": len(attempts),
        "object": {
            "centre": [round(float(v), 6) for v in found.centre],
            "radius": round(found.radius, 6),
            "n_points": found.n_points,
            "method": found.method,
        },
        "warnings": warnings,
    }


def _cameras_and_masks(sequence: Sequence, frames: list[Frame], model: colmap.Model) -> tuple[list[Any], list[Any]]:
    by_number = {frame.frame: frame for frame in frames}
    cameras = model.cameras()
    return list(cameras.values()), [sequence.read_mask(by_number[number]) for number in cameras]


def _remedy(config: SfmConfig, objection: str) -> str:
    masks = "if the object turns before a still background, give masks and --mask-features"
    if "moves by itself" in objection:
        return f"{masks[0].upper()}{masks[1:]}; if all is still, set sfm.checks.max_second_motion=1"
    if "hardly moves" in objection:
        advice = "Move the camera around the object instead of turning it on the spot"
    else:
        advice = "Take more views with more overlap, in sharp focus and good light"
    return advice if config.mask_features else f"{advice}; {masks}"
