"""Result rows: what was measured, on what, with which weights; kept in Parquet or JSON, printed as a table."""

from __future__ import annotations

import dataclasses
import fcntl
import os
import typing
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from dope.common import files
from dope.common.errors import BadInput, UsageError

if TYPE_CHECKING:
    from rich.table import Table

OUTCOME = ("accuracy", "ci95")
WEIGHTS = ("checkpoint", "checkpoint_sha256", "step")
CLASSIFIERS = {"local": "local matching", "centroid": "nearest centroid", "nearest": "1-NN", "logistic": "logistic"}
"""Their names in tables; others stay as they are."""


@dataclass(frozen=True)
class ResultRow:
    """One protocol of one network on one dataset."""

    network: str
    """"trained", or "untrained" for the same network with random weights."""
    classifier: str
    """local (1-NN by local matching); of pooled features centroid (nearest class mean), nearest (1-NN) or logistic
    (regression); or the method's own: cl2n, attention."""
    classes: str
    """category or instance."""
    ways: int
    """Classes an episode, as drawn."""
    shots: int
    """Labelled views a class."""
    shot_mode: str
    """several_instances or one_instance."""
    queries: int
    """Queries a class, as drawn."""
    episodes: int
    """Number of episodes."""
    seed: int
    """Seed of the episodes."""
    accuracy: float
    """Mean over episodes, 0 to 1."""
    ci95: float
    """Half the 95% confidence interval: 1.96 * standard deviation over episodes / sqrt(episodes)."""
    chance: float
    """1 / ways."""
    n_classes: int
    """Classes the episodes were drawn from."""
    n_objects: int
    """Their objects."""
    n_views: int
    """Their views."""
    asked_ways: int
    """What was asked for: larger than `ways` where --fit reduced it."""
    asked_queries: int
    """What was asked for: larger than `queries` where --fit reduced it."""
    split: str
    """Split of the shards: all, train or val."""
    dataset: str
    """Fingerprint of the views."""
    checkpoint: str | None
    """File name of the weights; None for random ones."""
    checkpoint_sha256: str | None
    """SHA-256 of that file."""
    step: int | None
    """Training steps behind the weights."""
    config_hash: str
    """Of the training run (trained) or of the network's settings (untrained)."""
    evaluation_hash: str
    """Of the evaluation's settings other than those above."""
    method: str = "dope"
    """What made the features: a method of `dope train`, or an encoder's label."""
    run: str = ""
    """Name of the run's folder, which tells runs of one method apart; empty where there is no run."""
    table: str = ""
    """Table of splits (modelnet40_ls, shapenet55_ls, co3d_ls, or the name of a --split-file); empty without one."""
    table_split: int = -1
    """Which of its splits, from 0; -1 without a table."""
    part: str = "all"
    """Classes of that split: test or val; all without a table."""
    support_copies: int = 1
    """How often logistic regression learnt from each shot; beyond the first, augmented as in training."""
    chosen_by: str = ""
    """"validation": of all checkpoints of the run, the split's validation classes chose this one (`--select`)."""

    @property
    def protocol(self) -> str:
        return f"{self.ways}-way {self.shots}-shot"

    @property
    def classifier_in_words(self) -> str:
        """With how it was fitted, where that is not the usual way."""
        name = CLASSIFIERS.get(self.classifier, self.classifier)
        return f"{name}, {self.support_copies} copies a shot" if self.support_copies > 1 else name


def append_rows(path: Path, rows: Iterable[ResultRow]) -> list[ResultRow]:
    """Add rows to a .parquet or .json file, in order; a row measured before is replaced. Returns all rows.

    A row of a chosen checkpoint replaces that of an earlier choice, whichever it was.

    Several processes may do so at once: each adds to what the others wrote.

    Raises:
        UsageError: another suffix.
        BadInput: the file is there and cannot be read.
    """
    _check_suffix(path)
    with _alone(path):
        merged = {_identity(row): row for row in (read_rows(path) if path.exists() else [])}
        merged |= {_identity(row): row for row in rows}
        _write(path, list(merged.values()))
    return list(merged.values())


def check_appendable(path: Path) -> None:
    """Whether `append_rows` will be able to add to the file: asked before hours of evaluation, not after.

    Raises:
        UsageError: another suffix, or a place where nothing can be written.
        BadInput: the file is there and cannot be read.
    """
    _check_suffix(path)
    if path.exists():
        read_rows(path)
    there = next(folder for folder in path.absolute().parents if folder.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        what = "cannot be written to" if there.is_dir() else "is no folder"
        raise UsageError(what, where=there, remedy="Name a folder for the results by --out")


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Wait until no other process adds to the file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f".{path.name}.lock").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # let go when the file is closed, also by the end of the process
        yield


def read_rows(path: Path) -> list[ResultRow]:
    """Read what `append_rows` wrote. Raises `BadInput` where the file is absent or not of result rows."""
    _check_suffix(path)
    if path.suffix == ".json":
        values = files.read_json(path)
    else:
        try:
            values = pq.read_table(path).to_pylist()
        except FileNotFoundError:
            raise BadInput("no such file", where=path, remedy="`dope eval` writes it") from None
        except (pa.ArrowException, OSError) as error:
            raise BadInput(f"cannot be read ({error})", where=path) from error
    known = {field.name for field in dataclasses.fields(ResultRow)}
    try:
        return [ResultRow(**{key: value for key, value in row.items() if key in known}) for row in values]
    except (TypeError, AttributeError) as error:
        raise BadInput(f"does not hold result rows ({error})", where=path, remedy="`dope eval` writes it") from error


