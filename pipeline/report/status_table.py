"""The status of many WORK folders as one Arrow table; Parquet files of other machines' status are merged in."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from dope.common import files
from dope.common.errors import BadInput
from pipeline.engines import read_spread
from pipeline.report.status_row import SCHEMA, refused_row, sequence_row

FORMULA = r"\A([=+\-@\t\r])"
"""How a text begins that spreadsheets run: names of folders come from strangers' disks."""

Progress = Callable[[str, int, int], None]
Item = tuple[str, bool]


def read_status(places: list[Path], progress: Progress | None = None) -> pa.Table:
    """One row (see `status_row.COLUMNS`) for each sequence of the given WORK folders and status Parquet files.

    Rows are in the order of `places`, by id within each. Ids that occur more than once are marked `duplicate`.

    Raises:
        BadInput: no such folder, or a file that is not a status table.
    """
    report = progress or (lambda what, done, of: None)
    tables = [read_work(place, report) if place.is_dir() else read_parquet(place) for place in places]
    return _mark_duplicates(pa.concat_tables([SCHEMA.empty_table(), *tables]))


def read_work(work: Path, progress: Progress) -> pa.Table:
    """The rows of one WORK folder, by id: its sequences, and the inputs that could not be begun."""
    held = held_files()
    try:
        with os.scandir(work) as entries:
            names = sorted(entry.name for entry in entries if not entry.name.startswith(".") and entry.is_dir())
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=work) from error
    items = [(name, bool(held) and _is_held(f"{work}/{name}/.lock", held)) for name in names]
    read = partial(_read_batch, str(work))
    tables, done = [], 0
    for number, table in read_spread(read, items):
        tables.append(table)
        done += number
        progress("sequences", done, len(items))
    table = pa.concat_tables([SCHEMA.empty_table(), *tables])
    refused = [refused_row(str(work), path.stem) for path in sorted(work.glob(".refused/[!.]*.json"))]
    if not refused:
        return table
    return pa.concat_tables([table, pa.Table.from_pylist(refused, SCHEMA)]).sort_by("id")


def read_parquet(path: Path) -> pa.Table:
    """The rows of a file that `dope prep status --parquet` wrote, perhaps by an older version: absent columns are null.

    Raises:
        BadInput: no such file, not Parquet, or no table of this kind.
    """
    try:
        table = pq.read_table(path)
    except FileNotFoundError:
        raise BadInput(
            "no such folder or file", where=path, remedy="Name WORK folders or status Parquet files"
        ) from None
    except (OSError, pa.ArrowException) as error:
        remedy = "Write it with `dope prep status WORK --parquet FILE`"
        raise BadInput(f"is not a Parquet file that can be read ({error})", where=path, remedy=remedy) from error
    if not {"id", "status"} <= set(table.column_names):
        remedy = "Write it with `dope prep status WORK --parquet FILE`"
        raise BadInput("is not a status table: it has no columns id and status", where=path, remedy=remedy)
    try:
        columns = [
            table[field.name].cast(field.type) if field.name in table.column_names else pa.nulls(len(table), field.type)
            for field in SCHEMA
        ]
        return pa.table(columns, schema=SCHEMA)
    except (pa.ArrowException, KeyError) as error:
        raise BadInput(f"is not a status table ({error})", where=path) from error


def write_parquet(table: pa.Table, path: Path) -> None:
    with files.atomic_path(path) as partial_path:
        pq.write_table(table, partial_path)


def write_csv(table: pa.Table, path: Path) -> None:
    """The rows as CSV. A text that a spreadsheet would run as a formula gets a ' before it (OWASP, CSV injection)."""
    from pyarrow import csv

    for place, field in enumerate(table.schema):
        if pa.types.is_string(field.type):
            inert = pc.replace_substring_regex(table[field.name], FORMULA, r"'\1")
            table = table.set_column(place, field, inert)
    with files.atomic_path(path) as partial_path:
        csv.write_csv(table, partial_path)


Held = Mapping[int, set[tuple[int, int]]]
"""Inodes of locked files, with the devices (major, minor) on which a file of that inode is locked."""


def held_files(listing: str = "/proc/locks") -> Held:
    """All files that a process of this machine holds by flock.

    Asking each lock file itself would mean taking it for a moment, in which a run that starts would give up. Where the
    system has no such list (macOS), or the process runs on another machine, a running sequence looks as it stands.
    """
    held: dict[int, set[tuple[int, int]]] = defaultdict(set)
    try:
        for line in Path(listing).read_text(encoding="ascii").splitlines():
            _, flock, rest = line.partition(" FLOCK ")
            if flock:  # ADVISORY WRITE <process> <major>:<minor>:<inode> <from> <to>
                major, minor, inode = rest.split()[3].split(":")
                held[int(inode)].add((int(major, 16), int(minor, 16)))
    except (OSError, ValueError, IndexError):
        return {}
    return dict(held)


def _is_held(path: str, held: Held) -> bool:
    """Anonymous devices (major 0: overlay, btrfs) have other numbers in the list than `stat` says: there, the inode
    alone counts."""
    try:
        found = os.stat(path)  # noqa: PTH116 - 100,000 Paths are slow
    except OSError:
        return False
    own = os.major(found.st_dev), os.minor(found.st_dev)
    return any(device == own or 0 in (device[0], own[0]) for device in held.get(found.st_ino, ()))


def _read_batch(work: str, items: list[Item]) -> pa.Table:
    rows = [row for name, running in items if (row := sequence_row(work, name, running=running)) is not None]
    return pa.Table.from_pydict({name: [row[name] for row in rows] for name in SCHEMA.names}, schema=SCHEMA)


def _mark_duplicates(table: pa.Table) -> pa.Table:
    counts = table.group_by("id").aggregate([("status", "count")])
    often = counts.filter(pc.greater(counts["status_count"], 1))["id"]
    place = table.schema.get_field_index("duplicate")
    marked = pc.is_in(table["id"], value_set=often.combine_chunks() if len(often) else pa.array([], pa.string()))
    return table.set_column(place, "duplicate", marked)
