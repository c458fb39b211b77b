"""Can this model be real? Measures of a sparse model, and what speaks against it.

A camera that only turns on the spot, frames that are all the same, or two accidental matches also give "a model": they
show in its few points and in the small angles between its rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.cameras import colmap
from pipeline.cameras.matching import largest_component
from pipeline.geometry import Floats, rotation_angle_deg
from pipeline.sequence import Frame

PAIR_MATCHES = 30
"""Verified matches below which a pair's rotation is no witness."""
MAX_PAIRS = 2000
"""Pairs that are heard, evenly chosen: 0.3 ms each."""


@dataclass(frozen=True)
class CheckConfig:
    """What a model must have to be believed."""

    min_share: float = 0.3
    """Share of registered frames below which the result is rejected."""
    min_frames: int = 5
    """Number of registered frames below which the result is rejected (sets of fewer than 10 frames: 3)."""
    min_points: int = 50
    """Number of points below which a model is taken for an accident."""
    min_angle_deg: float = 2.0
    """Median triangulation angle below which a camera is taken to stand still."""
    min_parallax: float = 0.3
    """Median triangulation angle over the angle by which cameras turned, below which a camera is taken to only turn.
    Around an object, or along it, the ratio is 1 or more."""
    max_second_motion: float = 0.08
    """Share of image pairs with two motions above which a part of the picture must move by itself (1 = allow)."""
    max_error_px: float = 2.0
    """Mean reprojection error above which a model is rejected, px at max_image_size."""
    min_agreeing_share: float = 0.85
    """Share of registered frames that pairs which agree with the model must hold together. A model that is torn, with
    a part of the frames turned against the rest, is held together by pairs that contradict it."""
    max_pair_rotation_deg: float = 5.0
    """A pair agrees where its own relative rotation differs from the model's by no more. Where half of this is the
    median already, the pairs are weak witnesses (narrow baselines, little texture) and a tear is not believed."""
    max_rotation_disagreement_deg: float = 15.0
    """Median difference between the pairs' own rotations and the model's above which the model is rejected."""


@dataclass(frozen=True)
class Outcome:
    """The models of one attempt and what is known of the largest."""

    models: list[colmap.Model]
    report: dict[str, Any]
    objection: str | None
    """Why the largest model cannot be used, or None."""
    database: Path | None = None
    """Where its features and matches are."""

    @property
    def two_motions(self) -> bool:
        """True where a part of the picture moves by itself: further attempts at the same pixels are in vain."""
        return bool(self.report["verdict"].endswith("moves by itself"))

    @property
    def rank(self) -> tuple[bool, int, int]:
        """Usable models first, then many frames, then many points."""
        return self.objection is None, self.report["n_registered"], self.report["n_points"]


