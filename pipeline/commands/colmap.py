"""`dope prep colmap`: frames, cameras and depth of videos and photo folders."""

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


def colmap(
    inputs: Annotated[
        list[Path],
        typer.Argument(metavar="INPUT...", help="Videos, photo folders, or folders of them.", show_default=False),
    ],
    out: Annotated[Path, typer.Option("--out", help="WORK: the folder to write to.", show_default=False)],
    category: Annotated[
        str | None, typer.Option(help="Category of all inputs; used in evaluation only.", show_default=False)
    ] = None,
    category_from: Annotated[
        str, typer.Option(help="none, or parent: the name of the folder that holds the video.")
    ] = "none",
    masks: Annotated[
        str | None,
        typer.Option(
            help="Masks that are there before reconstruction: a folder (of folders by sequence), a file of results in "
            "COCO's format, or a pattern with {} for the input, e.g. '{}/masks'.",
            show_default=False,
        ),
    ] = None,
    mask_features: Annotated[
        bool, typer.Option("--mask-features", help="Features on the object only: for turntables.")
    ] = False,
    reuse_cameras: Annotated[
        str | None,
        typer.Option(
            "--reuse-cameras",
            help="Cameras found by other tools, instead of reconstruction: the folder of a COLMAP model (text or bin), "
            "a nerfstudio transforms.json, or a cameras.json; {} stands for the input. Found by the photos' "
            "names, or the frames' numbers in a video from 0, and refused where the images contradict them.",
            show_default=False,
        ),
    ] = None,
    depths: Annotated[
        str | None,
        typer.Option(
            help="Depth maps made by other tools, instead of stereo: a folder (of folders by sequence) or a pattern "
            "with {} for the input, e.g. '{}/depths'.",
            show_default=False,
        ),
    ] = None,
    every: Annotated[
        int | None, typer.Option(min=1, help="Take every k-th frame of a video, or photo.", show_default=False)
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(min=1, help="Take about this many frames.", show_default="60 of a video, all photos"),
    ] = None,
    long_side: Annotated[
        int | None, typer.Option(min=1, help="Cap of the long side, pixels.", show_default="1024")
    ] = None,
    matching: Annotated[
        str | None, typer.Option(help="auto, sequential, exhaustive or similar.", show_default="auto")
    ] = None,
    camera_model: Annotated[
        str | None,
        typer.Option(
            help="SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV.",
            show_default="SIMPLE_RADIAL; OPENCV with --intrinsics",
        ),
    ] = None,
    intrinsics: Annotated[
        str | None,
        typer.Option(
            metavar="FX,FY,CX,CY[,K1,K2,P1,P2]",
            help="Known lens, pixels of the source images; kept as it is (--set sfm.refine_intrinsics=true refines).",
            show_default=False,
        ),
    ] = None,
    focal_mm: Annotated[
        float | None,
        typer.Option(
            help="Focal length as 35 mm equivalent, where refinement starts.", show_default="EXIF of the photos, if any"
        ),
    ] = None,
    depth: Annotated[str | None, typer.Option(help="sparse or dense.", show_default="dense")] = None,
    config: ConfigFile = None,
    set_: Annotated[list[str] | None, any_setting("sfm.max_image_size=800")] = None,
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
    """Frames, cameras and depth maps of videos and photo folders, one sequence each.

    A folder with an images/ folder in it is one sequence; a folder of videos or of photo folders is many. Folders are
    searched to any depth; those named masks, depths or segmentations, and those given, are no captures.

    Examples:

      dope prep colmap phone.mp4 --out work

      dope prep colmap videos/ --category-from parent --out work     (videos/<category>/<instance>.mp4)

      dope prep colmap turntable/ --masks '{}/masks' --mask-features --out work

      dope prep colmap scans/ --intrinsics 1450,1450,960,540 --out work

      dope prep colmap scans/ --reuse-cameras '{}/transforms.json' --depths '{}/depths' --out work
    """
    from pipeline.cameras.intrinsics import parse_intrinsics
    from pipeline.console import Display, exit_code, show_rows
    from pipeline.engines import find_share
    from pipeline.inputs.sources import find_sources, input_errors_as_rows, known_sources
    from pipeline.prepare import ColmapConfig, prepare
    from pipeline.refused import keep_refused

    flags: dict[str, Any] = {
        "frames.every": every,
        "frames.count": count,
        "frames.long_side": long_side,
        "sfm.matching": matching,
        "sfm.mask_features": True if mask_features else None,
        "sfm.camera_model": camera_model,
        "sfm.intrinsics": None if intrinsics is None else parse_intrinsics(intrinsics),
        "sfm.focal_mm": focal_mm,
        "depth.mode": depth,
    }
    resolved = resolve_config(ColmapConfig, config, flags, set_)
    share = find_share(shard_index, num_shards)
    sources, errors = find_sources(
        inputs,
        category=category,
        category_from=category_from,
        masks=masks,
        cameras=reuse_cameras,
        depths=depths,
        known=known_sources(out),
    )
    options = run_options(workers, threads, minutes, memory_gib, overwrite, retry_failed)
    mine = share.of(sources)
    with Display(len(mine), "prep colmap").showing() as display:
        rows = prepare(mine, out, resolved, options, display)
    unusable = input_errors_as_rows(errors)
    first = share.index == 0  # tells what belongs to no part of an array job
    rows += unusable if first else []
    others = {source.id for source in sources} - {source.id for source in mine}
    others |= set() if first else {row.sequence for row in unusable}
    keep_refused(out, rows, elsewhere=others)
    show_rows(rows, as_json=as_json)
    raise typer.Exit(exit_code(rows))
