"""`dope prep ...`: parse, call one function, print. Heavy imports happen inside the commands."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dope.common.errors import UsageError

if TYPE_CHECKING:
    from pipeline.prepare import RunOptions
    from pipeline.sequence import Sequence

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="""Turn videos and photo folders into shards of pixel correspondences.

    The stages, in order; each does only what is missing, and may be run again at any time:

      1. [bold]dope prep colmap[/]      frames, cameras (COLMAP) and depth maps of each video or photo folder

      2. [bold]dope prep masks[/]       the object's mask in every frame: yours, or cut out by GrabCut

      3. [bold]dope prep correspond[/]  224 px views around the object, view pairs, pixel correspondences

      4. [bold]dope prep shards[/]      WebDataset tars and a Parquet index, ready for [bold]dope train[/]

    Every stage takes --shard-index I --num-shards N (or reads the array variables of Slurm, AWS Batch and
    Kubernetes), so that N containers can share one WORK folder; start a stage when all parts of the one before it
    have ended. Exit code: 0 all ok, 1 some sequences failed and the table says which and why, 2 wrong usage.
    """,
)

Work = Annotated[Path, typer.Argument(help="The folder that `dope prep colmap --out` wrote.", show_default=False)]
Workers = Annotated[
    int, typer.Option(min=0, help="Sequences at a time; 0 = one for each CPU.", rich_help_panel="Running")
]
Minutes = Annotated[float, typer.Option(help="Time limit of one sequence.", rich_help_panel="Running")]
Memory = Annotated[float, typer.Option(help="Memory limit of one sequence, GiB.", rich_help_panel="Running")]
Threads = Annotated[
    int,
    typer.Option(
        min=1, help="Native threads in a sequence; only 1 repeats COLMAP to the bit.", rich_help_panel="Running"
    ),
]
ShardIndex = Annotated[
    int | None,
    typer.Option(min=0, help="This container's part, from 0.", show_default=False, rich_help_panel="Array jobs"),
]
NumShards = Annotated[
    int | None, typer.Option(min=1, help="Number of parts.", show_default=False, rich_help_panel="Array jobs")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Do it again even where it is done.")]
RetryFailed = Annotated[bool, typer.Option("--retry-failed", help="Try the sequences again that failed before.")]
AsJson = Annotated[bool, typer.Option("--json", help="Rows as JSON lines instead of a table.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML file of settings.", show_default=False)]


def _any_setting(example: str) -> Any:
    text = f"Any setting, e.g. {example}; a wrong name is answered with the nearest."
    return typer.Option("--set", metavar="KEY=VALUE", help=text, show_default=False)


@app.command()
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
            help="Masks that are there before reconstruction: a folder (of folders by sequence), or a pattern with "
            "{} for the input, e.g. '{}/masks'.",
            show_default=False,
        ),
    ] = None,
    mask_features: Annotated[
        bool, typer.Option("--mask-features", help="Features on the object only: for turntables.")
    ] = False,
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
    depth: Annotated[str | None, typer.Option(help="sparse or dense.", show_default="dense")] = None,
    config: ConfigFile = None,
    set_: Annotated[list[str] | None, _any_setting("sfm.max_image_size=800")] = None,
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

    A folder with an images/ folder in it is one sequence; a folder of videos or of photo folders is many.

    Examples:

      dope prep colmap phone.mp4 --out work

      dope prep colmap videos/ --category-from parent --out work     (videos/<category>/<instance>.mp4)

      dope prep colmap turntable/ --masks '{}/masks' --mask-features --out work
    """
    from pipeline.console import Display, exit_code, show_rows
    from pipeline.engines import find_share
    from pipeline.prepare import ColmapConfig, prepare
    from pipeline.sources import find_sources, input_errors_as_rows, known_sources

    flags: dict[str, Any] = {
        "frames.every": every,
        "frames.count": count,
        "frames.long_side": long_side,
        "sfm.matching": matching,
        "sfm.mask_features": True if mask_features else None,
        "depth.mode": depth,
    }
    resolved = _config(ColmapConfig, config, flags, set_)
    share = find_share(shard_index, num_shards)
    sources, errors = find_sources(
        inputs, category=category, category_from=category_from, masks=masks, known=known_sources(out)
    )
    options = _options(workers, threads, minutes, memory_gib, overwrite, retry_failed)
    mine = share.of(sources)
    with Display(len(mine), "prep colmap").showing() as display:
        rows = prepare(mine, out, resolved, options, display)
    rows += input_errors_as_rows(errors) if share.index == 0 else []
    show_rows(rows, as_json=as_json)
    raise typer.Exit(exit_code(rows))


