"""Accuracy against training: a curve a run, a panel a (ways, shots), with the 95% confidence intervals as bands."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dope.common import files
from dope.common.errors import DopeError, UsageError
from dope.lowshot.results import ResultRow
from dope.results import paper
from dope.results.one_protocol import check_no_duplicates, check_one_protocol
from dope.results.rows import Line, columns_of, lines_of
from dope.results.sources import FoundRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours, told apart by colour-blind readers; without yellow, which is too light for lines
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
DASHES = ("-", "--", "-.", ":")
SUFFIXES = (".png", ".pdf", ".svg")


@dataclass(frozen=True)
class Curve:
    """A run's points in one panel: (step, accuracy %, interval %, splits behind it), by rising step.

    A network without steps (an encoder, random weights), or with one that was chosen for every split, has one point of
    step None: a level.
    """

    label: str
    points: tuple[tuple[int | None, float, float, int], ...]


def curves_of(found: Sequence[FoundRow], labels: Mapping[str, str] | None = None) -> dict[tuple[int, int], list[Curve]]:
    """(ways, shots) -> the curves of all runs, means over the table's splits where there are some.

    Raises:
        UsageError: rows of two protocols, duplicates, no row of a checkpoint (other than chosen ones), or steps of one
            curve that were measured on different splits.
    """
    check_no_duplicates(found)
    check_one_protocol(found)
    if all(_is_level(item.row) for item in found):
        what = "no row is of a checkpoint, so that there is no training to plot against"
        remedy = "`dope eval RUN/checkpoints/step-XXXXXXXX.pt SHARDS` adds a row"
        if any(item.row.chosen_by for item in found):
            what = "these checkpoints were chosen for each split, so that there is no training to plot against"
            remedy = f"--part val has all checkpoints; {remedy}"
        raise UsageError(what, where="--plot", remedy=remedy)
    lines = lines_of(found, labels or {}, by_step=False)
    return {column: [curve for line in lines if (curve := _curve(line, column)).points] for column in columns_of(found)}


def plot_curves(found: Sequence[FoundRow], path: Path, labels: Mapping[str, str] | None = None) -> Path:
    """Draw accuracy against training step into a .png, .pdf or .svg; returns the path.

    Raises:
        UsageError: as `curves_of`; another suffix.
        DopeError: matplotlib is missing.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"plots are {', '.join(SUFFIXES)}", where=f"--plot {path}")
    curves = curves_of(found, labels)
    figure_class = _matplotlib()
    names = list(dict.fromkeys(curve.label for panel in curves.values() for curve in panel))
    columns = min(2, len(curves))
    rows = math.ceil(len(curves) / columns)
    legend_rows = math.ceil((len(names) + 1) / 2)
    figure = figure_class(figsize=(1.2 + 5.2 * columns, 0.9 + 3.5 * rows + 0.25 * legend_rows), dpi=150)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    handles: dict[str, Any] = {}
    for axis, ((ways, shots), panel) in zip(axes, curves.items(), strict=False):
        for curve in panel:
            handles.setdefault(curve.label, _draw(axis, curve, names.index(curve.label)))
        handles["chance"] = axis.axhline(100 / ways, color="0.35", linestyle=(0, (1, 2)), linewidth=1.2)
        axis.set_title(f"{ways}-way {shots}-shot", fontsize=11)
        _frame(axis)
    for axis in axes[len(curves) :]:
        axis.set_visible(False)
    for i in range(len(curves)):
        if i + columns >= len(curves):
            axes[i].set_xlabel("training step")
            axes[i].tick_params(labelbottom=True)
        if i % columns == 0:
            axes[i].set_ylabel("accuracy, %")
    order = [*names, "chance"]
    figure.suptitle(_title(found, [curve for panel in curves.values() for curve in panel]), fontsize=12)
    figure.tight_layout(rect=(0, 0.24 * legend_rows / figure.get_figheight(), 1, 1))
    figure.legend(
        [handles[name] for name in order], order, loc="lower center", ncols=2, frameon=False, fontsize=9, handlelength=3
    )
    with files.atomic_path(path) as partial:
        figure.savefig(partial)
    return path


