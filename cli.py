"""The `dope` command: a tour of its sub-commands. Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import errno
import sys
from pathlib import Path
from typing import Annotated

import typer

from dope import __version__
from dope.commands import evaluate, figure, results, study, train
from dope.common.errors import DopeError, UsageError
from pipeline.commands import app as prep

INTERRUPTED = 130  # what typer makes of Ctrl-C
NO_PLACE = (errno.EACCES, errno.EPERM, errno.EROFS, errno.EEXIST, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG)

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="""Dense object descriptors from plain videos, recognition from one example.

    [bold]The tour[/], from a folder of phone videos to a score:

      dope prep run videos/ --out work --shards shards    frames, cameras, depth, masks, pixel matches, tars

      dope prep report work --out report.html             what came out, on one page

      dope train shards --out run                         a network of descriptors

      dope eval run shards                                low-shot accuracy

      dope results run other_run                          the paper's table of several runs

      dope figure run shards                              same parts, same colours

    [bold]dope demo[/] does all of it, in minutes, on objects that it makes itself.
    [bold]dope doctor[/] says what is installed and what is missing.
    """,
)
app.add_typer(prep, name="prep")
app.command("train")(train)
app.command("eval")(evaluate)
app.command("results")(results)
app.command("study")(study)
app.command("figure")(figure)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Where everything goes; run again, it goes on where it stopped.")] = Path(
        "demo"
    ),
    workers: Annotated[int, typer.Option(help="Processes; 0 = one for each CPU.")] = 0,
    tiny: Annotated[bool, typer.Option("--tiny", help="A smoke test: few objects, few steps, no meaning.")] = False,
) -> None:
    """Make objects, film them, and run everything above on the videos: minutes on two cores."""
    from pipeline.demo.run import run_demo

    run_demo(out, workers=workers, tiny=tiny)


@app.command()
def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False) -> None:
    """Say what is installed, what is missing, and which extra brings it."""
    from dope.doctor import examine, show

    raise typer.Exit(show(examine(), as_json=as_json))


def _version(value: bool) -> None:
    if value:
        typer.echo(f"dope {__version__}")
        raise typer.Exit()


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None: ...


def main() -> None:
    """Run the command; explain our own errors in one line and turn them into exit codes (1, or 2 for usage)."""
    try:
        app()
    except DopeError as error:
        _explain(error)
        sys.exit(2 if isinstance(error, UsageError) else 1)
    except OSError as error:
        if error.errno not in NO_PLACE:
            raise
        remedy = "Give a path in a folder that you may write to (in a container: one that its user owns)"
        _explain(DopeError(str(error.strerror).lower(), where=error.filename, remedy=remedy))
        sys.exit(1)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            typer.echo("interrupted; run the same command again to go on", err=True)
        raise


def _explain(error: DopeError) -> None:
    from rich.console import Console
    from rich.markup import escape

    Console(stderr=True, highlight=False, emoji=False).print(f"[red]error:[/] {escape(str(error))}", soft_wrap=True)


if __name__ == "__main__":
    main()
