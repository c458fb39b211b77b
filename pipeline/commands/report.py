"""`dope prep report`: one HTML page that shows every sequence."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    work: Annotated[
        list[Path], typer.Argument(metavar="WORK...", help="Folders of prepared sequences.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", help="The HTML file to write.")] = Path("report.html"),
    where: Annotated[
        list[str] | None,
        typer.Option(metavar="'KEY OP VALUE'", help="Only sequences for which this holds, as in `dope prep status`.",
                     show_default=False),
    ] = None,
    sort: Annotated[
        list[str] | None,
        typer.Option(metavar="[-]KEY", help="Order of the sequences; -KEY is descending.", show_default=False),
    ] = None,
    title: Annotated[str, typer.Option(help="Heading of the page.")] = "Prepared sequences",
    max_mb: Annotated[
        float, typer.Option(min=0.1, help="Largest size of the page: with more sequences, smaller pictures.")
    ] = 48.0,
    workers: Annotated[int, typer.Option(min=0, help="Threads that make pictures; 0 = one for each CPU.")] = 0,
) -> None:  # fmt: skip
    """One self-contained page: failures with their reasons, histograms, and a contact sheet of every sequence.

    A sheet shows frames with the outlines of their masks, depth, the cameras around the sparse points, pairs of views
    with correspondences, and the attempts at reconstruction. The page loads nothing from anywhere: mail it, or keep it
    beside the shards. Sequences may be at any stage, also failed ones.

    Examples:

      dope prep report work --out report.html

      dope prep report work --where category=apple --where 'registered_share<0.9' --sort registered_share
    """
    from dope.common.errors import UsageError
    from dope.common.progress import progress_bar
    from pipeline.engines import default_workers
    from pipeline.report import filters, status_table
    from pipeline.report.page import ReportConfig, write_report

    conditions = [filters.parse_condition(text) for text in where or []]
    for folder in work:
        if not folder.is_dir():
            raise UsageError("no such folder", where=folder, remedy="WORK is what `dope prep colmap --out` wrote")
    if out.is_dir():
        raise UsageError("is a folder", where=out, remedy="Name the page, as in --out report.html")
    with progress_bar() as progress:
        table = status_table.read_status(work, progress)
        table = filters.sort_rows(filters.select(table, conditions), sort or [])
        details = write_report(table, out, ReportConfig(title, max_mb, workers or default_workers()), progress)
    size = f"{details['bytes'] / 1e6:.1f} MB"
    lost = f", {details['without_pictures']:,} without pictures" if details["without_pictures"] else ""
    typer.echo(f"{out}: {details['sequences']:,} sequences{lost}, {size}")
