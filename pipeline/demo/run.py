"""`dope demo`: film procedural objects, then run the very commands that a user would type, one after the other.

Objects of some families are for training, the others are never trained on: the score at the end is recognition of
new categories from one example. Every step is skipped where it is done, so an interrupted demo goes on.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pyarrow.parquet as pq
from rich.console import Console
from rich.markup import escape

from dope.common import files
from dope.common.errors import DopeError
from pipeline.demo.film import DemoConfig, FilmConfig, film_objects


@dataclass(frozen=True)
class Plan:
    """How large the demo is."""

    films: DemoConfig
    train: tuple[str, ...]
    """Settings of the training step, as --set KEY=VALUE."""
    episodes: int
    ways: int
    queries: int
    renders: int
    """Procedural CAD-like objects, rendered instead of filmed: what the network makes of things of another kind."""


FULL = Plan(DemoConfig(), train=(), episodes=1000, ways=4, queries=2, renders=6)
TINY = Plan(
    DemoConfig(
        per_family=2,
        training_families=("chair", "mug"),
        novel_families=("bottle", "table"),
        film=FilmConfig(frames=18, detail=0.5),
    ),
    train=("schedule.epochs=2", "data.pairs_per_object=4", "data.batch_size=4"),
    episodes=20,
    ways=2,
    queries=1,
    renders=2,
)


def run_demo(out: Path, *, workers: int = 0, tiny: bool = False) -> None:
    """Run the demo into `out`.

    Raises:
        DopeError: a step failed; the command that did is named.
    """
    plan = TINY if tiny else FULL
    console = Console(highlight=False)
    start = time.monotonic()

    def say(text: str) -> None:
        console.print(f"[bold cyan]{time.monotonic() - start:5.0f} s[/]  {text}", soft_wrap=True)

    def dope(*words: object, allow_failed_items: bool = False) -> None:
        command = ["dope", *map(str, words)]
        say(f"[bold]{shlex.join(command)}[/]")
        code = _run([sys.executable, "-m", "cli", *command[1:]])
        if code == 1 and allow_failed_items:
            say("[yellow]some objects failed (see the table above); the demo goes on without them[/]")
        elif code:
            raise DopeError(f"`{shlex.join(command)}` ended with exit code {code}", remedy="Its message is above")

    families = (*plan.films.training_families, *plan.films.novel_families)
    count = len(families) * plan.films.per_family
    say(f"filming {count} objects of {len(families)} families into {out / 'videos'}")
    filmed: list[str] = []

    def film_is_there(name: str) -> None:
        filmed.append(name)
        if len(filmed) % 4 == 0 or len(filmed) == count:
            say(f"[dim]{len(filmed)} of {count} films are there[/]")

    film_objects(out / "videos", plan.films, workers=workers, progress=film_is_there)

    base = ("--workers", workers)
    for part, names in (("train", plan.films.training_families), ("novel", plan.films.novel_families)):
        videos, work = [out / "videos" / name for name in names], out / f"work-{part}"
        masks = out / "videos" / "masks"
        dope("prep", "colmap", *videos, "--category-from", "parent", "--masks", masks, "--out", work,
             *base, *("--set", f"frames.count={plan.films.film.frames}"), allow_failed_items=True)  # fmt: skip
        dope("prep", "masks", work, *base, allow_failed_items=True)
        dope("prep", "correspond", work, "--every", 1, *base, allow_failed_items=True)
        holdout = ("--holdout", "frames") if part == "train" else ("--holdout", "none")
        dope("prep", "shards", work, "--out", out / f"shards-{part}", *holdout, allow_failed_items=True)
    if (reason := _cannot_render()) is None:
        work = out / "work-renders"
        dope("prep", "render", "--recipe", "procedural", "--count", plan.renders, "--out", work, *base,
             allow_failed_items=True)  # fmt: skip
        dope("prep", "correspond", work, *base, allow_failed_items=True)
        dope("prep", "shards", work, "--out", out / "shards-renders", "--holdout", "none", allow_failed_items=True)
    else:
        say(f"[yellow]no renders of procedural objects: {escape(reason)}[/]")

    run, shards, novel = out / "run", out / "shards-train", out / "shards-novel"
    settings = [word for setting in plan.train for word in ("--set", setting)]
    dope("train", shards, "--out", run, "--preset", "nano", *settings)
    dope("eval", run, novel, "--ways", plan.ways, "--shots", 1, "--queries", plan.queries,
         "--episodes", plan.episodes, "--compare-untrained")  # fmt: skip
    for dataset in (shards, novel, *([] if reason else [out / "shards-renders"])):
        shown = [word for name in _one_of_each_family(dataset) for word in ("--sequence", name)]
        for kind in ("colouring", "heatmap"):
            dope("figure", run, dataset, "--kind", kind, *shown, "--masks", "given", "--out", out / "figures")
    _summary(console, out, time.monotonic() - start)


def _cannot_render() -> str | None:
    """Why nothing can be rendered on this machine, or None."""
    try:
        from pipeline.render.fast.context import context

        context()
    except DopeError as error:
        return str(error)
    return None


def _run(command: list[str]) -> int:
    """Run a command; Ctrl-C reaches it as well, and it is given the time to leave a checkpoint."""
    with subprocess.Popen(command) as process:
        try:
            return process.wait()
        except KeyboardInterrupt:
            process.wait(timeout=120)
            raise


def _one_of_each_family(shards: Path) -> list[str]:
    """The first sequence of each category that came as far as the shards."""
    table = pq.read_table(shards / "views.parquet", columns=["category", "sequence"]).to_pylist()
    first: dict[str, str] = {}
    for row in sorted(table, key=lambda row: row["sequence"]):
        first.setdefault(row["category"], row["sequence"])
    return list(first.values())


def _summary(console: Console, out: Path, seconds: float) -> None:
    console.rule("what came out")
    lines = (out / "run" / "metrics.jsonl").read_text().splitlines()
    validations = [row for line in lines if (row := json.loads(line))["event"] == "validation"]
    if validations:
        first, last = validations[0], validations[-1]
        console.print(
            f"  held-out views: the right pixel found for [bold]{last['pck']:.1%}[/] of the points "
            f"(PCK; untrained network {first['pck']:.1%})"
        )
    rows = files.read_json(out / "run" / "eval" / "results.json")
    newest = max(row["step"] or 0 for row in rows)  # a run that was trained on keeps its earlier scores, too
    for row in (row for row in rows if row["step"] in (None, newest)):
        console.print(
            f"  {row['ways']}-way {row['shots']}-shot on families never trained on, {row['network']} network: "
            f"[bold]{row['accuracy']:.1%} ± {row['ci95']:.1%}[/] (chance {row['chance']:.1%})"
        )
    console.print(f"  took {seconds / 60:.1f} minutes")
    console.rule("where to look")
    for path, what in (
        (out / "figures", "the same colours on the same parts; a similarity heat map"),
        (out / "videos", "the videos that were made"),
        (out / "work-train", "a COLMAP project for each video, with depth and masks"),
        (out / "work-renders", "procedural objects, rendered: pairs of views with exact masks and depth"),
        (out / "shards-train", "the training shards and their index"),
        (out / "run", "checkpoints, metrics.jsonl, TensorBoard logs, scores"),
    ):
        if path.exists():
            console.print(f"  [bold]{path}[/]  {what}", soft_wrap=True)
