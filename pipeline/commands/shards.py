"""`dope prep shards`: tars and an index."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.commands.options import AsJson, ConfigFile, NumShards, Overwrite, ShardIndex, any_setting, resolve_config


def shards(
    work: Annotated[
        list[Path], typer.Argument(metavar="WORK...", help="Folders of prepared sequences.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", help="SHARDS: the folder to write, whole or not at all.")],
    holdout: Annotated[
        str | None, typer.Option(help="What validation sees: frames, sequences or none.", show_default="frames")
    ] = None,
    val_fraction: Annotated[float | None, typer.Option(help="Share that is held out.", show_default="0.25")] = None,
    config: ConfigFile = None,
    set_: Annotated[list[str] | None, any_setting("samples_per_shard=512")] = None,
    verify: Annotated[bool, typer.Option("--verify", help="Check every byte against dataset.json afterwards.")] = False,
    shard_index: ShardIndex = None,
    num_shards: NumShards = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """WebDataset tars of view pairs and of single views, index.parquet and dataset.json.

    An epoch that streams from start to end sees every object once before any object's second pair. Held-out pairs
    (split val) share no view with training pairs. The same input and settings give the same bytes. With
    --num-shards, each container writes its tars and the last one to finish writes the index.

    Example:

      dope prep shards work --out shards --holdout sequences
    """
    from dope.common.progress import progress_bar
    from pipeline.console import show_shards
    from pipeline.engines import find_share
    from pipeline.sequence import find_sequences
    from pipeline.shards.dataset import verify_shards, write_shards
    from pipeline.shards.plan import ShardsConfig

    resolved = resolve_config(ShardsConfig, config, {"holdout": holdout, "val_fraction": val_fraction}, set_)
    share = find_share(shard_index, num_shards)
    sequences = [sequence for folder in work for sequence in find_sequences(folder)]
    with progress_bar() as progress:
        details = write_shards(
            sequences, out, resolved, lambda done, of: progress("samples", done, of), overwrite=overwrite, share=share
        )
    if verify and not details.get("waiting_for"):
        details["verified"] = verify_shards(out)
    show_shards(out, details, as_json=as_json)
    raise typer.Exit(1 if details["left_out"] else 0)
