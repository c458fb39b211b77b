"""The status table as text: a line a sequence, however long, and a summary with the most frequent reasons."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import pyarrow as pa
from rich.cells import cell_len

from pipeline.report.status_row import SCHEMA, STATUSES

COLOURS = {"ok": "32", "waiting": "2", "running": "36", "empty": "33", "failed": "31"}
SLICE = 5000
NUMBER = re.compile(r"\d+(\.\d+)?")
SHARES = frozenset({"registered_share", "depth_coverage", "depth_mask_coverage", "depth_within_2", "mask_share"})

Row = dict[str, Any]


def _of(part: str, whole: str) -> Callable[[Row], str]:
    return lambda row: "" if row[part] is None else f"{row[part]}/{'?' if row[whole] is None else row[whole]}"


def _shown(name: str, pattern: str) -> Callable[[Row], str]:
    return lambda row: "" if row[name] is None else pattern.format(row[name])


def _what(row: Row) -> str:
    if row["reason"]:
        return str(row["reason"])
    parts = [f"next: {row['next']}"] if row["next"] else []
    parts += ["also in another WORK"] if row["duplicate"] else []
    return "; ".join([*parts, *([row["warning_texts"]] if row["warning_texts"] else [])])


DEFAULT: dict[str, Callable[[Row], str]] = {
    "sequence": lambda row: row["id"] or "",
    "category": lambda row: row["category"] or "",
    "status": lambda row: row["status"] or "",
    "stage": lambda row: row["stage"] or "",
    "registered": _of("registered", "kept"),
    "px": _shown("error_px", "{:.2f}"),
    "depth": _shown("depth_coverage", "{:.0%}"),
    "off by": _shown("depth_error", "{:.2%}"),
    "masks": _of("masks", "kept"),
    "views": _shown("views", "{}"),
    "pairs": _shown("pairs", "{}"),
    "corr.": _shown("correspondences", "{:.0f}"),
    "cpu s": _shown("cpu_seconds", "{:.1f}"),
    "what": _what,
}
"""The columns of the table unless --columns says otherwise: heading, and how a row fills it."""

LEFT = frozenset({"sequence", "category", "status", "stage", "what"})


def lines_of(table: pa.Table, columns: list[str] | None = None, *, colour: bool = False) -> Iterator[str]:
    """The table's lines, headings first; columns are as wide as what they hold, and nothing is cut off."""
    fill = DEFAULT if columns is None else {name: _plain(name) for name in columns}
    left = LEFT if columns is None else {n for n in columns if pa.types.is_string(SCHEMA.field(n).type)}
    cells: dict[str, list[str]] = {name: [] for name in fill}
    for start in range(0, len(table), SLICE):
        for row in table.slice(start, SLICE).to_pylist():
            for name, value in fill.items():
                cells[name].append(printable(value(row)))
    shown = [name for name in fill if columns is not None or name in ("sequence", "status") or any(cells[name])]
    padded = [_padded([name, *cells[name]], name in left) for name in shown]
    status = shown.index("status") if colour and "status" in shown else None
    for number, line in enumerate(zip(*padded, strict=True)):
        parts = list(line)
        if status is not None and number:
            parts[status] = f"\x1b[{COLOURS.get(parts[status].strip(), '0')}m{parts[status]}\x1b[0m"
        yield "  ".join(parts).rstrip()


def summary(table: pa.Table, top: int = 5) -> list[str]:
    """How many sequences have which status, and the most frequent reasons of those that failed or are empty."""
    statuses = Counter(table["status"].to_pylist())
    counts = ", ".join(f"{statuses[name]:,} {name}" for name in STATUSES if statuses[name])
    lines = [f"{len(table):,} sequence{'' if len(table) == 1 else 's'}{': ' if counts else ''}{counts}"]
    duplicates = Counter(table["duplicate"].to_pylist())[True]
    if duplicates:
        lines.append(f"{duplicates:,} rows share their id with another row (--where duplicate=true)")
    for (stage, reason), count in reasons(table).most_common(top):
        lines.append(f"  {count:,} x {stage}: {printable(reason)}")
    return lines


def reasons(table: pa.Table) -> Counter[tuple[str, str]]:
    """(stage, kind of reason) of the rows that failed or are empty, counted."""
    columns = (table[name].to_pylist() for name in ("id", "status", "stage", "reason"))
    return Counter(
        (stage or "", kind_of_reason(reason or "no reason given", name or ""))
        for name, status, stage, reason in zip(*columns, strict=True)
        if status in ("failed", "empty")
    )


def kind_of_reason(reason: str, name: str) -> str:
    """A reason without what is this sequence's own: the path before it, its remedy and its numbers."""
    head, separator, rest = reason.partition(": ")
    if separator and ("/" in head or head == name):
        reason = rest
    return NUMBER.sub("N", reason.partition(". ")[0])


def printable(text: str) -> str:
    """Text that stays on its line and sends nothing to the terminal but letters."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _plain(name: str) -> Callable[[Row], str]:
    def value(row: Row) -> str:
        found = row[name]
        if found is None:
            return ""
        return f"{found:.4g}" if isinstance(found, float) and abs(found) < 1e4 else str(found)

    return value


def _padded(texts: list[str], left: bool) -> list[str]:
    widths = [len(text) if text.isascii() else cell_len(text) for text in texts]
    widest = max(widths)
    gaps = (" " * (widest - width) for width in widths)
    return [text + gap if left else gap + text for text, gap in zip(texts, gaps, strict=True)]