def judge(
    models: list[colmap.Model],
    frames: list[Frame],
    config: CheckConfig,
    max_image_size: int,
    motion: float,
    database: Path,
) -> Outcome:
    """Measure the largest model and say whether it can be a real one.

    Args:
        models: what one attempt found, largest first.
        frames: the frames it was to register.
        max_image_size: longer side, px, at which features were found.
        motion: share of the matched pairs that show two motions.
        database: that the models were made from.
    """
    n, model = len(frames), models[0] if models else None
    registered = len(model.frames) if model else 0
    points = model.n_points if model else 0
    error = model.mean_error_px if model else 0.0
    angle, turn = median_angles_deg(model) if model else (0.0, 0.0)
    needed = max(3, min(config.min_frames, n // 2))
    largest = max(max(frame.width, frame.height) for frame in frames)
    limit = config.max_error_px * max(1.0, largest / max_image_size)
    disagreement, agreeing = rotation_check(model, database, config) if model else (0.0, 1.0)
    objection = None
    if motion > config.max_second_motion:
        objection = f"in {motion:.0%} of the pairs of frames a part of the picture moves by itself"
    elif registered < max(needed, config.min_share * n):
        objection = f"{'only ' if registered else 'nothing registers: '}{registered} of {n} frames" + (
            " register" if registered else ""
        )
    elif points < config.min_points:
        objection = f"only {points} points were triangulated from {registered} frames: the camera hardly moves"
    elif angle < max(config.min_angle_deg, config.min_parallax * turn):
        objection = f"the camera hardly moves: it turns by {turn:.1f} degrees, and rays meet at only {angle:.1f}"
    elif error > limit:
        objection = f"the mean reprojection error is {error:.1f} px, more than {limit:.1f}"
    elif disagreement > config.max_rotation_disagreement_deg:
        objection = f"pairs of frames contradict the cameras' rotations by {disagreement:.0f} degrees (median)"
    elif agreeing < config.min_agreeing_share and disagreement < config.max_pair_rotation_deg / 2:
        objection = f"pairs of frames contradict the cameras' rotations: {agreeing:.0%} of the frames agree"
    report = {
        "n_frames": n,
        "n_registered": registered,
        "registered_share": round(registered / n, 4),
        "n_points": points,
        "mean_error_px": round(error, 3),
        "median_angle_deg": round(angle, 2),
        "median_turn_deg": round(turn, 2),
        "rotation_disagreement_deg": round(disagreement, 3),
        "agreeing_share": round(agreeing, 4),
        "second_motion": round(motion, 4),
        "verdict": objection or "sensible",
        "models": [len(other.frames) for other in models],
    }
    return Outcome(models, report, objection, database)


def rotation_check(model: colmap.Model, database: Path, config: CheckConfig) -> tuple[float, float]:
    """Do the pairs' own rotations agree with the model's?

    Two views are enough for a rotation, so each verified pair is a witness, if a weak one: repeated texture and planes
    give wrong rotations in good models too. Hence not the worst pair counts but what holds the frames together.

    Returns:
        The median difference in degrees, and the share of the frames in the largest group that pairs hold together
        which agree with the model, of those that any pairs hold together. 0 and 1 where there are no pairs.
    """
    pairs = colmap.pair_poses(database, model, min_matches=PAIR_MATCHES, most=MAX_PAIRS)
    if not pairs:
        return 0.0, 1.0
    apart = rotation_angle_deg(np.stack([pair.by_matches @ pair.by_model.T for pair in pairs]))
    number = {name: i for i, name in enumerate(sorted({name for p in pairs for name in (p.first, p.second)}))}
    every = [(number[pair.first], number[pair.second]) for pair in pairs]
    agree = [edge for edge, angle in zip(every, apart, strict=True) if angle <= config.max_pair_rotation_deg]
    groups = [largest_component(len(number), edges) for edges in (agree, every)]
    return float(np.median(apart)), groups[0] / groups[1]


def median_angles_deg(model: colmap.Model) -> tuple[float, float]:
    """Medians over the points: the largest angle between two rays to a point, and between two cameras that see it.

    The second is that of the viewing directions. Where a camera moves around what it looks at, the two are alike;
    where it only turns, the rays stay together. Degrees, 0 without points.
    """
    points, cameras = model.points(), model.cameras()
    if not len(points):
        return 0.0, 0.0
    number = {frame: i for i, frame in enumerate(cameras)}
    view = np.array([number[frame] for frame in points.frame.tolist()])
    rays = np.stack([camera.centre for camera in cameras.values()])[view] - points.xyz[points.point_index]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    directions = np.stack([camera.direction for camera in cameras.values()])[view]
    at_point, of_cameras = (largest_angles_deg(x, points.point_index, len(points)) for x in (rays, directions))
    return float(np.median(at_point)), float(np.median(of_cameras))


def largest_angles_deg(rays: Floats, group: NDArray[np.integer], n: int) -> Floats:
    """Largest angle between two unit vectors of the same group, for groups sorted and numbered 0 .. n - 1."""
    lengths = np.bincount(group, minlength=n)
    largest = np.zeros(n)
    for shift in range(1, int(lengths.max(initial=0))):
        first = np.flatnonzero(group[:-shift] == group[shift:])
        # the chord keeps tiny angles that a cosine would lose
        chord = np.linalg.norm(rays[first] - rays[first + shift], axis=1)
        np.maximum.at(largest, group[first], np.degrees(2 * np.arcsin(np.minimum(chord / 2, 1))))
    return largest


def split_warning(models: list[colmap.Model]) -> list[str]:
    """Other models that hold frames of their own: two objects in one folder, or a gap in the capture."""
    sizes, known = [len(models[0].frames)], set(models[0].frames)
    for model in models[1:]:
        own = set(model.frames) - known
        if len(own) >= 3:
            sizes.append(len(model.frames))
            known |= own
    if len(sizes) == 1:
        return []
    listed = f"{', '.join(map(str, sizes[:-1]))} and {sizes[-1]}"
    return [f"frames form {len(sizes)} separate models of {listed} frames; the largest is kept"]
