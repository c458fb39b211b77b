"""`dope eval`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dope.commands.options import Device, check_choice, device_name
from dope.commands.places import run_and_shards
from dope.common.errors import UsageError

if TYPE_CHECKING:
    from dope.encoders.embedder import MaskChoice
    from dope.lowshot.splits import SplitTable


def evaluate(
    places: Annotated[
        list[str],
        typer.Argument(
            metavar="[RUN] SHARDS",
            help="A run (its newest checkpoint) or a checkpoint; and the folder that `dope prep shards --out` wrote, "
            "or a URL of it: s3://, gs://, hf://. With --encoder, SHARDS alone.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for results.parquet.", show_default="RUN/eval, or eval/ENCODER")
    ] = None,
    ways: Annotated[list[int] | None, typer.Option(help="Classes an episode (5); repeatable.")] = None,
    shots: Annotated[list[int] | None, typer.Option(help="Labelled views a class (1); repeatable.")] = None,
    queries: Annotated[int, typer.Option(help="Queries a class.")] = 15,
    episodes: Annotated[int, typer.Option(help="Episodes a setting.")] = 2500,
    classes: Annotated[
        str, typer.Option(help="category: of unseen objects; instance: which object, from other views of it.")
    ] = "category",
    shot_mode: Annotated[
        str, typer.Option(help="Shots of a category: several_instances, or one_instance seen from several sides.")
    ] = "several_instances",
    table: Annotated[
        str | None,
        typer.Option(
            help="The paper's splits: modelnet40_ls, shapenet55_ls or co3d_ls. Every split is evaluated on its own "
            "classes, and the mean of accuracies and of intervals is shown; base classes are never tested.",
            show_default=False,
        ),
    ] = None,
    split_file: Annotated[
        Path | None,
        typer.Option(
            "--split-file",
            help='Splits of your own: {"base": \\[names], "splits": [{"val": \\[names], "test": \\[names]}, ...]}',
            show_default=False,
        ),
    ] = None,
    table_split: Annotated[
        list[int] | None,
        typer.Option("--table-split", help="Only this split, counted from 0; repeatable.", show_default=False),
    ] = None,
    part: Annotated[str, typer.Option(help="Classes of each split: test or val.")] = "test",
    select: Annotated[
        bool,
        typer.Option(
            "--select",
            help="Of all checkpoints of RUN, test on each split the one that is best on its validation classes "
            "(5-way 1-shot; of equal ones the later; damaged ones are passed over).",
        ),
    ] = False,
    categories: Annotated[
        list[str] | None, typer.Option("--category", help="Only these; repeatable.", show_default=False)
    ] = None,
    classifier: Annotated[
        str,
        typer.Option(
            help="auto: the method's own. local: local matching of dense descriptors, as in the paper. Of pooled "
            "features: centroid (nearest class mean), nearest (nearest shot), logistic (regression in each episode)."
        ),
    ] = "auto",
    points: Annotated[
        int,
        typer.Option(help="With local: cells of the query's foreground that look for a match (the paper's k)."),
    ] = 20,
    foreground: Annotated[
        float,
        typer.Option(help="With local: a query's cells whose soft mask is at least this are its foreground."),
    ] = 0.9,
    support_copies: Annotated[
        int,
        typer.Option(
            "--support-copies",
            min=1,
            help="With logistic: learn from each shot so many times, all but the first augmented as in training.",
        ),
    ] = 1,
    split: Annotated[str, typer.Option(help="Views of the shards: all, train or val.")] = "all",
    fit: Annotated[
        bool, typer.Option("--fit", help="Fewer ways, queries or classes where the views do not suffice.")
    ] = False,
    compare_untrained: Annotated[
        bool, typer.Option("--compare-untrained", help="The same episodes with random weights, too.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the episodes.")] = 0,
    memory: Annotated[float, typer.Option(help="GiB of descriptors kept in memory; the others wait on a disk.")] = 4.0,
    memory_gb: Annotated[float | None, typer.Option("--memory-gb", hidden=True)] = None,  # its former name
    cache: Annotated[
        Path | None,
        typer.Option(
            "--cache",
            help="Folder on that disk; nothing stays there.",
            show_default="the temporary folder",
        ),
    ] = None,
    encoder: Annotated[
        str | None,
        typer.Option(
            "--encoder",
            help="Instead of a run: any function of images as module:function or FILE.py:function, or a Hugging Face "
            "model in a folder as hf:FOLDER (docs/encoders.md).",
            show_default=False,
        ),
    ] = None,
    encoder_mask: Annotated[
        str,
        typer.Option(
            "--encoder-mask",
            help="none: the encoder's own masks, if any. given: those of the shards, an oracle that no encoder has.",
        ),
    ] = "none",
    device: Device = "auto",
) -> None:
    """Low-shot recognition: accuracy over random episodes with its 95% confidence interval, beside chance.

    DOPE compares a query with every labelled view by local matching of its dense descriptors (paper, section 4); other
    methods have classifiers of pooled features, and any method can be put under any of these.

    Examples:

      dope eval run shards --ways 5 --ways 10 --shots 1 --shots 5

      dope eval run shards --classes instance --split val --ways 5 --queries 2

    The paper's tables, a checkpoint chosen for every split:

      dope eval run shards --table modelnet40_ls --select --ways 5 --ways 10 --shots 1 --shots 5

      dope eval run shards --split-file my_splits.json --table-split 0 --classifier logistic --support-copies 5

    Features that were not trained here, under the same protocol (docs/encoders.md):

      dope eval shards --encoder my_features:encode

      dope eval shards --encoder hf:models/dinov2-small --encoder-mask given
    """
    from rich.console import Console
    from rich.markup import escape

    run, shards = run_and_shards(places, encoder)
    _check_encoder(encoder, encoder_mask, select=select, compare_untrained=compare_untrained)

    from dope.common import settings
    from dope.common.progress import progress_bar
    from dope.heap import keep_heap
    from dope.lowshot.episodes import EpisodeConfig
    from dope.lowshot.evaluate import EvaluationConfig
    from dope.lowshot.results import append_rows, results_table

    episode: dict[str, Any] = {
        "queries": queries, "episodes": episodes, "seed": seed, "classes": classes, "fit": fit,
        "shot_mode": shot_mode,
    }  # fmt: skip
    protocols = tuple(
        settings.from_mapping(EpisodeConfig, {**episode, "ways": way, "shots": shot}, where="dope eval")
        for way in dict.fromkeys(ways or [5])  # given twice, it is measured once
        for shot in dict.fromkeys(shots or [1])
    )
    values: dict[str, Any] = {
        "classifier": classifier, "split": split, "compare_untrained": compare_untrained, "part": part,
        "support_copies": support_copies, "memory_gib": memory if memory_gb is None else memory_gb,
        "categories": tuple(categories or ()), "matching": {"points": points, "foreground": foreground},
        "table_splits": tuple(table_split or ()), "protocols": protocols,
    }  # fmt: skip
    config = settings.from_mapping(EvaluationConfig, values, where="dope eval")
    config = replace(config, cache=cache)
    splits = _splits(table, split_file, select)
    keep_heap()
    with progress_bar() as progress:
        options: dict[str, Any] = {"device": device_name(device), "progress": progress}
        if encoder is not None:
            from dope.encoders.on_shards import default_folder, encoder_on_shards
            from dope.lowshot.evaluate import evaluate_embedders

            mask: MaskChoice = "given" if encoder_mask == "given" else "none"
            subject = encoder_on_shards(encoder, shards, mask=mask, device=options["device"])
            files = _files(out or default_folder(subject.embedder.name))
            result = evaluate_embedders([subject], shards, config, table=splits, **options)
        elif select:
            from dope.lowshot.selection import evaluate_best

            assert splits is not None and run is not None
            files = _files(out or run / "eval")
            result = evaluate_best(run, shards, config, splits, **options)
        else:
            from dope.checkpoints import find_checkpoint
            from dope.lowshot.evaluate import evaluate as run_evaluation
            from dope.lowshot.subjects import run_of

            assert run is not None
            checkpoint = find_checkpoint(run)
            files = _files(out or (run if run.is_dir() else run_of(run)) / "eval")
            result = run_evaluation(checkpoint, shards, config, table=splits, **options)
    console = Console(highlight=False, emoji=False)  # "encode.py:zero: ..." is no picture
    console.print(results_table([row for row in result.rows if not select or row.part == "test"]))
    for note in result.notes:
        console.print(escape(note), soft_wrap=True)
    for file in files:  # shown first: what was measured is not lost where it cannot be kept
        append_rows(file, result.rows)
    console.print(
        f"{result.encode_ms_per_view:.0f} ms a view to encode, {result.match_ms_per_episode:.1f} ms an episode to "
        f"match; rows in [bold]{escape(str(files[0]))}[/]",
        soft_wrap=True,
    )


def _files(folder: Path) -> list[Path]:
    """Where the rows go, both kinds of which can be added to."""
    from dope.lowshot.results import check_appendable
    from dope.results.sources import NAMES

    files = [folder / name for name in NAMES]
    for file in files:
        check_appendable(file)
    return files


def _check_encoder(encoder: str | None, mask: str, *, select: bool, compare_untrained: bool) -> None:
    """Refuse what has no meaning with an encoder, or without one."""
    check_choice(mask, "--encoder-mask", ("none", "given"))
    if encoder is None and mask != "none":
        raise UsageError("is for --encoder", where=f"--encoder-mask {mask}", remedy="Leave it out")
    flags = {"--select": select, "--compare-untrained": compare_untrained}
    for flag in (flag for flag, given in flags.items() if given and encoder is not None):
        raise UsageError("is for runs, an encoder has no checkpoints", where=flag, remedy="Leave it out")


def _splits(table: str | None, split_file: Path | None, select: bool) -> SplitTable | None:
    """The table that --table or --split-file names."""
    from dope.lowshot.splits import named_table

    splits = named_table(table, split_file)
    if splits is None and select:
        remedy = "Add --table modelnet40_ls, shapenet55_ls or co3d_ls, or --split-file FILE"
        raise UsageError("needs splits with validation classes", where="--select", remedy=remedy)
    return splits