def mean_over_splits(rows: Iterable[ResultRow]) -> list[tuple[ResultRow, int]]:
    """Rows that differ in the split of one table alone, as one each: mean accuracy and mean CI, as the paper has it.

    Returns:
        rows with `table_split` -1 where several became one, and how many they were; numbers of classes, objects and
        views are the smallest of them, checkpoint and step None where they differ.
    """
    groups: dict[tuple[Any, ...], list[ResultRow]] = {}
    for row in rows:
        key = tuple(value for name, value in dataclasses.asdict(row).items() if name not in _PER_SPLIT)
        groups.setdefault(key, []).append(row)
    return [(_mean(group), len(group)) for group in groups.values()]


_PER_SPLIT = (*OUTCOME, *WEIGHTS, "table_split", "n_classes", "n_objects", "n_views")


def _mean(rows: Sequence[ResultRow]) -> ResultRow:
    if len(rows) == 1:
        return rows[0]
    means = {name: sum(getattr(row, name) for row in rows) / len(rows) for name in OUTCOME}
    least = {name: min(getattr(row, name) for row in rows) for name in ("n_classes", "n_objects", "n_views")}
    differing: dict[str, Any] = {name: None for name in WEIGHTS if len({getattr(row, name) for row in rows}) > 1}
    return dataclasses.replace(rows[0], table_split=-1, **means, **least, **differing)


def results_table(rows: Sequence[ResultRow], title: str = "Low-shot recognition") -> Table:
    """The rows as a table for the terminal: accuracy in % with its 95% confidence interval, beside chance.

    Splits of a table are shown as their mean. What all rows have in common is said once, below the table.
    """
    from rich.markup import escape
    from rich.table import Table

    counted = mean_over_splits(rows)
    rows, counts = [row for row, _ in counted], [count for _, count in counted]
    table = Table(title=title, caption_justify="left")
    details = {
        "table": [_table(row, count) for row, count in counted],
        "of": [_classes(row, count) for row, count in counted],
        "views": [f"{row.n_views} views ({row.split})" for row in rows],
        "method": [row.method if row.network == "trained" else "" for row in rows],
        "classifier": [row.classifier_in_words for row in rows],
        "checkpoint": ["chosen on validation classes" if row.chosen_by else "" for row in rows],
        "queries": [f"{row.queries} queries a class" for row in rows],
        "episodes": [f"{row.episodes:,} episodes" for row in rows],
    }
    if max(counts, default=1) > 1:
        del details["views"]
    shared = [values[0] for values in details.values() if len(set(values)) == 1]
    table.caption = escape(", ".join(value for value in shared if value))
    varying = {name: values for name, values in details.items() if len(set(values)) > 1}
    for name in ("protocol", "network", *varying):
        table.add_column(name)
    table.add_column("accuracy %", justify="right", no_wrap=True)
    table.add_column("chance %", justify="right", no_wrap=True)
    for i, row in enumerate(rows):
        trained = row.network + (f", step {row.step}" if row.step is not None else "")
        accuracy = f"{100 * row.accuracy:.2f} ± {100 * row.ci95:.2f}"
        cells = [escape(values[i]) for values in varying.values()]
        table.add_row(_protocol(row), trained, *cells, accuracy, f"{100 * row.chance:.1f}")
    return table


def _table(row: ResultRow, splits: int) -> str:
    if not row.table:
        return ""
    which = f"mean of {splits} splits" if splits > 1 else f"split {row.table_split}"
    return f"{row.table} ({which}, {row.part})"


def _classes(row: ResultRow, splits: int) -> str:
    least = "at least " if splits > 1 else ""
    return f"{least}{row.n_classes} {'categories' if row.classes == 'category' else 'objects'}"


def _protocol(row: ResultRow) -> str:
    """Ways and shots, with what was asked for where --fit reduced it."""
    asked = []
    if row.ways < row.asked_ways:
        asked.append(f"{row.asked_ways}-way")
    if row.queries < row.asked_queries:
        asked.append(f"{row.asked_queries} queries")
    one_object = row.shots > 1 and row.shot_mode == "one_instance"
    return row.protocol + (" of one object" if one_object else "") + (f" (asked: {', '.join(asked)})" if asked else "")


def _identity(row: ResultRow) -> tuple[Any, ...]:
    values = dataclasses.asdict(row)
    without = (*OUTCOME, *WEIGHTS) if row.chosen_by else OUTCOME
    return tuple(value for name, value in values.items() if name not in without)


def _write(path: Path, rows: Sequence[ResultRow]) -> None:
    values = [dataclasses.asdict(row) for row in rows]
    if path.suffix == ".json":
        files.write_json(path, values)
        return
    with files.atomic_path(path) as partial:
        pq.write_table(pa.Table.from_pylist(values, schema=_schema()), partial)


def _schema() -> pa.Schema:
    kinds = {int: pa.int64(), float: pa.float64(), str: pa.string()}
    fields = []
    for name, hint in typing.get_type_hints(ResultRow).items():
        plain = next((kind for kind in typing.get_args(hint) if kind is not type(None)), hint)
        fields.append((name, kinds[plain]))
    return pa.schema(fields)


def _check_suffix(path: Path) -> None:
    if path.suffix not in (".parquet", ".json"):
        raise UsageError("results are kept in a .parquet or .json file", where=path)
