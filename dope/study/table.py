"""A study's table: a line a variant, a column a setting; means over seeds, with how much the seeds differ."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

from dope.common import files
from dope.results.one_protocol import check_one_protocol
from dope.results.rows import column_name, columns_of
from dope.results.sources import FoundRow, find_rows
from dope.study.run import Piece, also_folder


def study_table(pieces: Sequence[Piece], out: Path, also: str | None = None) -> str:
    """The table of runs that were evaluated by one protocol, in Markdown; also written to OUT/table.md.

    Of `also` (`StudyConfig.also`) the results on those shards instead, written to OUT/table-NAME.md. Rows of validation
    classes, which `dope eval --select` leaves, are no part of it.

    A cell is the mean accuracy in % over a table's splits and over seeds, the mean half width of the 95% confidence
    interval over episodes and, of several seeds, the standard deviation between them (in brackets).

    Raises:
        UsageError: the rows are of several protocols.
        BadInput: a run has no rows.
    """
    found = {piece: _test_rows(piece.run if also is None else piece.run / also_folder(also)) for piece in pieces}
    rows = [row for rows in found.values() for row in rows]
    check_one_protocol(rows)
    columns = columns_of(rows)
    variants = list(dict.fromkeys(piece.variant for piece in pieces))
    seeds = len({piece.seed for piece in pieces})
    lines = [
        ["", "classifier", *(column_name(*column) for column in columns)],
        ["---", "---", *["---:"] * len(columns)],
    ]
    for variant in variants:
        runs = [found[piece] for piece in pieces if piece.variant == variant]
        classifiers = sorted({item.row.classifier_in_words for run in runs for item in run})
        cells = [_cell([_of_column(run, column) for run in runs]) for column in columns]
        lines.append([variant.label, ", ".join(classifiers), *cells])
    lines.append(["chance", "", *(f"{100 / ways:.1f}" for ways, _ in columns)])
    row = rows[0].row
    queries = " or ".join(map(str, sorted({item.row.queries for item in rows}, reverse=True)))  # --fit may take fewer
    said = (
        f"Accuracy in % ± half its 95% confidence interval over {row.episodes:,} episodes of {queries} queries a "
        f"class, {row.n_classes} classes, {row.n_objects} objects, {row.n_views:,} views"
    )
    if seeds > 1:
        said += f"; means over {seeds} seeds, whose standard deviation is in brackets"
    text = "".join(f"| {' | '.join(line)} |\n" for line in lines) + f"\n{said}.\n"
    files.write_bytes(out / ("table.md" if also is None else f"table-{also}.md"), text.encode())
    return text


def _test_rows(place: Path) -> list[FoundRow]:
    found = find_rows([place])
    return [item for item in found if item.row.part != "val"]


def _of_column(run: Sequence[FoundRow], column: tuple[int, int]) -> list[FoundRow]:
    return [item for item in run if (item.row.ways, item.row.shots) == column]


def _cell(runs: Sequence[Sequence[FoundRow]]) -> str:
    """Of the rows of one column, a list a seed."""
    means = [100 * statistics.fmean(item.row.accuracy for item in run) for run in runs if run]
    if not means:
        return ""
    ci95 = 100 * statistics.fmean(item.row.ci95 for run in runs for item in run)
    spread = f" ({statistics.stdev(means):.1f})" if len(means) > 1 else ""
    return f"{statistics.fmean(means):.1f} ± {ci95:.1f}{spread}"
