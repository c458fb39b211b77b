"""The paper's own figures (paper.json), to stand beside what was measured here."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

SPLITS = 5
"""Validation/test splits of each of the paper's tables."""


@dataclass(frozen=True)
class PaperRow:
    """A row of one of the paper's tables: `accuracy` in % by column, e.g. {"5w1s": 57.51}."""

    label: str
    method: str
    accuracy: dict[str, float]


@cache
def _paper() -> dict[str, Any]:
    values: dict[str, Any] = json.loads(Path(__file__).with_name("paper.json").read_text(encoding="utf-8"))
    return values


def source() -> str:
    return str(_paper()["source"])


def is_known(table: str) -> bool:
    return table in _paper()["tables"]


def table_title(table: str) -> str:
    """As the paper writes it; a table that it does not have keeps its name."""
    return str(_paper()["tables"][table]["title"]) if is_known(table) else table


def method_name(method: str) -> str:
    """As the paper writes it; other names (encoders) stay as they are."""
    return str(_paper()["methods"].get(method, method))


def paper_rows(table: str) -> list[PaperRow]:
    """The methods of a table of the paper; none for other tables."""
    if not is_known(table):
        return []
    rows = []
    for row in _paper()["tables"][table]["rows"]:
        trained_on = f" - {row['trained_on']}" if "trained_on" in row else ""
        rows.append(PaperRow(method_name(row["method"]) + trained_on, row["method"], _by_column(row["accuracy"])))
    return rows


def paper_ablations(table: str) -> list[tuple[str, list[PaperRow]]]:
    """(title, rows) of each ablation that the paper shows for a table."""
    if not is_known(table):
        return []
    return [
        (block["title"], [PaperRow(row["label"], "dope", _by_column(row["accuracy"])) for row in block["rows"]])
        for block in _paper()["tables"][table]["ablations"]
    ]


def _by_column(values: list[float | None]) -> dict[str, float]:
    return {name: value for name, value in zip(_paper()["columns"], values, strict=True) if value is not None}
