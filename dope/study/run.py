"""Train and evaluate the variants of a study, each in a process of its own; what is done already is not done again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from dope.common import files
from dope.common.errors import UsageError
from dope.results.sources import NAMES
from dope.study.variants import KINDS, Source, Variant

Say = Callable[[str], None]
DOPE = (sys.executable, "-c", "from cli import main; main()")
"""The command, of this very installation."""
EXIT_STOPPED = 75
LAST_WORDS = 12
"""Lines of a failed command's output that are shown."""


@dataclass(frozen=True)
class StudyConfig:
    """What all variants share."""

    shards: dict[Source, str]
    """Where each kind of training shards is."""
    test: str
    """Shards whose views are evaluated."""
    preset: str = "nano"
    """`dope train --preset`."""
    settings: tuple[str, ...] = ()
    """`dope train --set`, for all; `NAME:key=value` for the runs of one variant."""
    base: tuple[str, ...] = ()
    """Classes that the labelled variants learn; none given: all."""
    evaluation: tuple[str, ...] = ()
    """Options of `dope eval`."""
    also: tuple[tuple[str, str], ...] = ()
    """More shards to test on, by name: all their classes, at the last step; in RUN/eval-NAME."""
    also_evaluation: tuple[str, ...] = ()
    """Options of `dope eval` for them."""
    seeds: tuple[int, ...] = (0,)
    """A run of each variant for each."""
    jobs: int = 1
    """Processes at a time, which share the CPUs."""


@dataclass(frozen=True)
class Piece:
    """One run of a study."""

    variant: Variant
    seed: int
    run: Path

    @property
    def name(self) -> str:
        return self.run.name


@dataclass
class Outcome:
    """What became of the pieces."""

    done: list[Piece] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    """Run -> why."""


def pieces_of(variants: Sequence[Variant], config: StudyConfig, out: Path) -> list[Piece]:
    """Every run, those first that others start from.

    Raises:
        UsageError: a variant has no shards to train on.
    """
    names = {name for name, _ in map(_name_and_setting, config.settings) if name is not None}
    if unknown := names - {variant.name for kind in KINDS.values() for variant in kind}:
        raise UsageError(f"there is no '{min(unknown)}' to give settings to", where="--set")
    for variant in variants:
        if variant.source not in config.shards:
            flag = {"labelled": "--labelled", "predicted": "--predicted-masks"}.get(variant.source, "SHARDS")
            what = f"'{variant.name}' is trained on other shards"
            raise UsageError(what, where=flag, remedy=f"Give them by {flag}, or leave it out by --only")
    ordered = sorted(variants, key=lambda variant: variant.starts_from is not None)
    return [Piece(v, seed, out / "runs" / f"{v.name}-seed{seed}") for seed in config.seeds for v in ordered]


def run_study(variants: Sequence[Variant], config: StudyConfig, out: Path, say: Say = print) -> Outcome:
    """Do all pieces; one that fails costs what starts from it, and is named at the end.

    OUT/runs/<variant>-seed<k>/ are runs as `dope train` makes them, with eval/ and log.txt.
    """
    pieces = pieces_of(variants, config, out)
    first = [piece for piece in pieces if piece.variant.starts_from is None]
    later = [piece for piece in pieces if piece.variant.starts_from is not None]
    outcome = Outcome()
    for wave in (first, later):
        with ThreadPoolExecutor(config.jobs) as pool:
            for piece, why in zip(wave, pool.map(lambda p: _do(p, config, out, outcome, say), wave), strict=True):
                if why is None:
                    outcome.done.append(piece)
                else:
                    outcome.failed[piece.name] = why
    return outcome


def _do(piece: Piece, config: StudyConfig, out: Path, outcome: Outcome, say: Say) -> str | None:
    """Train and evaluate one run; why it failed, or None."""
    start = piece.variant.starts_from
    before = f"{start}-seed{piece.seed}"
    if start is not None and (before in outcome.failed or not (out / "runs" / before / "checkpoints").is_dir()):
        return f"it starts from {before}, which is not there"
    piece.run.mkdir(parents=True, exist_ok=True)
    anew = False
    for what, command in commands(piece, config, out):
        mark = piece.run / f".{what}.json"
        if not anew and mark.is_file() and files.read_json(mark) == list(command):
            continue
        anew |= what == "training"  # another network is evaluated again
        if command[0] == "eval" and mark.is_file():
            _forget_results(Path(command[command.index("--out") + 1]) if "--out" in command else piece.run / "eval")
        say(f"{piece.name}: {what}")
        began = time.perf_counter()
        why = _call(command, piece.run / "log.txt", config)
        if why is not None:
            say(f"{piece.name}: {what} failed: {why}")
            return f"{what}: {why}"
        files.write_bytes(mark, json.dumps(list(command)).encode())
        say(f"{piece.name}: {what} took {time.perf_counter() - began:.0f} s")
    return None


def commands(piece: Piece, config: StudyConfig, out: Path) -> Iterator[tuple[str, tuple[str, ...]]]:
    """What a run is made by: arguments of `dope`."""
    variant = piece.variant
    settings = [f"seed={12345 + piece.seed}", *_own(config.settings, variant.name), *variant.settings]
    if variant.source == "labelled" and config.base:
        settings.append(f"data.categories={json.dumps(list(config.base))}")
    if variant.starts_from is not None:
        settings.append(f"feat.start={out / 'runs' / f'{variant.starts_from}-seed{piece.seed}'}")
    options = [part for setting in settings for part in ("--set", setting)]
    shards = config.shards[variant.source]
    training = ("train", shards, "--out", str(piece.run), "--method", variant.method, "--preset", config.preset)
    yield "training", (*training, *options)
    yield "evaluation", ("eval", str(piece.run), config.test, *config.evaluation)
    for name, also in config.also:
        folder = str(piece.run / also_folder(name))
        yield f"evaluation-{name}", ("eval", str(piece.run), also, "--out", folder, *config.also_evaluation)


def _forget_results(folder: Path) -> None:
    """Rows of an evaluation that is done anew by another protocol: tables would refuse the two together."""
    for name in NAMES:
        (folder / name).unlink(missing_ok=True)


def also_folder(name: str) -> str:
    """Of a run's results on the shards that `StudyConfig.also` calls so."""
    return f"eval-{name}"


def _own(settings: Sequence[str], name: str) -> Iterator[str]:
    """The settings of all variants, then those of this one, which win."""
    named = [_name_and_setting(text) for text in settings]
    yield from (setting for whose, setting in named if whose is None)
    yield from (setting for whose, setting in named if whose == name)


def _name_and_setting(text: str) -> tuple[str | None, str]:
    name, colon, setting = text.partition(":")
    return (name, setting) if colon and "=" not in name else (None, text)


def _call(command: tuple[str, ...], log: Path, config: StudyConfig) -> str | None:
    threads = max(1, (os.cpu_count() or 1) // config.jobs)
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "COLUMNS": "160"}
    with log.open("a", encoding="utf-8") as file:
        file.write(f"\n$ dope {' '.join(command)}\n")
        file.flush()
        code = subprocess.run([*DOPE, *command], stdout=file, stderr=subprocess.STDOUT, env=environment).returncode
    if code == 0:
        return None
    if code == EXIT_STOPPED:
        return "stopped by a signal; run the study again to go on"
    words = log.read_text(errors="replace").strip().splitlines()[-LAST_WORDS:]
    errors = [line for line in words if line.startswith("error:")]
    return f"exit code {code} ({(errors or words or ['no output'])[-1]}); see {log}"
