"""`dope prep run`: every stage in one go."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    chosen_sequences,
    resolve_config,
    run_options,
)

if TYPE_CHECKING:
    from pipeline.engines import Share
    from pipeline.inputs.sources import SourceError
    from pipeline.run import Item, RunConfig


def run(
    out: Annotated[Path, typer.Option("--out", help="WORK: the folder of prepared sequences.", show_default=False)],
    inputs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[INPUT...]",
            help="Videos, photo folders, or folders of them. Without any, what --out holds is taken further.",
            show_default=False,
        ),
    ] = None,
    shards: Annotated[
        Path | None,
        typer.Option(help="SHARDS: pack all of WORK in it when every sequence is done.", show_default=False),
    ] = None,
    category: Annotated[
        str | None, typer.Option(help="Category of all inputs; used in evaluation only.", show_default=False)
    ] = None,
    category_from: Annotated[
        str, typer.Option(help="none, or parent: the name of the folder that holds the video.")
    ] = "none",
    masks: Annotated[
        str | None,
        typer.Option(
            help="Masks that are there before reconstruction, as `prep colmap` takes them, e.g. '{}/masks'.",
            show_default=False,
        ),
    ] = None,
    mask_features: Annotated[
        bool, typer.Option("--mask-features", help="Features on the object only: for turntables.")
    ] = False,
    masks_from: Annotated[
        str | None,
        typer.Option(
            "--masks-from",
            help="Masks to import after reconstruction, as `prep masks --from` takes them.",
            show_default=False,
        ),
    ] = None,
    reuse_cameras: Annotated[
        str | None,
        typer.Option(
            "--reuse-cameras",
            help="Cameras found by other tools, as `prep colmap` takes them, e.g. '{}/transforms.json'.",
            show_default=False,
        ),
    ] = None,
    depths: Annotated[
        str | None,
        typer.Option(
            help="Depth maps made by other tools, as `prep colmap` takes them, e.g. '{}/depths'.", show_default=False
        ),
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
    views_every: Annotated[
        int | None, typer.Option(min=1, help="Make a view of every k-th kept frame.", show_default="3")
    ] = None,
    max_pairs: Annotated[
        int | None, typer.Option(min=1, help="Most view pairs of a sequence.", show_default="64")
    ] = None,
    holdout: Annotated[
        str | None, typer.Option(help="What validation sees: frames, sequences or none.", show_default="frames")
    ] = None,
    config: ConfigFile = None,
    set_: Annotated[list[str] | None, any_setting("sfm.max_image_size=800 or views.every=1")] = None,
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
    """Everything in one go: frames, cameras, depth, masks, correspondences, and shards at the end.

    Each sequence goes through all its stages without waiting for others. What one does with the single commands and
    with this one is the same work: each goes on where the other stopped. Ctrl-C or SIGTERM at any moment; the same
    command goes on. A sequence that fails never stops the others: the shards are made of those that are ok.

    Settings have the stages' sections: frames, sfm, depth, masks, views, pairs, match, shards (`prep masks --set
    threshold=0.3` is --set masks.threshold=0.3 here). In an array job, the part that ends last writes the shards.

    Without INPUT, frames, cameras and depth stay as they are: their settings are refused, and --overwrite makes masks,
    correspondences and shards anew.

    Examples:

      dope prep run videos/ --category-from parent --out work --shards shards

      dope prep run turntable/ --masks '{}/masks' --mask-features --out work --shards shards

      dope prep co3d CO3D --category apple --out work && dope prep run --out work --shards shards
    """
    from pipeline.console import Display, exit_code, show_rows
    from pipeline.engines import find_share, interrupted_by_sigterm
    from pipeline.inputs.sources import input_errors_as_rows
    from pipeline.masks.places import is_shared
    from pipeline.refused import keep_refused
    from pipeline.run import RunConfig, run_all
    from pipeline.shards.dataset import check_output

    flags: dict[str, Any] = {
        "frames.count": count,
        "frames.long_side": long_side,
        "sfm.matching": matching,
        "sfm.mask_features": True if mask_features else None,
        "views.every": views_every,
        "pairs.max_pairs": max_pairs,
        "shards.holdout": holdout,
    }
    resolved = resolve_config(RunConfig, config, flags, set_)
    if not inputs:
        _refuse_without_input(
            resolved,
            {"--category": category, "--category-from": None if category_from == "none" else category_from}
            | {"--masks": masks, "--reuse-cameras": reuse_cameras, "--depths": depths},
        )
    share = find_share(shard_index, num_shards)
    options = run_options(workers, threads, minutes, memory_gib, overwrite, retry_failed)
    if shards is not None:
        check_output(shards, resolved.shards)  # now, not after hours
    with interrupted_by_sigterm():
        beside = {"masks": masks, "cameras": reuse_cameras, "depths": depths}
        items, errors = _items(inputs or [], out, category, category_from, beside, masks_from)
        mine = share.of(items)
        one_for_all = is_shared({item.folder.name: item.masks for item in items if item.masks is not None})
        resolved = replace(resolved, masks=replace(resolved.masks, shared=resolved.masks.shared or one_for_all))
        with Display(len(mine), "prep run").showing() as display:
            rows = run_all(mine, resolved, options, display)
        unusable = input_errors_as_rows(errors)
        first = share.index == 0  # tells what belongs to no part of an array job
        rows += unusable if first else []
        if inputs:
            others = {item.folder.name for item in items} - {item.folder.name for item in mine}
            others |= set() if first else {row.sequence for row in unusable}
            keep_refused(out, rows, elsewhere=others)
        show_rows(rows, as_json=as_json)
        complete = shards is None or _pack(items, out, shards, resolved, share, overwrite=overwrite, as_json=as_json)
    raise typer.Exit(exit_code(rows) if complete else 1)


def _refuse_without_input(config: RunConfig, options: dict[str, str | None]) -> None:
    """Raise `UsageError` for what has no effect on sequences that WORK holds already: whoever gives it means it."""
    from dope.common import settings
    from dope.common.errors import UsageError
    from pipeline.prepare import COLMAP_STAGES
    from pipeline.run import RunConfig

    given, default = settings.to_dict(config), settings.to_dict(RunConfig())
    names = [option for option, value in options.items() if value is not None]
    for stage in COLMAP_STAGES:
        names += [f"{stage}.{key}" for key, value in given[stage].items() if value != default[stage][key]]
    if names:
        raise UsageError(
            f"without INPUT, frames, cameras and depth stay as they are: {', '.join(names)} would have no effect",
            remedy="Name the videos or photo folders, or leave these settings out",
        )


def _items(
    inputs: list[Path],
    out: Path,
    category: str | None,
    category_from: str,
    beside: dict[str, str | None],
    masks_from: str | None,
) -> tuple[list[Item], list[SourceError]]:
    """The sequences of the run, in all parts of an array job, and the inputs that cannot be used."""
    from pipeline.inputs.sources import find_sources, known_sources
    from pipeline.masks.places import find_masks
    from pipeline.run import items_of
    from pipeline.sequence import find_sequences

    sources, errors = find_sources(
        inputs,
        category=category,
        category_from=category_from,
        masks_later=masks_from,
        known=known_sources(out),
        **beside,
    )
    held = [] if inputs else chosen_sequences(out, None)
    there = [sequence.id for sequence in find_sequences(out)] if out.is_dir() else []
    names = sorted({source.id for source in sources} | set(there))
    folders = find_masks(masks_from, names) if masks_from else {}
    return items_of(sources, held, folders, out), errors


def _pack(
    items: list[Item], work: Path, out: Path, config: RunConfig, share: Share, *, overwrite: bool, as_json: bool
) -> bool:
    """Write the shards, or say which sequences of other parts they wait for. False where sequences were left out."""
    from dope.common.progress import progress_bar
    from pipeline.console import show_shards
    from pipeline.run import still_to_do
    from pipeline.sequence import find_sequences
    from pipeline.shards.dataset import write_shards

    if waiting := still_to_do(items, config, share):
        if as_json:
            typer.echo(json.dumps({"out": str(out), "waiting_for_sequences": waiting}, ensure_ascii=False))
        else:
            names = ", ".join(waiting[:5]) + (" ..." if len(waiting) > 5 else "")
            typer.echo(f"{out}: written by the part that ends last; {len(waiting)} sequences are to be done: {names}")
        return True
    with progress_bar() as progress:
        sequences = list(find_sequences(work)) if work.is_dir() else []
        details = write_shards(
            sequences,
            out,
            config.shards,
            lambda done, of: progress("samples", done, of),
            overwrite=overwrite,
            wait=True,
        )
    show_shards(out, details, as_json=as_json)
    return not details["left_out"]
