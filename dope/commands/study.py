"""`dope study`: the paper's methods or ablations, trained and evaluated alike."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dope.commands.options import Shards, check_choice
from dope.common.errors import UsageError
from dope.study.variants import KINDS


def study(
    shards: Shards,
    test: Annotated[str, typer.Option(help="Shards whose views are evaluated.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="STUDY: runs/, table.md.", show_default=False)],
    kind: Annotated[str, typer.Option(help="methods, ablations or all.")] = "all",
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Only these lines of the table; repeatable.", show_default=False)
    ] = None,
    labelled: Annotated[
        str | None, typer.Option(help="Shards with classes, for the supervised methods.", show_default=False)
    ] = None,
    predicted_masks: Annotated[
        str | None, typer.Option(help="SHARDS once more, with masks of a segmentation tool.", show_default=False)
    ] = None,
    split_file: Annotated[
        Path | None,
        typer.Option(help="Base classes for the supervised methods, test classes for all.", show_default=False),
    ] = None,
    also: Annotated[
        list[str] | None,
        typer.Option(
            "--also",
            metavar="NAME=SHARDS",
            help="More views to test on: all their classes, the smallest --ways, `--fit`, the last step; repeatable.",
            show_default=False,
        ),
    ] = None,
    select: Annotated[
        bool, typer.Option("--select", help="Test the checkpoint that is best on the validation classes.")
    ] = False,
    preset: Annotated[str, typer.Option(help="Of all runs, see `dope train`.")] = "nano",
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="A setting of all runs, or NAME:KEY=VALUE of one line's; repeatable.",
            show_default=False,
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each, with seeds of their own.")] = 1,
    ways: Annotated[list[int] | None, typer.Option(help="Classes an episode.", show_default="5, 10")] = None,
    shots: Annotated[list[int] | None, typer.Option(help="Labelled views a class.", show_default="1, 5")] = None,
    queries: Annotated[int, typer.Option(help="Queries a class.")] = 15,
    episodes: Annotated[int, typer.Option(help="Episodes a setting.")] = 2500,
    jobs: Annotated[int, typer.Option(min=1, help="Runs at a time; they share the CPUs.")] = 1,
) -> None:
    """Train and evaluate the paper's methods and the ablations of DOPE, all alike, and print their table.

    Every line is a run as `dope train` and `dope eval` make it, in STUDY/runs. Run it again to go on: what is done
    is not done again. A line that fails is named, the others go on; the exit code is then 1.

    Examples:

      dope study shards --test test_shards --out study --kind ablations

      dope study renders --labelled labelled --test labelled --split-file split.json --select --out study \
      --seeds 3 --jobs 2 --also photos=shards_photos
    """
    from rich.console import Console

    from dope.study.run import StudyConfig, run_study
    from dope.study.table import study_table

    check_choice(kind, "--kind", tuple(KINDS))
    variants = KINDS[kind]
    for name in only or []:
        check_choice(name, "--only", tuple(variant.name for variant in variants))
    if only:
        variants = tuple(variant for variant in variants if variant.name in only)
    ways = ways or [5, 10]
    protocol = [part for shot in shots or [1, 5] for part in ("--shots", str(shot))]
    protocol += ["--queries", str(queries), "--episodes", str(episodes)]
    evaluation = [part for way in ways for part in ("--ways", str(way))] + protocol
    base: tuple[str, ...] = ()
    if split_file is not None:
        from dope.lowshot.splits import read_split_file

        base = read_split_file(split_file).base
        evaluation += ["--split-file", str(split_file)]
    if select:
        if split_file is None:
            raise UsageError("needs validation classes", where="--select", remedy="Give them by --split-file")
        evaluation += ["--select"]
    named = dict(_name_and_shards(text) for text in also or ())
    sources = {"pairs": shards, "labelled": labelled, "predicted": predicted_masks}
    config = StudyConfig(
        {name: place for name, place in sources.items() if place is not None},  # type: ignore[misc]
        test,
        preset,
        tuple(set_ or ()),
        base,
        tuple(evaluation),
        tuple(named.items()),
        ("--ways", str(min(ways)), *protocol, "--fit"),
        tuple(range(seeds)),
        jobs,
    )
    console = Console(highlight=False, stderr=True)
    outcome = run_study(variants, config, out, lambda text: console.print(text, markup=False, soft_wrap=True))
    if outcome.done:
        typer.echo(study_table(outcome.done, out), nl=False)
        for name in named:
            typer.echo(f"\n{name}:\n\n{study_table(outcome.done, out, name)}", nl=False)
    for name, why in outcome.failed.items():
        console.print(f"{name}: {why}", markup=False, soft_wrap=True)
    raise typer.Exit(1 if outcome.failed else 0)


def _name_and_shards(text: str) -> tuple[str, str]:
    """Of `--also NAME=SHARDS`."""
    name, equals, shards = text.partition("=")
    if not equals or not shards or not name.replace("-", "").replace("_", "").isalnum():
        raise UsageError(
            f"'{text}' is not NAME=SHARDS", where="--also", remedy="For example --also photos=shards_photos"
        )
    return name, shards
