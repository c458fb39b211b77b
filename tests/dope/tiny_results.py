"""Result rows as `dope eval` writes them, with accuracies that a test chooses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dope.lowshot.results import ResultRow, append_rows

COUNTS = {"n_classes": 10, "n_objects": 200, "n_views": 2000}


def row(accuracy: float = 0.5, ci95: float = 0.01, **columns: Any) -> ResultRow:
    """A row of a 5-way 1-shot evaluation of DOPE; `columns` take the place of what is given here."""
    ways, queries = columns.get("ways", 5), columns.get("queries", 15)
    values: dict[str, Any] = {
        "network": "trained", "classifier": "local", "classes": "category", "ways": 5, "shots": 1,
        "shot_mode": "several_instances", "queries": 15, "episodes": 2500, "seed": 0, "chance": 1 / ways, **COUNTS,
        "asked_ways": ways, "asked_queries": queries, "split": "all", "dataset": "0123456789abcdef",
        "checkpoint": "step-00000100.pt", "checkpoint_sha256": "aa", "step": 100, "config_hash": "c" * 16,
        "evaluation_hash": "e" * 16, "method": "dope", "run": "run", "table": "", "table_split": -1, "part": "all",
    }  # fmt: skip
    return ResultRow(accuracy=accuracy, ci95=ci95, **{**values, **columns})


def write_run(folder: Path, *rows: ResultRow, name: str = "results.parquet") -> Path:
    """A run's folder whose evaluation left these rows."""
    append_rows(folder / "eval" / name, rows)
    return folder
