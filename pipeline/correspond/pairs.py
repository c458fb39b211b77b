"""Which two views of an object make a training pair: spread over angles, and over the views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dope.common import seeds, settings
from pipeline.geometry import Camera

GIVE_UP = 100  # pairs of one range of angle that fail in a row: the views of long videos make thousands of the kind


@dataclass(frozen=True)
class PairsConfig:
    """Which pairs of views are chosen."""

    choose: Literal["auto", "spread", "made"] = "auto"
    """"spread": over ranges of angle, within the limits; "made": views 2k and 2k + 1 of sequences made in pairs, at
    whatever angle; "auto": made where the sequence was, else spread."""
    min_angle_deg: float = 5.0
    """Smallest angle between the two views, seen from the object; below it a pair is the same view twice."""
    max_angle_deg: float = 90.0
    """Largest angle (the paper: 90; video depth rarely carries beyond 60, which the overlap then decides)."""
    max_pairs: int = 64
    """Most pairs of one sequence."""
    angle_bins: int = 6
    """Equal ranges of angle that get the same number of pairs, as far as there are any."""
    min_overlap: float = 0.05
    """Smallest share of view 1's object that is seen in view 2 as well."""
    min_correspondences: int = 32
    """Pairs with fewer correspondences are dropped (the loss samples 32)."""
    seed: int = 0
    """Decides among equally good pairs."""

    def __post_init__(self) -> None:
        settings.require_at_least(self, min_angle_deg=0, max_pairs=1, angle_bins=1, min_correspondences=1)


def view_angles_deg(cameras: list[Camera], target: NDArray[np.floating]) -> NDArray[np.float64]:
    """Angles (n, n) at `target` (3,) between the directions to each two cameras, degrees."""
    rays = np.stack([camera.centre for camera in cameras]) - target
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    sine = np.linalg.norm(np.cross(rays[:, None], rays[None, :]), axis=-1)
    return np.degrees(np.arctan2(sine, rays @ rays.T))  # exact for small angles too, unlike arccos


def candidate_pairs(angles_deg: NDArray[np.floating], config: PairsConfig) -> NDArray[np.intp]:
    """All pairs (P, 2), i < j, whose angle lies in the wanted range."""
    wanted = (angles_deg >= config.min_angle_deg) & (angles_deg <= config.max_angle_deg)
    return np.argwhere(np.triu(wanted, 1))


def select_pairs(
    cameras: list[Camera],
    target: NDArray[np.floating],
    overlap: Callable[[int, int], float] | None,
    config: PairsConfig,
) -> NDArray[np.intp]:
    """Choose pairs of views, the ranges of angle in turn, each time the pair whose views were used least.

    Args:
        cameras: the n views.
        target: (3,) centre of the object.
        overlap: share of the object in view i that view j sees too; asked only of pairs about to be chosen.
        config: ranges, limits and the seed.

    Returns:
        (P, 2) indices i < j, each pair once, in the order in which they were chosen.
    """
    if len(cameras) < 2:
        return np.zeros((0, 2), dtype=np.intp)
    angles = view_angles_deg(cameras, target)
    pairs = candidate_pairs(angles, config)
    pairs = seeds.generator("pairs", config.seed, len(cameras)).permutation(pairs, axis=0)
    edges = np.linspace(config.min_angle_deg, config.max_angle_deg, config.angle_bins + 1)[1:-1]
    bins = np.digitize(angles[pairs[:, 0], pairs[:, 1]], edges)
    waiting = [pairs[bins == b] for b in range(config.angle_bins)]
    failed = [0] * config.angle_bins
    used = np.zeros(len(cameras), dtype=np.int64)
    chosen: list[NDArray[np.intp]] = []
    while any(map(len, waiting)) and len(chosen) < config.max_pairs:
        for b in range(config.angle_bins):
            while len(waiting[b]) and len(chosen) < config.max_pairs:
                uses = np.sort(used[waiting[b]], axis=1)
                best = int(np.argmin(uses[:, 1] * (used.sum() + 1) + uses[:, 0]))  # the busier view decides first
                pair = waiting[b][best]
                waiting[b] = np.delete(waiting[b], best, axis=0)
                if overlap is None or overlap(int(pair[0]), int(pair[1])) >= config.min_overlap:
                    used[pair] += 1
                    chosen.append(pair)
                    failed[b] = 0
                    break
                failed[b] += 1
                if failed[b] >= GIVE_UP:
                    waiting[b] = waiting[b][:0]
    return np.array(chosen, dtype=np.intp).reshape(-1, 2)


def made_pairs(frames: Sequence[int], overlap: Callable[[int, int], float], config: PairsConfig) -> NDArray[np.intp]:
    """The pairs that a sequence was made in, of which both views are there and overlap.

    Args:
        frames: numbers of the n views.
        overlap: as in `select_pairs`.

    Returns:
        (P, 2) indices of views 2k and 2k + 1, at most `max_pairs`.
    """
    place = {frame: index for index, frame in enumerate(frames)}
    there = [(index, place[frame + 1]) for frame, index in place.items() if frame % 2 == 0 and frame + 1 in place]
    chosen = [pair for pair in there if overlap(*pair) >= config.min_overlap]
    return np.array(chosen[: config.max_pairs], dtype=np.intp).reshape(-1, 2)
