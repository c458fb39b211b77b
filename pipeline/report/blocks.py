"""The parts of the page that need no script: figures, failures, the table. Every text is escaped here."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from html import escape
from statistics import median
from typing import Any

from pipeline.report.status_row import STAGES, STATUSES
from pipeline.report.status_text import kind_of_reason

Row = dict[str, Any]

NAMED_AT_ONCE = 3
"""Sequences of a kind of failure that are named without opening the list."""
NAMED = 60
"""Sequences that are named at all; the rest is a click on the filter away."""
WHAT_LENGTH = 220
"""Characters of a reason in the table; its sheet has all of it."""


def outcome(rows: list[Row]) -> str:
    """How many have which status, in words."""
    counts = Counter(row["status"] for row in rows)
    return ", ".join(f"{counts[name]:,} {name}" for name in STATUSES if counts[name]) or "none yet"


def tiles(rows: list[Row]) -> str:
    """The main figures as <div>s of a <dl>."""
    counts = Counter(row["status"] for row in rows)
    parts = [_tile("sequences", f"{len(rows):,}")]
    parts += [_tile(name, f"{counts[name]:,}", name) for name in STATUSES if counts[name] and counts[name] < len(rows)]
    registered, kept = (_known(rows, key) for key in ("registered", "kept"))
    if kept:
        parts.append(_tile("frames kept", f"{sum(kept):,.0f}"))
    if registered:
        parts.append(_tile("with a camera", f"{sum(registered):,.0f}"))
    for key, name, form, unit in (
        ("registered_share", "registered, median", "{:.0%}", ""),
        ("error_px", "reprojection, median", "{:.2f}", "px"),
        ("depth_coverage", "depth coverage, median", "{:.0%}", ""),
        ("depth_error", "depth error, median", "{:.2%}", ""),
    ):
        if values := _known(rows, key):
            parts.append(_tile(name, form.format(median(values)), unit=unit))
    if pairs := _known(rows, "pairs"):
        parts.append(_tile("pairs of views", f"{sum(pairs):,.0f}"))
    if seconds := _known(rows, "cpu_seconds"):
        total = sum(seconds)
        unit, size = ("h", 3600) if total >= 7200 else ("min", 60) if total >= 120 else ("s", 1)
        parts.append(_tile("CPU time", f"{total / size:,.1f}", unit=unit))
    return "".join(parts)


def failures(rows: list[Row]) -> str:
    """What went wrong, the most frequent first: one entry for the reasons that differ only in numbers and paths."""
    groups: dict[tuple[str, str], list[int]] = defaultdict(list)
    for number, row in enumerate(rows):
        if row["status"] in ("failed", "empty"):
            reason = kind_of_reason(row["reason"] or "no reason given", row["id"] or "")
            groups[row["stage"] or "", reason].append(number)
    if not groups:
        done = rows and all(row["status"] == "ok" for row in rows)
        return '<p class="allgood">Nothing failed: every stage of every sequence is done.</p>' if done else ""
    ordered = sorted(groups.items(), key=lambda group: (-len(group[1]), STAGES.index(group[0][0]), group[0][1]))
    items = "\n".join(_reason(rows, stage, reason, members) for (stage, reason), members in ordered)
    count = sum(len(members) for members in groups.values())
    title = f"{count:,} sequence{'s' if count > 1 else ''} failed or came out empty"
    return (
        f'<section aria-labelledby="h-failures"><h2 id="h-failures">{title}</h2>\n'
        f'<ul class="reasons">{items}</ul></section>'
    )


def _reason(rows: list[Row], stage: str, reason: str, members: list[int]) -> str:
    only = len(members) == 1
    what = rows[members[0]]["reason"] or reason if only else reason
    who = [f"<li>{_link(rows, number, with_reason=not only)}</li>" for number in members[:NAMED]]
    if len(members) > NAMED:
        who.append(f"<li>and {len(members) - NAMED:,} more</li>")
    listed = f'<ul class="who">{"".join(who)}</ul>'
    if len(members) > NAMED_AT_ONCE:
        names = ", ".join(_link(rows, number, with_reason=False) for number in members[:NAMED_AT_ONCE])
        listed = f"<details><summary>{names} and {len(members) - NAMED_AT_ONCE:,} more</summary>{listed}</details>"
    return (
        f'<li><span class="n">{len(members):,}</span><p class="what"><span class="stage">{escape(stage)}:</span> '
        f"{escape(what)}</p>{listed}</li>"
    )


def _link(rows: list[Row], number: int, *, with_reason: bool) -> str:
    row = rows[number]
    text = f": {escape(row['reason'] or '')}" if with_reason else ""
    return f'<a href="#s{number}">{escape(row["id"] or "")}</a>{text}'


def _tile(name: str, value: str, kind: str = "", *, unit: str = "") -> str:
    small = f"<small> {unit}</small>" if unit else ""
    return f'<div class="{kind}"><dt>{name}</dt><dd>{value}{small}</dd></div>'


def _known(rows: Iterable[Row], key: str) -> list[float]:
    return [row[key] for row in rows if row[key] is not None]


def _number(form: str, key: str) -> Callable[[Row], str]:
    return lambda row: "" if row[key] is None else form.format(row[key])


def _share_of(part: str, whole: str) -> Callable[[Row], str]:
    def text(row: Row) -> str:
        if row[part] is None:
            return ""
        return f"{row[part]:,}" + (f"<small>/{row[whole]:,}</small>" if row[whole] is not None else "")

    return text


def _what(row: Row) -> str:
    text = row["reason"] or row["warning_texts"] or (f"next: {row['next']}" if row["next"] else "")
    return escape(text if len(text) <= WHAT_LENGTH else text[: WHAT_LENGTH - 1] + "…")


NUMBERS: tuple[tuple[str, str, Callable[[Row], str]], ...] = (
    ("registered_share", "registered", _share_of("registered", "kept")),
    ("error_px", "px", _number("{:.2f}", "error_px")),
    ("depth_coverage", "depth", _number("{:.0%}", "depth_coverage")),
    ("depth_error", "off by", _number("{:.2%}", "depth_error")),
    ("masks", "masks", _number("{:,}", "masks")),
    ("pairs", "pairs", _number("{:,}", "pairs")),
    ("correspondences", "corr.", _number("{:,.0f}", "correspondences")),
    ("cpu_seconds", "CPU s", _number("{:,.0f}", "cpu_seconds")),
)


def table_head(categories: bool) -> str:
    """The headings, each a button that sorts by its column; one of categories where there are any."""
    texts = [("id", "sequence"), ("status", "status"), *([("category", "category")] if categories else [])]
    left = "".join(_heading(key, name, "") for key, name in texts)
    return left + "".join(_heading(key, name, "num") for key, name, _ in NUMBERS) + _heading("reason", "what", "")


def _heading(key: str, name: str, kind: str) -> str:
    return f'<th scope="col" class="{kind}" data-key="{key}"><button type="button">{name}</button></th>'


def table_row(number: int, row: Row, categories: bool) -> str:
    """A row of the table: HTML without a line of script."""
    status = row["status"] if row["status"] in STATUSES else ""
    numbers = "".join(f'<td class="num">{text(row)}</td>' for _, _, text in NUMBERS)
    category = f"<td>{escape(row['category'] or '')}</td>" if categories else ""
    return (
        f'<tr><th scope="row"><a href="#s{number}">{escape(row["id"] or "")}</a></th>'
        f'<td><span class="status {status}">{status}</span></td>{category}'
        f'{numbers}<td class="what">{_what(row)}</td></tr>'
    )
