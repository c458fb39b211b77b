"""`dope prep masks`: the object in every frame."""

from __future__ import annotations

import json
from dataclasses import replace
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
    Work,
    Workers,
    any_setting,
    chosen_sequences,
    resolve_config,
    run_options,
)


def masks(
    work: Work,
    from_: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="Your masks: a folder that holds <sequence>/<frame>.png, or the masks themselves where WORK has one "
            "sequence; or instances in COCO's format, results.json for all or <sequence>.json in a folder. Without it, "
            "masks that came with the input are kept, and GrabCut makes the rest.",
            show_default=False,
        ),
    ] = None,
    pick: Annotated[
        str | None,
        typer.Option(
            help="Which instance of a frame is the object: consistent (score x agreement with the other views), centre "
            "(score x nearness to the object's centre), score, area (the largest).",
            show_default="consistent",
            rich_help_panel="Instances",
        ),
    ] = None,
    min_score: Annotated[
        float | None,
        typer.Option(help="Leave out instances with a lower score.", show_default="0", rich_help_panel="Instances"),
    ] = None,
    category_id: Annotated[
        list[int] | None,
        typer.Option(help="Only instances of this category.", show_default=False, rich_help_panel="Instances"),
    ] = None,
    category_name: Annotated[
        list[str] | None,
        typer.Option(help="The same by its name.", show_default=False, rich_help_panel="Instances"),
    ] = None,
    coco_images: Annotated[
        Path | None,
        typer.Option(
            help="Which image an image_id is, where the results do not say: a COCO dataset file, or {id: file name}.",
            show_default=False,
            rich_help_panel="Instances",
        ),
    ] = None,
    on_flag: Annotated[
        str | None,
        typer.Option(
            help="What happens to a mask that disagrees with the other views: drop (the frame has none) or keep.",
            show_default="drop",
        ),
    ] = None,
    only: Annotated[list[str] | None, typer.Option("--sequence", help="Only these ids.", show_default=False)] = None,
    config: ConfigFile = None,
    set_: Annotated[list[str] | None, any_setting("grabcut.radius=1.0")] = None,
    workers: Workers = 0,
    minutes: Minutes = 60.0,
    memory_gib: Memory = 8.0,
    shard_index: ShardIndex = None,
    num_shards: NumShards = None,
    overwrite: Overwrite = False,
    retry_failed: RetryFailed = False,
    as_json: AsJson = False,
) -> None:
    """The object's mask in every frame: imported, or cut out by GrabCut around the sparse points.

    Masks are PNGs of any bit depth, matched by the frame's file name (or number, for videos), of the size of the
    source image or of the stored one. Where their size does not tell, --set lying=yes says that they lie as the photos
    do without their EXIF orientation. A tool that finds many instances in an image (detectron2's PointRend, FreeSOLO)
    hands over one JSON file of them; --pick says which one of a frame is the object.

    Where there are cameras, every mask is compared with the visual hull of the other views'; those that disagree are
    flagged in the table, and left out.

    Examples:

      dope prep masks work --from my_masks/

      dope prep masks work --from soft_masks/ --set threshold=0.4

      dope prep masks work --from coco_instances_results.json --coco-images dataset.json --category-name apple

      dope prep masks work --from free_masks.json --pick score --min-score 0.7
    """
    from pipeline.console import Display, exit_code, show_rows
    from pipeline.engines import find_share
    from pipeline.masks.imported import MasksConfig
    from pipeline.masks.places import find_masks, is_shared
    from pipeline.prepare import add_masks

    flags: dict[str, Any] = {
        "pick": pick,
        "min_score": min_score,
        "category_ids": json.dumps(category_id) if category_id else None,
        "category_names": json.dumps(category_name) if category_name else None,
        "coco_images": json.dumps(str(coco_images)) if coco_images else None,
        "on_flag": on_flag,
    }
    resolved = resolve_config(MasksConfig, config, flags, set_)
    share = find_share(shard_index, num_shards)
    everything = chosen_sequences(work, only)
    chosen = share.of(everything)
    # looked up for all, so that every part of an array job reads --from the same way
    folders = find_masks(from_, [sequence.id for sequence in everything]) if from_ else {}
    resolved = replace(resolved, shared=resolved.shared or is_shared(folders))
    without = [sequence.id for sequence in chosen if from_ and sequence.id not in folders]
    options = run_options(workers, 1, minutes, memory_gib, overwrite, retry_failed)
    with Display(len(chosen), "prep masks").showing() as display:
        rows = add_masks(chosen, resolved, folders, options, display)
    if without:
        typer.echo(f"{from_} has no masks for {', '.join(without)}: see the table for whose masks they have", err=True)
    show_rows(rows, as_json=as_json)
    raise typer.Exit(exit_code(rows))
