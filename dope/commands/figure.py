"""`dope figure`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from dope.commands.options import Device, Run, Shards, check_choice, device_name


def figure(
    run: Run,
    shards: Shards,
    out: Annotated[Path, typer.Option("--out", help="Folder for the PNG files.")] = Path("figures"),
    kind: Annotated[str, typer.Option(help="colouring: the same parts in the same colours; heatmap.")] = "colouring",
    sequence: Annotated[
        list[str] | None, typer.Option(help="Which objects; repeatable.", show_default="the first few")
    ] = None,
    views: Annotated[int, typer.Option(help="Views of an object.")] = 6,
    limit: Annotated[int, typer.Option(help="Objects, where none is named.")] = 3,
    masks: Annotated[str, typer.Option(help="predicted by the network, or given in the shards.")] = "predicted",
    colours: Annotated[
        str, typer.Option(help="colouring: by position, or pca: by the descriptors' principal components.")
    ] = "position",
    point: Annotated[
        tuple[float, float] | None,
        typer.Option(help="heatmap: x y in pixels of the first view.", show_default="the object's middle"),
    ] = None,
    device: Device = "auto",
) -> None:
    """Pictures of what a checkpoint has learnt, as PNG files.

    colouring: pixels of the first view get colours, those of the others the colour of their nearest descriptor.
    heatmap: a point of the first view, and how similar every pixel of the other views is to it.

    Example:

      dope figure run shards --sequence mug_2 --out figures
    """
    from dope.checkpoints import find_checkpoint
    from dope.figures import draw_figures

    check_choice(kind, "--kind", ("colouring", "heatmap"))
    check_choice(masks, "--masks", ("predicted", "given"))
    check_choice(colours, "--colours", ("position", "pca"))
    options: dict[str, Any] = {"kind": kind, "masks": masks, "colours": colours, "point": point}
    options |= {"sequences": sequence, "views": views, "limit": limit, "device": device_name(device)}
    for path in draw_figures(find_checkpoint(run), shards, out, **options):
        typer.echo(path)