def _curve(line: Line, column: tuple[int, int]) -> Curve:
    by_step: dict[int | None, list[FoundRow]] = defaultdict(list)
    for item in line.found:
        if (item.row.ways, item.row.shots) == column:
            by_step[None if _is_level(item.row) else item.row.step].append(item)
    _check_splits(line.label, by_step)
    points = []
    for step in sorted(by_step, key=lambda step: -1 if step is None else step):
        rows = [item.row for item in by_step[step]]
        if len({row.table_split for row in rows}) < len(rows):
            what = f"'{line.label}' has two measurements of {rows[0].protocol} at step {step}"
            raise UsageError(what, remedy="Give the runs labels of their own by --label")
        accuracy, ci95 = (math.fsum(getattr(row, name) for row in rows) / len(rows) for name in ("accuracy", "ci95"))
        points.append((step, 100 * accuracy, 100 * ci95, len(rows)))
    return Curve(line.label, tuple(points))


def _is_level(row: ResultRow) -> bool:
    return row.step is None or bool(row.chosen_by)


def _check_splits(label: str, by_step: Mapping[int | None, Sequence[FoundRow]]) -> None:
    """Refuse a curve that would rise and fall with the classes that its points were measured on."""
    splits = {step: sorted({item.row.table_split for item in found}) for step, found in by_step.items()}
    (one, first), *others = splits.items() if splits else [(None, [])]
    for other, there in others:
        if there != first:
            told = (f"{', '.join(map(str, n))} at step {step}" for step, n in ((one, first), (other, there)))
            what = f"'{label}' was measured on splits {' and '.join(told)}, whose means are no curve"
            raise UsageError(what, where="--plot", remedy="Choose one by --only table_split=N, or evaluate the others")


def _draw(axis: Axes, curve: Curve, number: int) -> Any:
    colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
    # more runs than colours: the same colours, dashed
    style: dict[str, Any] = {"color": colour, "linestyle": DASHES[number // len(COLOURS) % len(DASHES)]}
    steps = [point for point in curve.points if point[0] is not None]
    if not steps:
        _, accuracy, ci95, _ = curve.points[0]
        axis.axhspan(accuracy - ci95, accuracy + ci95, color=colour, alpha=0.15, linewidth=0)
        return axis.axhline(accuracy, linewidth=1.6, **{**style, "linestyle": (0, (6, 2))})
    x = [float(point[0] or 0) for point in steps]
    y = [point[1] for point in steps]
    low, high = ([point[1] + sign * point[2] for point in steps] for sign in (-1, 1))
    if len(steps) == 1:  # a band of one point would not be seen
        axis.errorbar(x, y, yerr=[point[2] for point in steps], color=colour, capsize=4, linewidth=1.4)
    axis.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
    return axis.plot(x, y, marker=marker, markersize=5, linewidth=1.8, **style)[0]


def _frame(axis: Axes) -> None:
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axis.xaxis.set_major_locator(MaxNLocator(nbins=7, integer=True))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda step, _: f"{step:,.0f}"))
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(axis="y", color="0.88", linewidth=0.8)
    axis.set_axisbelow(True)


def _title(found: Sequence[FoundRow], curves: Iterable[Curve]) -> str:
    row = found[0].row
    part = {"test": ", test classes", "val": ", validation classes"}.get(row.part, "")
    behind = sorted({n for curve in curves for _, _, _, n in curve.points})
    number = str(behind[0]) if len(behind) == 1 else f"{behind[0]} to {behind[-1]}"
    of = f", means of {number} splits" if row.table and behind[-1] > 1 else ""
    name = paper.table_title(row.table) if row.table else "Low-shot recognition"
    return f"{name}{part}{of}; bands: 95% intervals"


def _matplotlib() -> Any:
    """matplotlib's Figure, which needs no display and leaves pyplot's global state alone."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        remedy = "pip install 'dope-descriptors[plot]'"
        raise DopeError("matplotlib is needed to draw curves", where="--plot", remedy=remedy) from error
    return Figure
