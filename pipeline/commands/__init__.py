"""`dope prep ...`: parse, call one function, print. Heavy imports happen inside the commands."""

from __future__ import annotations

import typer

from pipeline.commands.co3d import co3d
from pipeline.commands.colmap import colmap
from pipeline.commands.correspond import correspond
from pipeline.commands.export import export
from pipeline.commands.masks import masks
from pipeline.commands.photos import photos
from pipeline.commands.render import render
from pipeline.commands.report import report
from pipeline.commands.run import run
from pipeline.commands.shards import shards
from pipeline.commands.status import status

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="""Turn videos, photo folders and meshes into shards of pixel correspondences.

    [bold]dope prep run INPUT... --out WORK --shards SHARDS[/] does everything. The stages of their own, in order;
    each does only what is missing, and may be run again at any time:

      1. [bold]dope prep colmap[/]      frames, cameras (COLMAP) and depth maps of each video or photo folder

         [bold]dope prep co3d[/]        the same of a CO3D download, with its own cameras, masks and depth

         [bold]dope prep render[/]      the same of meshes: pictures rendered with exact masks, depth and cameras

      2. [bold]dope prep masks[/]       the object's mask in every frame: yours, or cut out by GrabCut

      3. [bold]dope prep correspond[/]  224 px views around the object, view pairs, pixel correspondences

      4. [bold]dope prep shards[/]      WebDataset tars and a Parquet index, ready for [bold]dope train[/]

    [bold]dope prep photos[/] packs labelled photos that need no cameras, for evaluation alone.

    [bold]dope prep status WORK[/] tells how far each sequence came; [bold]dope prep report WORK[/] shows it on a page;
    [bold]dope prep export WORK[/] hands cameras to other tools.

    Every stage takes --shard-index I --num-shards N (or reads the array variables of Slurm, AWS Batch and
    Kubernetes), so that N containers can share one WORK folder; start a stage when all parts of the one before it
    have ended. Exit code: 0 all ok, 1 some sequences failed and the table says which and why, 2 wrong usage.
    """,
)

app.command("run")(run)
app.command("colmap")(colmap)
app.command("co3d")(co3d)
app.command("render")(render)
app.command("masks")(masks)
app.command("correspond")(correspond)
app.command("shards")(shards)
app.command("photos")(photos)
app.command("status")(status)
app.command("report")(report)
app.command("export")(export)
