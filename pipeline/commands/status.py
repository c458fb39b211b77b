"""`dope prep status`: a row a sequence, filtered, sorted, as text, JSON, Parquet or CSV."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

Places = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="WORK...",
        help="Folders of prepared sequences; also Parquet files that this command wrote on other machines.",
        show_default=False,
    ),
]
CHOICE, OUTPUT = "Which rows", "Output"


def status(
    places: Places = None,
    where: Annotated[
        list[str] | None,
        typer.Option(metavar="'KEY OP VALUE'", show_default=False, rich_help_panel=CHOICE,
                     help="Rows where a column is =, ==, !=, <, <=, >, >=, ~ (contains) or !~ a value; all must hold."),
    ] = None,
    status_: Annotated[
        list[str] | None,
        typer.Option("--status", help="ok, waiting, running, empty or failed.", show_default=False,
                     rich_help_panel=CHOICE),
    ] = None,
    stage: Annotated[
        list[str] | None,
        typer.Option(help="Where it failed, or the last stage that ended.", show_default=False, rich_help_panel=CHOICE),
    ] = None,
    category: Annotated[
        list[str] | None, typer.Option(help="Only these.", show_default=False, rich_help_panel=CHOICE)
    ] = None,
    sequence: Annotated[
        list[str] | None, typer.Option(help="Only these ids.", show_default=False, rich_help_panel=CHOICE)
    ] = None,
    sort: Annotated[
        list[str] | None,
        typer.Option(metavar="[-]KEY", help="Sort by a column; -KEY is descending.", show_default=False,
                     rich_help_panel=CHOICE),
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(metavar="KEY,KEY", help="Only these columns, in text, JSON and files; or all.",
                     show_default=False, rich_help_panel=OUTPUT),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Rows as JSON lines instead of a table.", rich_help_panel=OUTPUT)
    ] = False,
    parquet: Annotated[
        Path | None,
        typer.Option(help="Write the rows to this file; only the summary is printed.", show_default=False,
                     rich_help_panel=OUTPUT),
    ] = None,
    csv: Annotated[
        Path | None,
        typer.Option(help="The same as CSV; a ' before texts that a spreadsheet would run as formulas.",
                     show_default=False, rich_help_panel=OUTPUT),
    ] = None,
    list_columns: Annotated[
        bool, typer.Option("--list-columns", help="Say what the columns are, and stop.", rich_help_panel=OUTPUT)
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Exit with 1 unless every chosen sequence is ok.", rich_help_panel=OUTPUT)
    ] = False,
) -> None:  # fmt: skip
    """One row a sequence: how far it came, why it failed, and the figures of every stage.

    Reads only the small JSON files of each sequence, takes no lock and changes nothing: it may be run at any moment,
    beside any other run. Exit code 0 whatever the sequences' state; --check makes it 1 unless all are ok.

    Examples:

      dope prep status work

      dope prep status work --status failed --stage sfm

      dope prep status work --where category=apple --where 'registered_share<0.9' --sort registered_share

      dope prep status work --parquet here.parquet

      dope prep status work other.parquet --columns id,work,duplicate --where duplicate=true
    """
    from dope.common.errors import UsageError
    from dope.common.progress import progress_bar
    from pipeline.report import filters, status_table, status_text
    from pipeline.report.status_row import COLUMNS

    if list_columns:
        width = max(len(column.name) for column in COLUMNS)
        for column in COLUMNS:
            typer.echo(f"{column.name:{width}}  {column.type!s:6}  {column.doc}")
        return
    if not places:
        raise UsageError("no WORK folder given", remedy="As in `dope prep status work`")
    wanted = filters.split_columns(columns)
    conditions = [filters.parse_condition(text) for text in where or []]
    _check_words(status_, stage)
    for file in (parquet, csv):
        if file is not None and file.is_dir():
            raise UsageError("is a folder", where=file, remedy="Name the file to write, as in status.csv")
    with progress_bar() as progress:
        table = status_table.read_status(places, progress)
    for name, values in (("status", status_), ("stage", stage), ("category", category), ("id", sequence)):
        table = filters.one_of(table, name, values)
    table = filters.sort_rows(filters.select(table, conditions), sort or [])
    kept = table.select(wanted) if wanted else table
    if parquet is not None:
        status_table.write_parquet(kept, parquet)
    if csv is not None:
        status_table.write_csv(kept, csv)
    if as_json:
        for batch in kept.to_batches(max_chunksize=status_text.SLICE):
            sys.stdout.writelines(json.dumps(row, ensure_ascii=False) + "\n" for row in batch.to_pylist())
    elif parquet is None and csv is None:
        colour = sys.stdout.isatty() and "NO_COLOR" not in os.environ
        sys.stdout.writelines(f"{line}\n" for line in status_text.lines_of(table, wanted, colour=colour))
    typer.echo("\n".join(status_text.summary(table)), err=as_json)
    raise typer.Exit(1 if check and set(table["status"].to_pylist()) - {"ok"} else 0)


def _check_words(statuses: list[str] | None, stages: list[str] | None) -> None:
    """A misspelt word must not look like "there are none"."""
    from dope.common.errors import UsageError
    from pipeline.report.status_row import STAGES, STATUSES

    for option, given, known in (("--status", statuses, STATUSES), ("--stage", stages, STAGES)):
        for word in given or []:
            if word not in known:
                raise UsageError(f"'{word}' is not one of {', '.join(known)}", where=option)
