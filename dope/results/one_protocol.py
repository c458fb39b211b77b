"""Are these rows comparable? Rows of two protocols in one table would be a comparison that nobody made."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from dope.common.errors import UsageError
from dope.lowshot.results import ResultRow
from dope.results.sources import FoundRow

SHARED = (
    "table", "part", "split", "dataset", "classes", "shot_mode", "episodes", "seed", "evaluation_hash",
)  # fmt: skip
"""Columns that are equal in all rows of a table."""
SHARED_IN_CELL = ("queries", "n_classes", "n_objects", "n_views")
"""Columns that are equal for one (ways, shots) of one table split: `--fit` may have reduced the queries of some."""
MEANINGS = {
    "evaluation_hash": "categories, image size or matching; in rows of earlier versions support copies, too",
    "dataset": "fingerprint of the views",
    "split": "split of the shards",
}
"""What to think of where a value says little by itself."""


def check_one_protocol(found: Sequence[FoundRow]) -> None:
    """Refuse rows that were not measured in the same way.

    The classifier is a method's own (local matching, logistic regression with copies of the shots, ...) and may differ.

    Raises:
        UsageError: names two files, the columns in which they differ and their values, and how to choose.
    """
    _check_groups(found, SHARED, lambda row: ())
    as_asked = [item for item in found if item.row.queries == item.row.asked_queries]
    _check_groups(as_asked, ("queries",), lambda row: ())
    _check_groups(found, SHARED_IN_CELL, lambda row: (row.ways, row.shots, row.table_split))


def check_no_duplicates(found: Sequence[FoundRow]) -> None:
    """Refuse a measurement that is there twice. Raises `UsageError` naming both files."""
    first: dict[tuple[Any, ...], FoundRow] = {}
    for item in found:
        identity = tuple(v for k, v in dataclasses.asdict(item.row).items() if k not in ("accuracy", "ci95"))
        if identity in first:
            row = item.row
            name = f"{row.method} ({row.run})" if row.run else row.method
            what = f"{name}, {row.protocol}, is there twice: {_both(first[identity], item)}"
            raise UsageError(what, remedy="Name only one of the files")
        first[identity] = item


def keep_only(found: Sequence[FoundRow], wanted: Mapping[str, str]) -> list[FoundRow]:
    """The rows whose columns have the wanted values, e.g. {"part": "test", "episodes": "2500"}.

    Raises:
        UsageError: no such column, or no such rows; it says which values there are.
    """
    known = [field.name for field in dataclasses.fields(ResultRow)]
    kept = list(found)
    for name, text in wanted.items():
        if name not in known:
            raise UsageError(f"rows have no column '{name}' (they have: {', '.join(known)})", where="--only")
        there = sorted({as_text(getattr(item.row, name)) for item in kept})
        kept = [item for item in kept if as_text(getattr(item.row, name)) == text]
        if not kept:
            shown = ", ".join(repr(value) for value in there[:8]) + (", ..." if len(there) > 8 else "")
            raise UsageError(f"no rows have {name} '{text}' (there are: {shown})", where=f"--only {name}={text}")
    return kept


def as_text(value: Any) -> str:
    return "" if value is None else str(value)


def _check_groups(
    found: Iterable[FoundRow], names: Sequence[str], group: typing.Callable[[ResultRow], tuple[Any, ...]]
) -> None:
    first: dict[tuple[Any, ...], FoundRow] = {}
    for item in found:
        other = first.setdefault(group(item.row), item)
        differing = [name for name in names if getattr(item.row, name) != getattr(other.row, name)]
        if differing:
            raise _refusal(other, item, differing)


def _refusal(one: FoundRow, other: FoundRow, names: Sequence[str]) -> UsageError:
    told = []
    for name in names:
        meaning = f" ({MEANINGS[name]})" if name in MEANINGS else ""
        both = (as_text(getattr(item.row, name)) or "''" for item in (one, other))
        told.append(f"{name}{meaning}: {' and '.join(both)}")
    what = f"rows of two protocols are not mixed: {_both(one, other)} differ in {'; '.join(told)}"
    name = next((name for name in ("part", "table") if name in names), names[0])
    values = [as_text(getattr(item.row, name)) for item in (one, other)]
    value = "test" if name == "part" and "test" in values else values[0]
    flag = f"--part {value}" if name == "part" else f"--only {name}={value}"
    separately = " or show each file by a command of its own" if one.file != other.file else ""
    return UsageError(what, remedy=f"Choose by {flag}{separately}")


def _both(one: FoundRow, other: FoundRow) -> str:
    return f"rows in {one.file}" if one.file == other.file else f"{one.file} and {other.file}"
