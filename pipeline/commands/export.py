"""`dope prep export`: prepared sequences for other tools."""

from __future__ import annotations

import os
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from pipeline.commands.options import Work, chosen_sequences


def export(
    work: Work,
    format: Annotated[str, typer.Option("--format", help="transforms (nerfstudio) or colmap-text.")] = "transforms",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Folder to write <sequence>/ into; what it holds stays.",
            show_default="beside each sequence's files",
        ),
    ] = None,
    depths: Annotated[
        bool,
        typer.Option("--depths", help="transforms: depth maps too, as 16-bit PNG in thousandths of the unit."),
    ] = False,
    only: Annotated[list[str] | None, typer.Option("--sequence", help="Only these ids.", show_default=False)] = None,
) -> None:
    """Cameras, masks and points of prepared sequences in the formats of other tools.

    transforms writes transforms.json (and points.ply) as nerfstudio and its relatives read it; colmap-text writes the
    model into the folder sparse_text. Cameras are in the sequence's frame: the object in the origin, its radius the
    unit of length. What is written can be read back with `dope prep colmap --reuse-cameras`. A sequence that another
    command works on is refused. COLMAP's own tools open each WORK/<sequence> as it is: `cd` there and `colmap gui
    --project_path project.ini`, then import sparse/ as a model.

    Examples:

      dope prep export work

      dope prep export work --depths --out for_nerfstudio

      dope prep export work --format colmap-text --sequence fox --out text
    """
    from dope.common.errors import DiskFull, DopeError, UsageError
    from pipeline.cameras.export import export_sequence
    from pipeline.engines import holding

    if format not in ("transforms", "colmap-text"):
        raise UsageError(f"'{format}' is not one of transforms, colmap-text", where="--format")
    if depths and format != "transforms":
        raise UsageError("depth maps are written with --format transforms only", where="--depths")
    failed = 0
    for sequence in chosen_sequences(work, only):
        try:
            # what may only be read has no writer here, and needs no lock
            with holding(sequence.folder) if os.access(sequence.folder, os.W_OK) else nullcontext():
                done = export_sequence(sequence, format, out and out / sequence.id, depths=depths)  # type: ignore[arg-type]
        except DiskFull:
            raise
        except DopeError as error:
            failed += 1
            typer.echo(f"{sequence.id}: {error}", err=True)
        else:
            parts = [f"{done['frames']} cameras", f"{done['points']} points"]
            parts += [f"{done['depths']} depth maps"] if depths else []
            typer.echo(f"{sequence.id}: {', '.join(parts)} -> {done['path']}")
    raise typer.Exit(1 if failed else 0)
