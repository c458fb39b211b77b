"""`dope prep co3d`: sequences of a CO3D download, with their own cameras, masks and depth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

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
    Threads,
    Workers,
    any_setting,
    resolve_config,
    run_options,
)

CHOOSING, FRAMES = "Which sequences", "Frames, points and depth"


def co3d(
    root: Annotated[
        Path, typer.Argument(metavar="ROOT", help="The download: the folder of the categories.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", help="WORK: the folder to write to.", show_default=False)],
    category: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this category; may be repeated.", show_default="all there are", rich_help_panel=CHOOSING
        ),
    ] = None,
    subset: Annotated[
        list[str] | None,
        typer.Option(
            help="Only frames of this set list, e.g. fewview_dev (v2), or of this set, e.g. train_known (v1); may be "
            "repeated.",
            show_default="all frames",
            rich_help_panel=CHOOSING,
        ),
    ] = None,
    sets: Annotated[
        list[str] | None,
        typer.Option(
            "--split",
            help="Only frames of this set within the set lists: train, val, test (v2), train_known ... (v1); may be "
            "repeated.",
            show_default="all sets",
            rich_help_panel=CHOOSING,
        ),
    ] = None,
    sequence: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this sequence (CO3D's name, or the id in WORK); may be repeated.",
            show_default="all",
            rich_help_panel=CHOOSING,
        ),
    ] = None,
    limit: Annotated[
        int | None,
        typer.Option(min=1, help="At most so many of each category.", show_default="all", rich_help_panel=CHOOSING),
    ] = None,
    min_viewpoint_quality: Annotated[
        float | None,
        typer.Option(
            help="Leave out sequences whose cameras have a lower score, or none.",
            show_default="keep all",
            rich_help_panel=CHOOSING,
        ),
    ] = None,
    min_point_cloud_quality: Annotated[
        float | None,
        typer.Option(
            help="Leave out sequences whose point cloud has a lower score, or none.",
            show_default="keep all",
            rich_help_panel=CHOOSING,
        ),
    ] = None,
    every: Annotated[
        int | None,
        typer.Option(min=1, help="Take every k-th frame, by frame number.", show_default="3", rich_help_panel=FRAMES),
    ] = None,
    long_side: Annotated[
        int | None,
        typer.Option(min=1, help="Cap of the long side, pixels.", show_default="1024", rich_help_panel=FRAMES),
    ] = None,
    mask_threshold: Annotated[
        float | None,
        typer.Option(
            min=0, max=1, help="Object is above this share of white.", show_default="0.4", rich_help_panel=FRAMES
        ),
    ] = None,
    points: Annotated[
        str | None,
        typer.Option(
            help="Where the object is, from: cloud (its point cloud), depth, matches, or auto (the first there is).",
            show_default="auto",
            rich_help_panel=FRAMES,
        ),
    ] = None,
    depth: Annotated[
        str | None,
        typer.Option(
            help="given (CO3D's depth maps), stereo (our own), or either (stereo where none is given).",
            show_default="given",
            rich_help_panel=FRAMES,
        ),
    ] = None,
    config: ConfigFile = None,
    set_: Annotated[list[str] | None, any_setting("frames.min_frames=10")] = None,
    workers: Workers = 0,
    threads: Threads = 1,
    minutes: Minutes = 60.0,
    memory_gib: Memory = 8.0,
    shard_index: ShardIndex = None,
    num_shards: NumShards = None,
    overwrite: Overwrite = False,
    retry_failed: RetryFailed = False,
    as_json: AsJson = False,
) -> None:
    """Frames, cameras, masks and depth of the sequences of a CO3D download (v1 or v2, found out by itself).

    The annotations of a category are read once, as a stream, into WORK/.co3d; a sequence is named
    <category>_<sequence>. Frames that cannot be used (redacted, not downloaded, without a camera, leading outside
    ROOT) are dropped with their reason. Sequences left out for their scores are listed, and do not count as failures.
    CO3D is licensed for non-commercial use (CC BY-NC 4.0): each sequence.json says so.

    Examples:

      dope prep co3d co3d/ --category apple --limit 3 --out work     (a first look)

      dope prep co3d co3d/ --min-viewpoint-quality 0.5 --out work    (all categories, every third frame)

      dope prep co3d co3dv2/ --category hydrant --subset fewview_dev --split train --out work

      dope prep co3d co3d/ --category car --depth either --every 1 --out work

    Then: dope prep correspond work; dope prep shards work --out shards
    """
    from pipeline.co3d.prepare import Co3dConfig, prepare_co3d
    from pipeline.co3d.sources import Choice, find_co3d
    from pipeline.console import Display, exit_code, show_rows
    from pipeline.engines import find_share
    from pipeline.refused import keep_refused

    flags: dict[str, Any] = {
        "frames.every": every,
        "frames.long_side": long_side,
        "frames.mask_threshold": mask_threshold,
        "maps.points": points,
        "maps.depth": depth,
    }
    resolved = resolve_config(Co3dConfig, config, flags, set_)
    share = find_share(shard_index, num_shards)
    choice = Choice(
        categories=category or [],
        subsets=subset or [],
        sets=sets or [],
        sequences=sequence or [],
        min_viewpoint_quality=min_viewpoint_quality,
        min_point_cloud_quality=min_point_cloud_quality,
        limit=limit,
    )
    options = run_options(workers, threads, minutes, memory_gib, overwrite, retry_failed)
    sources, failed, left_out = find_co3d(root, out, choice, lambda text: typer.echo(text, err=True))
    mine = share.of(sources)
    with Display(len(mine), "prep co3d").showing() as display:
        rows = prepare_co3d(mine, out, resolved, options, display)
    first = share.index == 0  # what belongs to no part of an array job is told by the first
    rows += failed if first else []
    others = {source.id for source in sources} - {source.id for source in mine}
    keep_refused(out, rows, elsewhere=others | (set() if first else {row.sequence for row in failed}))
    show_rows([*rows, *(left_out if first else [])], as_json=as_json)
    raise typer.Exit(exit_code(rows))
