"""Histograms as inline SVG, a small picture each: bars, the median, three numbers on the axis."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

BINS = 24
WIDTH, HEIGHT, BASE = 240, 84, 68
TAIL = 0.99
"""Values beyond this quantile are counted in the last bar where they would stretch the axis."""


@dataclass(frozen=True)
class Plot:
    """One histogram: the column of the status table, its title, how a value is written, and a fixed range if any."""

    column: str
    title: str
    form: str
    whole: tuple[float, float] | None = None
    """The range of what is a share; it is narrowed where all values lie at its end."""


PLOTS = (
    Plot("registered_share", "Registered share of the frames", "{:.0%}", (0.0, 1.0)),
    Plot("error_px", "Mean reprojection error", "{:.2f} px"),
    Plot("ray_angle_deg", "Angle between rays", "{:.0f}°"),
    Plot("depth_coverage", "Depth coverage of the pixels", "{:.0%}", (0.0, 1.0)),
    Plot("depth_error", "Depth off the sparse points", "{:.2%}"),
    Plot("mask_share", "Object's share of the pixels", "{:.0%}", (0.0, 1.0)),
    Plot("pairs", "Pairs of a sequence", "{:,.0f}"),
    Plot("pair_angle_deg", "Angle between the views of a pair", "{:.0f}°"),
    Plot("correspondences", "Correspondences of a pair", "{:,.0f}"),
    Plot("cpu_seconds", "CPU seconds of a sequence", "{:,.0f} s"),
)


def histogram(plot: Plot, values: NDArray[np.float64]) -> str:
    """An HTML <figure> of a histogram of `values` (N,), finite; empty where there are none."""
    if not len(values):
        return ""
    low, high = _range(plot, values)
    edges = np.linspace(low, high, BINS + 1)
    counts, _ = np.histogram(np.clip(values, low, high), edges)
    median = float(np.median(values))
    step, tallest = WIDTH / BINS, max(1, int(counts.max()))
    bars = []
    for i, count in enumerate(counts.tolist()):
        if count:
            height = max(1.5, (BASE - 6) * count / tallest)
            open_end = i == BINS - 1 and values.max() > high
            ends = plot.form.format(edges[i]), "more" if open_end else plot.form.format(edges[i + 1])
            title = escape(f"{ends[0]} to {ends[1]}: {count:,}")
            bars.append(
                f'<rect x="{i * step + 0.6:.2f}" y="{BASE - height:.2f}" width="{step - 1.2:.2f}" height="{height:.2f}"'
                f' rx="1"><title>{title}</title></rect>'
            )
    place = WIDTH * (min(max(median, low), high) - low) / (high - low)
    shown = plot.form.format(median)
    label = f"{plot.title}: median {shown}, from {plot.form.format(values.min())} to {plot.form.format(values.max())}"
    axis = "".join(
        f'<text x="{x}" y="{HEIGHT - 2}" text-anchor="{anchor}">{escape(plot.form.format(value))}</text>'
        for x, anchor, value in ((0, "start", low), (WIDTH / 2, "middle", (low + high) / 2), (WIDTH, "end", high))
    )
    return (
        f'<figure class="plot"><figcaption>{escape(plot.title)} <b title="median">{escape(shown)}</b></figcaption>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(label)}">{"".join(bars)}'
        f'<line class="base" x1="0" x2="{WIDTH}" y1="{BASE}" y2="{BASE}"/>'
        f'<line class="median" x1="{place:.2f}" x2="{place:.2f}" y1="2" y2="{BASE}"/>{axis}</svg></figure>'
    )


def _range(plot: Plot, values: NDArray[np.float64]) -> tuple[float, float]:
    """The axis: round numbers around the bulk of the values."""
    smallest, largest = float(values.min()), float(values.max())
    bulk = float(np.quantile(values, TAIL))
    if largest > 2 * bulk > 0:
        largest = bulk
    if plot.whole is not None:
        low = plot.whole[0] if smallest < 0.5 else 0.5 if smallest < 0.8 else 0.8
        return low, plot.whole[1]
    step = _round_step((largest - min(smallest, 0.0)) / 4 or 1.0)
    low = 0.0 if smallest < largest / 2 else math.floor(smallest / step) * step
    return low, max(low + 2 * step, math.ceil(largest / (2 * step)) * 2 * step)


def _round_step(width: float) -> float:
    """The next of 1, 2, 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(width)) if width > 0 else 1.0
    return power * next(factor for factor in (1, 2, 5, 10) if factor * power >= width * 0.999)


def finite(values: Any) -> NDArray[np.float64]:
    """The known values of an Arrow column."""
    return np.array([v for v in values.to_pylist() if v is not None and math.isfinite(v)], dtype=np.float64)
