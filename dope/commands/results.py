"""`dope results`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dope.commands.options import check_choice

FORMATS = ("text", "markdown", "latex")
BESIDE = ("methods", "all", "none")


def results(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Runs that `dope eval` has evaluated, folders of its --out, or .parquet/.json files.",
            show_default=False,
        ),
    ],
    form: Annotated[
        str | None,
        typer.Option("--format", help="text, markdown or latex.", show_default="by the suffix of --out, else text"),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Write the table to this file (.md, .tex, .txt).", show_default=False)
    ] = None,
    label: Annotated[
        list[str] | None,
        typer.Option(
            "--label",
            help="RUN=TEXT: what a run (its name or folder) is called; repeatable. "
            "Runs with one label are one row, e.g. FEAT's, which has a network a setting.",
            show_default=False,
        ),
    ] = None,
    part: Annotated[
        str | None,
        typer.Option(help="Only rows of this part of a table's classes: test, val or all.", show_default=False),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only", help="COLUMN=VALUE: only rows with it, e.g. episodes=2500; repeatable.", show_default=False
        ),
    ] = None,
    paper: Annotated[
        str, typer.Option(help="The paper's figures beside a table that it has: methods, all (and ablations), none.")
    ] = "methods",
    plot: Annotated[
        Path | None,
        typer.Option("--plot", help="Draw accuracy against training step (.png, .pdf, .svg).", show_default=False),
    ] = None,
) -> None:
    """The paper's tables from the result rows of runs: a row a method, a column a setting, beside the paper's figures.

    A cell is the accuracy with its 95% confidence interval; of a table with splits (modelnet40_ls, ...) the mean.
    Rows that were not measured in the same way are refused, and the columns in which they differ are named. Checkpoints
    that `dope eval --select` chose are one row, which says so; others of a run are a row each.

    Examples:

      dope results runs/dope runs/simpleshot runs/rfs --part test

      dope results runs/* --label dope_no_mask="no mask prediction" --out ablations.tex

      dope results runs/dope --part val --plot training.png          after `dope eval` of several checkpoints
    """
    from dope.results.formats import SUFFIXES, write_table
    from dope.results.one_protocol import keep_only
    from dope.results.rows import read_labels
    from dope.results.sources import find_rows
    from dope.results.table import build_table

    form = form or (SUFFIXES.get(out.suffix.lower(), "text") if out else "text")
    check_choice(form, "--format", FORMATS)
    check_choice(paper, "--paper", BESIDE)
    wanted = _columns(only) | ({"part": part} if part is not None else {})
    found = keep_only(find_rows(runs), wanted)
    labels = read_labels(label or (), found)
    text = write_table(build_table(found, labels=labels, beside=paper), form)  # type: ignore[arg-type]
    if plot is not None:
        from dope.results.curves import plot_curves

        plot_curves(found, plot, labels)
    if out is None:
        typer.echo(text, nl=False)
    else:
        from dope.common.files import write_bytes

        write_bytes(out, text.encode())
        typer.echo(f"table in {out}")
    if plot is not None:
        typer.echo(f"curves in {plot}", err=out is None)


def _columns(values: list[str] | None) -> dict[str, str]:
    """column -> value of --only."""
    from dope.common.errors import UsageError

    columns: dict[str, str] = {}
    for value in values or []:
        name, equals, text = value.partition("=")
        if not equals or not name:
            raise UsageError(f"'{value}' is not COLUMN=VALUE", where="--only")
        if name in columns:
            raise UsageError(f"'{name}' is given twice", where="--only")
        columns[name] = text
    return columns
