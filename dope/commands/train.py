"""`dope train`."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dope.commands.options import Shards
from dope.common.errors import UsageError
from dope.methods import KNOWN
from dope.preset_files import preset_names, preset_summary

if TYPE_CHECKING:
    from dope.config import TrainConfig
    from dope.lowshot.splits import SplitTable

METHODS_HELP = "What to train: " + ", ".join(KNOWN) + "; all but the first are the paper's baselines."
PRESETS_HELP = "\n\n".join(f"{name}: {preset_summary(name)}" for name in preset_names())


def train(
    shards: Shards,
    out: Annotated[Path, typer.Option("--out", help="RUN: the folder of this run.", show_default=False)],
    method: Annotated[str, typer.Option(help=METHODS_HELP)] = "dope",
    preset: Annotated[str, typer.Option(help=PRESETS_HELP)] = "paper",
    config: Annotated[
        Path | None, typer.Option("--config", help="YAML file of settings, on top of the preset.", show_default=False)
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One setting, e.g. optimiser.lr=3e-4.", show_default=False),
    ] = None,
    table: Annotated[
        str | None,
        typer.Option(
            help="Learn only from the base classes of a table of the paper: modelnet40_ls, shapenet55_ls or co3d_ls.",
            show_default=False,
        ),
    ] = None,
    split_file: Annotated[
        Path | None,
        typer.Option(help="Learn only from the base classes of your own splits, see `dope eval`.", show_default=False),
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
        typer.Option(min=0, help="Damaged samples to put up with.", show_default="0"),
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
    """Train DOPE: corresponding pixels of two views get the same descriptor, all others different ones; or a baseline.

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

      dope train shards --out rfs --method rfs --preset paper_modelnet --table modelnet40_ls

      torchrun --nproc-per-node 4 $(which dope) train shards --out run

      dope train s3://bucket/shards --out run --set data.order=sequential
    """
    from dope.config import load_config
    from dope.lowshot.splits import named_table

    overrides = [*(set_ or ()), *([] if max_bad_samples is None else [f"data.max_bad_samples={max_bad_samples}"])]
    resolved = load_config(preset, config, overrides, method=method)
    if (splits := named_table(table, split_file)) is not None:
        resolved = _of_base_classes(resolved, shards, splits)
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


def _of_base_classes(config: TrainConfig, shards: str, splits: SplitTable) -> TrainConfig:
    """The settings with a table's base classes as `data.categories`."""
    from dope.base_classes import base_categories

    names = base_categories(shards, splits)
    if config.data.categories not in ((), names):
        remedy = "Leave out either the table or data.categories"
        raise UsageError(
            "the settings name other classes than these", where=f"{splits.name}, base classes", remedy=remedy
        )
    return replace(config, data=replace(config.data, categories=names))


def _print_training(result: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.markup import escape

    name = {"pck": "PCK"}.get(result["score_name"], result["score_name"])
    score = "" if result["score"] is None else f", held-out {name} {result['score']:.1%}"
    if result["score"] is not None and result["score_untrained"] is not None:
        score += f" (untrained {result['score_untrained']:.1%})"
    folder = escape(str(out))
    loss = "" if result["loss"] is None else f": loss {result['loss']:.3f}"
    Console(highlight=False).print(
        f"{result['status']} at step {result['step']}{loss}{score}; {result['seconds']:.0f} s; see [bold]{folder}[/]",
        soft_wrap=True,
    )
