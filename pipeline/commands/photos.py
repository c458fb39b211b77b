"""`dope prep photos`: labelled photos to single views for evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.commands.options import ConfigFile, Overwrite, any_setting, resolve_config

SHOWN = 8  # photos that are left out, in the table


def photos(
    folder: Annotated[
        Path, typer.Argument(metavar="PHOTOS", help="Folder of CATEGORY/OBJECT/photo.jpg.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", help="SHARDS: the folder to write, whole or not at all.")],
    crop: Annotated[
        str | None,
        typer.Option(help="object: the square around it, where there is a mask; whole.", show_default="object"),
    ] = None,
    size: Annotated[int | None, typer.Option(min=16, help="Side of the views, pixels.", show_default="224")] = None,
    config: ConfigFile = None,
    set_: Annotated[list[str] | None, any_setting("margin=0.2")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Labelled photos without cameras to shards of single views, to evaluate low-shot recognition on.

    Photos lie in CATEGORY/OBJECT/, or in CATEGORY/OBJECT/images/ with masks of the same names (PNG) in
    CATEGORY/OBJECT/masks/. Nothing is reconstructed: the shards have no pairs and cannot be trained on by methods
    that need two views. A photo that cannot be read is left out and named; the exit code is then 1.

    Example:

      dope prep photos eth80/ --out photos

      dope eval run photos --ways 4 --shots 1 --queries 5
    """
    from rich.console import Console
    from rich.markup import escape

    from dope.common.progress import progress_bar
    from pipeline.shards.labelled_photos import PhotosConfig, write_photos

    resolved = resolve_config(PhotosConfig, config, {"crop": crop, "size": size}, set_)
    with progress_bar() as progress:
        details = write_photos(folder, out, resolved, lambda n, of: progress("photos", n, of), overwrite=overwrite)
    console, left_out = Console(highlight=False), details["left_out"]
    masks = f", {details['without_mask']} of them without a mask" if details["without_mask"] else ""
    done = " (was there already)" if details["skipped"] else ""
    console.print(
        f"{escape(str(out))}: {details['views']:,} views{masks} of {details['objects']} objects in "
        f"{details['categories']} categories{done}",
        soft_wrap=True,
    )
    for path, reason in list(left_out.items())[:SHOWN]:
        console.print(f"  left out {escape(path)}: {escape(reason)}", soft_wrap=True)
    if len(left_out) > SHOWN:
        console.print(f"  ... and {len(left_out) - SHOWN} more (dataset.json lists them)")
    raise typer.Exit(1 if left_out else 0)
