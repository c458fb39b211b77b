"""`dope prep correspond`: views, pairs and pixel correspondences."""

from __future__ import annotations

from typing import Annotated

import typer

from pipeline.commands.options import (
    AsJson,
    ConfigFile,
    Memory,
    Minutes,
    NumShards,
    Overwrite,
    RetryFailed,
    ShardIndex,
    Work,
    Workers,
    any_setting,
    chosen_sequences,
    resolve_config,
    run_options,
)


def correspond(
    work: Work,
    every: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Make a view of every k-th kept frame; of more where fewer than views.min_views=20 would be left.",
            show_default="3",
        ),
    ] = None,
    max_pairs: Annotated[
        int | None, typer.Option(min=1, help="Most view pairs of a sequence.", show_default="64")
    ] = None,
    only: Annotated[list[str] | None, typer.Option("--sequence", help="Only these ids.", show_default=False)] = None,
    config: ConfigFile = None,
    set_: Annotated[list[str] | None, any_setting("pairs.max_angle_deg=60")] = None,
    workers: Workers = 0,
    minutes: Minutes = 60.0,
    memory_gib: Memory = 8.0,
    shard_index: ShardIndex = None,
    num_shards: NumShards = None,
    overwrite: Overwrite = False,
    retry_failed: RetryFailed = False,
    as_json: AsJson = False,
) -> None:
    """Views of 224x224 around the object, view pairs by angle and overlap, and pixel correspondences.

    A pixel of the object is carried into the other view by its depth and the cameras; it counts where that view's
    depth agrees (no occlusion) and leads back to the same pixel.

    Example:

      dope prep correspond work --every 3
    """
    from pipeline.console import Display, exit_code, show_rows
    from pipeline.correspond.match import CorrespondConfig
    from pipeline.engines import find_share
    from pipeline.prepare import correspond_all

    flags = {"views.every": every, "pairs.max_pairs": max_pairs}
    resolved = resolve_config(CorrespondConfig, config, flags, set_)
    chosen = find_share(shard_index, num_shards).of(chosen_sequences(work, only))
    options = run_options(workers, 1, minutes, memory_gib, overwrite, retry_failed)
    with Display(len(chosen), "prep correspond").showing() as display:
        rows = correspond_all(chosen, resolved, options, display)
    show_rows(rows, as_json=as_json)
    raise typer.Exit(exit_code(rows))
