"""`dope eval`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from dope.commands.options import Device, Run, Shards, device_name


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
        result = run_evaluation(checkpoint, shards, config, device=device_name(device), progress=progress)
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
