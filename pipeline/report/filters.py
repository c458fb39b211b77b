"""Rows chosen, sorted and cut to columns: the small language of `dope prep status --where`.

    KEY OP VALUE      e.g. category=apple, "registered_share < 0.9", reason~frames

KEY is a column. OP is = (or ==), !=, <, <=, >, >= or ~ (contains, whatever the case) and !~. Numbers are compared as
numbers, texts as texts; an empty VALUE stands for "unknown" (`category=`). What is unknown is neither less nor greater.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from dope.common.errors import UsageError
from pipeline.report.status_row import NAMES, SCHEMA

CONDITION = re.compile(r"\s*(\w+)\s*(<=|>=|!=|!~|==|=|<|>|~)\s*(.*?)\s*", re.DOTALL)
COMPARE = {
    "=": pc.equal,
    "!=": pc.not_equal,
    "<": pc.less,
    "<=": pc.less_equal,
    ">": pc.greater,
    ">=": pc.greater_equal,
}


@dataclass(frozen=True)
class Condition:
    """`column` `operator` `value`; value None is "unknown"."""

    column: str
    operator: str
    value: str | float | bool | None

    def holds(self, table: pa.Table) -> Any:
        """A boolean for each row, never null."""
        values = table[self.column]
        if self.value is None:
            return values.is_null() if self.operator == "=" else values.is_valid()
        if self.operator in ("~", "!~"):
            found = pc.fill_null(pc.match_substring(values, str(self.value), ignore_case=True), False)
            return found if self.operator == "~" else pc.invert(found)
        held = COMPARE[self.operator](values, pa.scalar(self.value))
        return pc.fill_null(held, self.operator == "!=")


def parse_condition(text: str) -> Condition:
    """Read one `KEY OP VALUE`. Raises `UsageError` for another form, column or kind of value."""
    match = CONDITION.fullmatch(text)
    if match is None:
        raise UsageError(f"'{text}' is not KEY OP VALUE", where="--where", remedy="As in registered_share<0.9")
    name, operator, value = match.groups()
    operator = "=" if operator == "==" else operator
    kind = SCHEMA.field(known_column(name, "--where")).type
    if value == "":
        if operator not in ("=", "!="):
            raise UsageError(f"'{text}' has no value", where="--where")
        return Condition(name, operator, None)
    if pa.types.is_string(kind):
        return Condition(name, operator, value)
    if operator in ("~", "!~"):
        raise UsageError(f"'{text}': {name} is not a text", where="--where", remedy="Compare with =, <, >")
    if pa.types.is_boolean(kind):
        if value not in ("true", "false") or operator not in ("=", "!="):
            raise UsageError(f"'{text}': {name} is true or false", where="--where")
        return Condition(name, operator, value == "true")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if math.isnan(number):
        raise UsageError(f"'{text}': {name} is a number", where="--where")
    return Condition(name, operator, number)


def known_column(name: str, where: str) -> str:
    """`name`, if it is a column. Raises `UsageError` naming the nearest."""
    if name in NAMES:
        return name
    near = difflib.get_close_matches(name, NAMES, 1)
    remedy = f"Did you mean '{near[0]}'?" if near else f"There are {', '.join(NAMES)}"
    raise UsageError(f"no column '{name}'", where=where, remedy=remedy)


def select(table: pa.Table, conditions: Iterable[Condition]) -> pa.Table:
    """The rows for which all conditions hold."""
    for condition in conditions:
        table = table.filter(condition.holds(table))
    return table


def one_of(table: pa.Table, column: str, values: list[str] | None) -> pa.Table:
    """The rows whose text is one of `values`; all where none are given."""
    return table if not values else table.filter(pc.is_in(table[column], value_set=pa.array(values, pa.string())))


def sort_rows(table: pa.Table, keys: list[str]) -> pa.Table:
    """Sorted by columns, the first key first; `-key` is descending. Unknown values come last; ties keep their order."""
    for key in reversed(keys):
        name = known_column(key.removeprefix("-"), "--sort")
        order = "descending" if key.startswith("-") else "ascending"
        numbered = table.append_column("__place", pa.array(range(len(table)), pa.int64()))
        by = [(name, order), ("__place", "ascending")]
        table = numbered.take(pc.sort_indices(numbered, sort_keys=by)).drop_columns("__place")
    return table


def split_columns(text: str | None) -> list[str] | None:
    """`id,status` as a list of columns; "all" gives all of them."""
    if text is None:
        return None
    return list(NAMES) if text == "all" else [known_column(name.strip(), "--columns") for name in text.split(",")]
