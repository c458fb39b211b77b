"""The unit of imported depth: that of the cameras, or found by comparing depth with the sparse points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.geometry import Floats

SAME_UNIT = 0.01  # a fitted scale this near to what the file says means that the file says it
FLAG = "--set depth.imported"


@dataclass(frozen=True)
class ImportConfig:
    """How depth maps made by other tools are read."""

    kind: Literal["z", "ray"] = "z"
    """z: depth along the optical axis; ray: distance from the camera's centre. Disparity is neither."""
    scale: float | None = None
    """Length of 1 in the files, in the unit of the cameras; null: 1 or (integers) 0.001 where that fits, or fitted."""
    unit: Literal["auto", "cameras", "unknown"] = "auto"
    """cameras: the files are in the unit of the cameras that were given; unknown: the scale is fitted to the sparse
    points; auto: the cameras' unit where the sparse points say so too, else fitted."""
    fit: Literal["sequence", "frame"] = "sequence"
    """One fitted scale for all frames, or one for each (depth that was predicted frame by frame)."""
    min_points: int = 20
    """Sparse points with depth that a fit needs."""
    max_spread: float = 0.1
    """Relative spread of the ratios between sparse points and depth beyond which no scale fits."""
    check: bool = True
    """Remove depth that other views look through (`depth.agreement` says when)."""


@dataclass(frozen=True)
class Scale:
    """What imported depth is multiplied with to be in the sequence's unit.

    Attributes:
        factors: (F,) one a frame; NaN where it could not be found.
        method: "cameras" or "fitted".
        spread: relative spread (1.4826 MAD) of the ratios of sparse points to depth, after scaling; None: no points.
        n_points: ratios compared.
    """

    factors: Floats
    method: Literal["cameras", "fitted"]
    spread: float | None
    n_points: int


def find_scale(ratios: list[Floats], said: list[float], unit: str, config: ImportConfig) -> Scale:
    """The scale of a sequence's depth maps.

    Args:
        ratios: for each frame, (M,) z-depth of sparse points (sequence's unit) over imported depth.
        said: factors that the files and the settings may mean, in the sequence's unit; the first is taken where
            `unit` is "cameras".
        unit: "cameras", "unknown" or "auto".

    Raises:
        BadInput: nothing to fit with, no scale fits, or depth that is said to be in the cameras' unit is not.
    """
    everything = np.log(np.concatenate(ratios)) if ratios else np.zeros(0)
    median, spread = _median_and_spread(everything)
    known = len(everything) >= config.min_points
    n = len(everything)
    if unit == "cameras":
        off = float(np.exp(median) / said[0])
        if known and spread <= config.max_spread and abs(off - 1) > 0.05 + 2 * spread:
            raise BadInput(
                f"depth is not in the unit of the cameras: sparse points are {off:.4g} times as far "
                f"(spread {spread:.1%}, {n} points)",
                remedy=f"Use `{FLAG}.unit=unknown`, or set {FLAG[6:]}.scale",
            )
        return Scale(np.full(len(ratios), said[0]), "cameras", spread if n else None, n)
    if not known:
        raise BadInput(
            f"{n} sparse points have depth, the scale needs {config.min_points}",
            remedy=f"If it is in the unit of the given cameras, use `{FLAG}.unit=cameras`",
        )
    if config.fit == "frame":
        return _fit_frames(ratios, config)
    if spread > config.max_spread:
        within = [_median_and_spread(np.log(r))[1] for r in ratios if len(r) >= config.min_points]
        typical = float(np.median(within)) if within else np.inf
        better = typical <= config.max_spread
        remedy = f"Use `{FLAG}.fit=frame`: within a frame it is {typical:.1%}" if better else _CHECK
        raise BadInput(f"no scale fits the sparse points: spread {spread:.1%} over {n} points", remedy=remedy)
    if unit == "auto":
        for factor in said:
            if abs(np.exp(median) / factor - 1) <= SAME_UNIT:
                return Scale(np.full(len(ratios), factor), "cameras", spread, n)
    return Scale(np.full(len(ratios), np.exp(median)), "fitted", spread, n)


_CHECK = (
    f"Check that the depth maps belong to these photos and are depth, not disparity; `{FLAG}.kind=ray` for distance"
)


def _fit_frames(ratios: list[Floats], config: ImportConfig) -> Scale:
    """A scale for each frame that has enough points and agrees with them; NaN for the others."""
    factors = np.full(len(ratios), np.nan)
    spreads = []
    for i, ratio in enumerate(ratios):
        median, spread = _median_and_spread(np.log(ratio))
        if len(ratio) >= config.min_points:
            spreads.append(spread)
            factors[i] = np.exp(median) if spread <= config.max_spread else np.nan
    if not np.isfinite(factors).any():
        found = f"spread {min(spreads):.1%} at best" if spreads else f"fewer than {config.min_points} points in each"
        raise BadInput(f"in no frame a scale fits the sparse points: {found}", remedy=_CHECK)
    return Scale(factors, "fitted", float(np.median(spreads)), sum(map(len, ratios)))


def _median_and_spread(values: NDArray[np.floating]) -> tuple[float, float]:
    """Median and 1.4826 times the median absolute deviation (a standard deviation, where values are normal)."""
    if not len(values):
        return 0.0, 0.0
    median = float(np.median(values))
    return median, float(1.4826 * np.median(np.abs(values - median)))
