"""The paper's tables from result rows: a line a method, a column a (ways, shots), means over the table's splits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from dope.lowshot.results import ResultRow
from dope.results import paper
from dope.results.one_protocol import check_no_duplicates, check_one_protocol
from dope.results.rows import Line, column_name, columns_of, lines_of
from dope.results.sources import FoundRow

PaperChoice = Literal["methods", "all", "none"]


@dataclass(frozen=True)
class Cell:
    """Accuracy and half its 95% confidence interval (None: not known, as in the paper's figures), both in %.

    Attributes:
        splits: the table's splits behind it; empty without a table.
        missing: whether there are fewer of them than the table has.
        best: the best of its column, and its interval overlaps that of no other line.
    """

    accuracy: float
    ci95: float | None = None
    splits: tuple[int, ...] = ()
    missing: bool = False
    best: bool = False


@dataclass(frozen=True)
class TableLine:
    """A line: its label, the classifier in words ("" where it is said in the caption), a cell a column or None."""

    label: str
    classifier: str
    cells: tuple[Cell | None, ...]


@dataclass(frozen=True)
class Block:
    """Lines under one title ("" for what was measured here)."""

    title: str
    lines: tuple[TableLine, ...]


@dataclass(frozen=True)
class ResultsTable:
    """What the writers (`formats.py`) need.

    Attributes:
        title: what was recognised.
        columns: e.g. ("5w1s", "5w5s").
        blocks: what was measured, then the paper's.
        caption: sentences: what all lines share, and how to read the table.
        n_splits: splits of the table.
        with_classifier: whether lines have different classifiers, which then are a column.
    """

    title: str
    columns: tuple[str, ...]
    blocks: tuple[Block, ...]
    caption: tuple[str, ...]
    n_splits: int
    with_classifier: bool


def build_table(
    found: Sequence[FoundRow], *, labels: Mapping[str, str] | None = None, beside: PaperChoice = "methods"
) -> ResultsTable:
    """The table of rows of one protocol.

    A cell is the mean of the accuracies and the mean of the confidence intervals over the table's splits, as in the
    paper (section 4).

    Args:
        found: at least one row.
        labels: run's name, folder or method -> label.
        beside: of the paper's figures for a table that it has: "methods", "all" (its ablations, too) or "none".

    Raises:
        UsageError: rows of two protocols, duplicates, labels for runs that are not there.
    """
    check_no_duplicates(found)
    check_one_protocol(found)
    columns = columns_of(found)
    table = found[0].row.table
    n_splits = paper.SPLITS if paper.is_known(table) else len({item.row.table_split for item in found})
    lines = lines_of(found, labels or {})
    classifiers = {line.classifier for line in lines}
    with_classifier = len(classifiers) > 1
    measured = _mark_best([_table_line(line, columns, n_splits, with_classifier) for line in lines])
    names = tuple(column_name(*column) for column in columns)
    chance = TableLine("chance", "", tuple(Cell(100 / ways) for ways, _ in columns))
    blocks = [Block("", (*measured, chance)), *_paper_blocks(table, names, beside)]
    caption = [_what_all_share(found), *_reading(measured, n_splits, table)]
    if not with_classifier and (name := next(iter(classifiers))):
        caption.append(f"Classifier: {name}.")
    caption += _choice(lines)
    if len(blocks) > 1:
        caption.append(f"In the paper ({paper.source()}): its own runs, not ours; - ABC: trained on ABC.")
    return ResultsTable(_title(found), names, tuple(blocks), tuple(caption), n_splits, with_classifier)


def _table_line(line: Line, columns: Sequence[tuple[int, int]], n_splits: int, with_classifier: bool) -> TableLine:
    cells = []
    for column in columns:
        rows = [item.row for item in line.found if (item.row.ways, item.row.shots) == column]
        cells.append(_mean(rows, n_splits) if rows else None)
    return TableLine(line.label, line.classifier if with_classifier else "", tuple(cells))


def _mean(rows: Sequence[ResultRow], n_splits: int) -> Cell:
    splits = tuple(sorted(row.table_split for row in rows if row.table))
    accuracy = math.fsum(row.accuracy for row in rows) / len(rows)
    ci95 = math.fsum(row.ci95 for row in rows) / len(rows)
    return Cell(100 * accuracy, 100 * ci95, splits, missing=bool(splits) and len(splits) < n_splits)


def _mark_best(lines: Sequence[TableLine]) -> list[TableLine]:
    """Mark a column's best cell where no other interval reaches its own; cells of fewer splits do not take part."""
    marked = [list(line.cells) for line in lines]
    for column in range(len(lines[0].cells)):
        cells = [(i, cell) for i, line in enumerate(lines) if (cell := line.cells[column]) is not None]
        most = max((cell.splits for _, cell in cells), key=len, default=())
        cells = [(i, cell) for i, cell in cells if cell.splits == most]
        if len(cells) < 2:
            continue
        i, best = max(cells, key=lambda pair: pair[1].accuracy)
        lower = best.accuracy - (best.ci95 or 0)
        if all(cell.accuracy + (cell.ci95 or 0) < lower for j, cell in cells if j != i):
            marked[i][column] = replace(best, best=True)
    return [replace(line, cells=tuple(cells)) for line, cells in zip(lines, marked, strict=True)]


def _paper_blocks(table: str, columns: Sequence[str], beside: PaperChoice) -> list[Block]:
    if beside == "none":
        return []
    groups = [("in the paper", paper.paper_rows(table))]
    if beside == "all":
        groups += [(f"in the paper: {title}", rows) for title, rows in paper.paper_ablations(table)]
    blocks = []
    for title, rows in groups:
        lines = [
            TableLine(row.label, "", tuple(Cell(row.accuracy[c]) if c in row.accuracy else None for c in columns))
            for row in rows
            if any(column in row.accuracy for column in columns)
        ]
        if lines:
            blocks.append(Block(title, tuple(lines)))
    return blocks


def _title(found: Sequence[FoundRow]) -> str:
    row = found[0].row
    part = {"test": "test classes", "val": "validation classes"}.get(row.part, "")
    of = "categories" if row.classes == "category" else "single objects"
    name = paper.table_title(row.table) if row.table else f"Low-shot recognition of {of}"
    return f"{name}, {part}" if part else name


def _what_all_share(found: Sequence[FoundRow]) -> str:
    """The protocol in a sentence."""
    row = found[0].row
    queries = sorted({item.row.queries for item in found})
    asked = f"{queries[-1]} queries a class"
    if len(queries) > 1:
        asked += f" (as few as {queries[0]} where there are not enough objects)"
    said = [f"{row.episodes:,} episodes a setting (seed {row.seed})", asked]
    if any(item.row.shots > 1 for item in found):
        said.append("shots of several objects" if row.shot_mode == "several_instances" else "shots of one object")
    if row.classes == "instance":
        said.append("the classes are single objects")
    counts = {(item.row.n_classes, item.row.n_objects, item.row.n_views) for item in found}
    if len(counts) == 1:
        of = "categories" if row.classes == "category" else "objects"
        objects = f", {row.n_objects:,} objects" if row.classes == "category" else ""
        said.append(f"{row.n_classes} {of}{objects}, {row.n_views:,} views")
    said.append({"all": "all views of the shards"}.get(row.split, f"{row.split} views of the shards"))
    said.append(f"dataset {row.dataset}")
    fitted = sorted({item.row.protocol for item in found if item.row.ways < item.row.asked_ways})
    if fitted:
        said.append(f"fewer ways than asked for in {', '.join(fitted)}")
    return "Accuracy in % ± 95% confidence interval: " + ", ".join(said) + "."


def _choice(lines: Sequence[Line]) -> list[str]:
    """Which lines are of checkpoints that validation classes chose."""
    chosen = [line.label for line in lines if line.chosen]
    of = "" if len(chosen) == len(lines) else f" (of {', '.join(chosen)} alone)"
    return [f"Checkpoints that the validation classes of each split chose{of}."] if chosen else []


def _reading(lines: Sequence[TableLine], n_splits: int, table: str) -> list[str]:
    """How to read the cells."""
    cells = [cell for line in lines for cell in line.cells if cell is not None]
    sentences = []
    if table:
        name = paper.table_title(table)
        if n_splits > 1:
            sentences.append(f"Cells are means over the {n_splits} splits of {name}, of accuracies and of intervals.")
        for n in sorted({len(cell.splits) for cell in cells if cell.missing}):
            sentences.append(f"({n}/{n_splits}): {n} of {n_splits} splits only.")
    if len(lines) > 1:
        # "{best}" is what a format marks the best by
        if any(cell.best for cell in cells):
            among = " of the lines with most splits" if any(cell.missing for cell in cells) else ""
            sentences.append(f"{{best}}: the best of its column{among}, where its interval overlaps no other's.")
        else:
            sentences.append("No best is marked: in no column is one line's interval clear of all others.")
    return sentences
