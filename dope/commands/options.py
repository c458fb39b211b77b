"""Arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dope.common.errors import UsageError

Shards = Annotated[
    str,
    typer.Argument(
        help="The folder that `dope prep shards --out` wrote, or a URL of it: s3://, gs://, hf://.", show_default=False
    ),
]
Run = Annotated[Path, typer.Argument(help="A run (its newest checkpoint) or a checkpoint.", show_default=False)]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")]


def device_name(name: str) -> str:
    from dope.distributed import pick_device

    return str(pick_device(name, flag="--device "))


def check_choice(value: str, flag: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise UsageError(f"'{value}' is not one of {', '.join(choices)}", where=flag)
