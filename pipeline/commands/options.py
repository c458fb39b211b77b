"""What the commands of `dope prep` share: their common options, and how settings and sequences are chosen."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dope.common.errors import UsageError

if TYPE_CHECKING:
    from pipeline.sequence import Sequence
    from pipeline.tasks import RunOptions

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
RetryFailed = Annotated[bool, typer.Option("--retry-failed", help="Try again what failed or came out empty before.")]
AsJson = Annotated[bool, typer.Option("--json", help="Rows as JSON lines instead of a table.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML file of settings.", show_default=False)]


def any_setting(example: str) -> Any:
    text = f"Any setting, e.g. {example}; a wrong name is answered with the nearest."
    return typer.Option("--set", metavar="KEY=VALUE", help=text, show_default=False)


def resolve_config(cls: type, path: Path | None, flags: dict[str, Any], assignments: list[str] | None) -> Any:
    """Defaults, then the YAML file, then the flags, then --set."""
    from dope.common import settings

    config = settings.from_mapping(cls, settings.load_yaml(path), where=str(path)) if path else cls()
    given = [f"{key}={value}" for key, value in flags.items() if value is not None]
    return settings.override(config, [*given, *(assignments or [])])


def run_options(
    workers: int, threads: int, minutes: float, memory_gib: float, overwrite: bool, retry_failed: bool
) -> RunOptions:
    from pipeline.children import Limits
    from pipeline.engines import default_workers
    from pipeline.tasks import RunOptions

    if not (0 < minutes < math.inf and 0 < memory_gib < math.inf):
        raise UsageError("--minutes and --memory-gib must be positive numbers")
    count = workers or max(1, default_workers() // threads)
    return RunOptions(count, Limits(minutes, memory_gib, threads), overwrite, retry_failed)


def chosen_sequences(work: Path, only: list[str] | None) -> list[Sequence]:
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