@app.command()
def masks(
    work: Work,
    from_: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="Your masks: a folder that holds <sequence>/<frame>.png, or the masks themselves where WORK has one "
            "sequence. Without it, masks that were given to `prep colmap` are kept, and GrabCut makes the rest.",
            show_default=False,
        ),
    ] = None,
    only: Annotated[list[str] | None, typer.Option("--sequence", help="Only these ids.", show_default=False)] = None,
    config: ConfigFile = None,
    set_: Annotated[list[str] | None, _any_setting("grabcut.radius=1.0")] = None,
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
    source image or of the stored one.

    Example:

      dope prep masks work --from my_masks/
    """
    from pipeline.console import Display, exit_code, show_rows
    from pipeline.engines import find_share
    from pipeline.masks import MasksConfig, find_mask_folders
    from pipeline.prepare import add_masks

    resolved = _config(MasksConfig, config, {}, set_)
    share = find_share(shard_index, num_shards)
    everything = _chosen(work, only)
    chosen = share.of(everything)
    # looked up for all, so that every part of an array job reads --from the same way
    folders = find_mask_folders(from_, [sequence.id for sequence in everything]) if from_ else {}
    without = [sequence.id for sequence in chosen if from_ and sequence.id not in folders]
    options = _options(workers, 1, minutes, memory_gib, overwrite, retry_failed)
    with Display(len(chosen), "prep masks").showing() as display:
        rows = add_masks(chosen, resolved, folders, options, display)
    if without:
        typer.echo(f"{from_} has no folder for {', '.join(without)}: see the table for whose masks they have", err=True)
    show_rows(rows, as_json=as_json)
    raise typer.Exit(exit_code(rows))


@app.command()
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
    set_: Annotated[list[str] | None, _any_setting("pairs.max_angle_deg=60")] = None,
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
    from pipeline.correspondences import CorrespondConfig
    from pipeline.engines import find_share
    from pipeline.prepare import correspond_all

    flags = {"views.every": every, "pairs.max_pairs": max_pairs}
    resolved = _config(CorrespondConfig, config, flags, set_)
    chosen = find_share(shard_index, num_shards).of(_chosen(work, only))
    options = _options(workers, 1, minutes, memory_gib, overwrite, retry_failed)
    with Display(len(chosen), "prep correspond").showing() as display:
        rows = correspond_all(chosen, resolved, options, display)
    show_rows(rows, as_json=as_json)
    raise typer.Exit(exit_code(rows))


@app.command()
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
    set_: Annotated[list[str] | None, _any_setting("samples_per_shard=512")] = None,
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
    from pipeline.shards import ShardsConfig, verify_shards, write_shards

    resolved = _config(ShardsConfig, config, {"holdout": holdout, "val_fraction": val_fraction}, set_)
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


def _config(cls: type, path: Path | None, flags: dict[str, Any], assignments: list[str] | None) -> Any:
    """Defaults, then the YAML file, then the flags, then --set."""
    from dope.common import settings

    config = settings.from_mapping(cls, settings.load_yaml(path), where=str(path)) if path else cls()
    given = [f"{key}={value}" for key, value in flags.items() if value is not None]
    return settings.override(config, [*given, *(assignments or [])])


def _options(
    workers: int, threads: int, minutes: float, memory_gib: float, overwrite: bool, retry_failed: bool
) -> RunOptions:
    from pipeline.children import Limits
    from pipeline.engines import default_workers
    from pipeline.prepare import RunOptions

    if minutes <= 0 or memory_gib <= 0:
        raise UsageError("--minutes and --memory-gib must be positive")
    count = workers or max(1, default_workers() // threads)
    return RunOptions(count, Limits(minutes, memory_gib, threads), overwrite, retry_failed)


def _chosen(work: Path, only: list[str] | None) -> list[Sequence]:
    """The sequences of WORK that this command is about, in all parts of an array job."""
    from pipeline.sequence import find_sequences

    found = list(find_sequences(work))
    if not found:
        raise UsageError("holds no prepared sequence", where=work, remedy="Run `dope prep colmap` first")
    if only:
        unknown = sorted(set(only) - {sequence.id for sequence in found})
        if unknown:
            known = ", ".join(sequence.id for sequence in found[:10])
            raise UsageError(f"no sequence {', '.join(unknown)} here (there are {known})", where=work)
        found = [sequence for sequence in found if sequence.id in only]
    return found
