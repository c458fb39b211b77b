"""`dope train`, `dope eval` and `dope figure`: parse, call one function, print. Heavy imports happen inside."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from dope.common.errors import UsageError
from dope.preset_files import preset_names, preset_summary

Shards = Annotated[
    str,
    typer.Argument(
        help="The folder that `dope prep shards --out` wrote, or a URL of it: s3://, gs://, hf://.", show_default=False
    ),
]
Run = Annotated[Path, typer.Argument(help="A run (its newest checkpoint) or a checkpoint.", show_default=False)]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")]
PRESETS_HELP = "\n\n".join(f"{name}: {preset_summary(name)}" for name in preset_names())


def train(
    shards: Shards,
    out: Annotated[Path, typer.Option("--out", help="RUN: the folder of this run.", show_default=False)],
    preset: Annotated[str, typer.Option(help=PRESETS_HELP)] = "paper",
    config: Annotated[
        Path | None, typer.Option("--config", help="YAML file of settings, on top of the preset.", show_default=False)
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One setting, e.g. optimiser.lr=3e-4.", show_default=False),
    ] = None,
    resume: Annotated[
        str,
        typer.Option(
            help="auto: go on where RUN stopped; never: insist on a new RUN; or a checkpoint to begin from: one of RUN "
            "goes back, one of another run needs a new RUN, and the same command again goes on."
        ),
    ] = "auto",
    nproc: Annotated[int, typer.Option(min=1, help="Processes on this machine (torchrun starts them on several).")] = 1,
    max_restarts: Annotated[
        int, typer.Option(min=0, help="With --nproc: times that all processes start again after one died.")
    ] = 0,
    stop_after: Annotated[
        int | None, typer.Option(min=1, help="Stop with a checkpoint after so many steps.", show_default=False)
    ] = None,
    profile: Annotated[
        int | None,
        typer.Option(min=1, help="Profile so many steps into RUN/profile, then train on.", show_default=False),
    ] = None,
    max_bad_samples: Annotated[
        int | None,
        typer.Option(min=0, help="Damaged samples to put up with.  [default: 0]", show_default=False),
    ] = None,
    verify_shards: Annotated[
        bool,
        typer.Option(
            "--verify-shards",
            help="Read every shard whole before training and compare its SHA-256: finds changed bytes that can be "
            "decoded all the same.",
        ),
    ] = False,
) -> None:
    """Train DOPE: corresponding pixels of two views get the same descriptor, all others different ones.

    RUN receives config.yaml (all settings, to look up and to change by --set), checkpoints/, metrics.jsonl and
    tensorboard/. Run it again to go on; SIGTERM, SIGUSR1 and Ctrl-C write a checkpoint and exit with 75, on which a
    batch system can requeue.

    Slurm, in a script with #SBATCH --requeue and --signal=USR1@120 (the signal comes 120 s before the limit):
    srun dope train shards --out run || { [ $? = 75 ] && scontrol requeue $SLURM_JOB_ID; }

    When one of several processes dies, the others are ended (SIGTERM, after 30 s SIGKILL); with --max-restarts all of
    them are then started again and go on from RUN's newest checkpoint: --set checkpoint.every says how much is done
    twice. Errors that would come again, such as wrong settings, end the run.

    Examples:

      dope train shards --out run --preset nano

      dope train shards --out run --set optimiser.lr=3e-4 --set data.batch_size=64

      torchrun --nproc-per-node 4 $(which dope) train shards --out run

      dope train s3://bucket/shards --out run --set data.order=sequential
    """
    from dope.config import load_config

    overrides = [*(set_ or ()), *([] if max_bad_samples is None else [f"data.max_bad_samples={max_bad_samples}"])]
    resolved = load_config(preset, config, overrides)
    from dope.launch import as_rank, is_rank, launch

    if verify_shards and not is_rank() and os.environ.get("RANK", "0") == "0":
        from dope.shard_index import verify_hashes

        verify_hashes(shards)
    if nproc > 1 and not is_rank():
        raise typer.Exit(launch(nproc, max_restarts))

    from dope.stop_signals import EXIT_STOPPED

    with as_rank():
        from dope.trainer import train as run_training

        result = run_training(shards, out, resolved, resume=resume, stop_after=stop_after, profile=profile or 0)
    if os.environ.get("RANK", "0") == "0":
        _print_training(result, out)
    raise typer.Exit(EXIT_STOPPED if result["status"] == "stopped" and stop_after is None else 0)


def evaluate(
    run: Run,
    shards: Shards,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for results.parquet.  [default: RUN/eval]", show_default=False)
    ] = None,
    ways: Annotated[list[int] | None, typer.Option(help="Classes an episode; repeatable.  [default: 5]")] = None,
    shots: Annotated[list[int] | None, typer.Option(help="Labelled views a class; repeatable.  [default: 1]")] = None,
    queries: Annotated[int, typer.Option(help="Queries a class.")] = 15,
    episodes: Annotated[int, typer.Option(help="Episodes a setting.")] = 2500,
    classes: Annotated[
        str, typer.Option(help="category: of unseen objects; instance: which object, from other views of it.")
    ] = "category",
    shot_mode: Annotated[
        str, typer.Option(help="Shots of a category: several_instances, or one_instance seen from several sides.")
    ] = "several_instances",
    categories: Annotated[
        list[str] | None, typer.Option("--category", help="Only these; repeatable.", show_default=False)
    ] = None,
    classifier: Annotated[str, typer.Option(help="local: local matching, as in the paper; centroid.")] = "local",
    split: Annotated[str, typer.Option(help="Views of the shards: all, train or val.")] = "all",
    fit: Annotated[bool, typer.Option("--fit", help="Fewer ways or queries where the views do not suffice.")] = False,
    compare_untrained: Annotated[
        bool, typer.Option("--compare-untrained", help="The same episodes with random weights, too.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the episodes.")] = 0,
    memory_gb: Annotated[float, typer.Option(help="Descriptors kept in memory; beyond it, encoded again.")] = 4.0,
    device: Device = "auto",
) -> None:
    """Low-shot recognition: accuracy over random episodes with its 95% confidence interval, beside chance.

    A query is compared with every labelled view by local matching of its dense descriptors (paper, section 4).

    Examples:

      dope eval run shards --ways 5 --ways 10 --shots 1 --shots 5

      dope eval run shards --classes instance --split val --ways 5 --queries 2
    """
    from rich.console import Console

    from dope.checkpoints import find_checkpoint
    from dope.common import settings
    from dope.common.progress import progress_bar
    from dope.lowshot.episodes import EpisodeConfig
    from dope.lowshot.evaluate import EvaluationConfig
    from dope.lowshot.evaluate import evaluate as run_evaluation
    from dope.lowshot.results import append_rows, results_table

    episode: dict[str, Any] = {
        "queries": queries, "episodes": episodes, "seed": seed, "classes": classes, "fit": fit,
        "shot_mode": shot_mode,
    }  # fmt: skip
    protocols = tuple(
        settings.from_mapping(EpisodeConfig, {**episode, "ways": way, "shots": shot}, where="dope eval")
        for way in ways or [5]
        for shot in shots or [1]
    )
    values: dict[str, Any] = {"classifier": classifier, "split": split, "compare_untrained": compare_untrained}
    values |= {"categories": tuple(categories or ()), "memory_gb": memory_gb}
    config = settings.from_mapping(EvaluationConfig, {**values, "protocols": protocols}, where="dope eval")
    checkpoint = find_checkpoint(run)
    with progress_bar() as progress:
        result = run_evaluation(checkpoint, shards, config, device=_device(device), progress=progress)
    folder = out or (run if run.is_dir() else run.parent.parent) / "eval"
    append_rows(folder / "results.parquet", result.rows)
    append_rows(folder / "results.json", result.rows)
    console = Console(highlight=False)
    console.print(results_table(result.rows))
    console.print(
        f"{result.encode_ms_per_view:.0f} ms a view to encode, {result.match_ms_per_episode:.1f} ms an episode to "
        f"match; rows in [bold]{folder / 'results.parquet'}[/]",
        soft_wrap=True,
    )


def figure(
    run: Run,
    shards: Shards,
    out: Annotated[Path, typer.Option("--out", help="Folder for the PNG files.")] = Path("figures"),
    kind: Annotated[str, typer.Option(help="colouring: the same parts in the same colours; heatmap.")] = "colouring",
    sequence: Annotated[
        list[str] | None, typer.Option(help="Which objects; repeatable.  [default: the first few]", show_default=False)
    ] = None,
    views: Annotated[int, typer.Option(help="Views of an object.")] = 6,
    limit: Annotated[int, typer.Option(help="Objects, where none is named.")] = 3,
    masks: Annotated[str, typer.Option(help="predicted by the network, or given in the shards.")] = "predicted",
    colours: Annotated[
        str, typer.Option(help="colouring: by position, or pca: by the descriptors' principal components.")
    ] = "position",
    point: Annotated[
        tuple[float, float] | None,
        typer.Option(help="heatmap: x y in pixels of the first view.  [default: the object's middle]"),
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

    _check_choice(kind, "--kind", ("colouring", "heatmap"))
    _check_choice(masks, "--masks", ("predicted", "given"))
    _check_choice(colours, "--colours", ("position", "pca"))
    options: dict[str, Any] = {"kind": kind, "masks": masks, "colours": colours, "point": point}
    options |= {"sequences": sequence, "views": views, "limit": limit, "device": _device(device)}
    for path in draw_figures(find_checkpoint(run), shards, out, **options):
        typer.echo(path)


def _print_training(result: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.markup import escape

    pck = "" if result["pck"] is None else f", held-out PCK {result['pck']:.1%}"
    if result["pck"] is not None and result["pck_untrained"] is not None:
        pck += f" (untrained {result['pck_untrained']:.1%})"
    folder = escape(str(out))
    loss = "" if result["loss"] is None else f": loss {result['loss']:.3f}"
    Console(highlight=False).print(
        f"{result['status']} at step {result['step']}{loss}{pck}; {result['seconds']:.0f} s; see [bold]{folder}[/]",
        soft_wrap=True,
    )


def _device(name: str) -> str:
    from dope.distributed import pick_device

    return str(pick_device(name, flag="--device "))


def _check_choice(value: str, flag: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise UsageError(f"'{value}' is not one of {', '.join(choices)}", where=flag)
