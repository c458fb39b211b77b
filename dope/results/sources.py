"""Result rows found by what the user names: a run, the folder of an evaluation, or a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dope.common.errors import BadInput, UsageError
from dope.lowshot.results import ResultRow, read_rows

NAMES = ("results.parquet", "results.json")
"""What `dope eval` writes, both with the same rows; the first that is there is read."""


@dataclass(frozen=True)
class FoundRow:
    """A result row and the file that it was read from."""

    row: ResultRow
    file: Path

    @property
    def run(self) -> Path:
        """The folder of the run where the file lies in RUN/eval, else the folder of the file."""
        folder = self.file.parent
        return folder.parent if folder.name == "eval" else folder


def find_rows(paths: Sequence[Path]) -> list[FoundRow]:
    """All rows of runs (RUN/eval), of folders that `dope eval --out` wrote, and of .parquet or .json files, in order.

    Raises:
        UsageError: no path, or a file that is named twice.
        BadInput: nothing there, no results in it, or a file that is damaged or holds no rows.
    """
    if not paths:
        raise UsageError("no runs given", remedy="Name run folders, evaluation folders or results files")
    found: list[FoundRow] = []
    seen: dict[Path, Path] = {}
    for path in paths:
        file = results_file(path)
        if (real := file.resolve()) in seen:
            raise UsageError(f"is the same file as {seen[real]} brings", where=path, remedy="Name it once")
        seen[real] = path
        found += _read(file)
    return found


def results_file(path: Path) -> Path:
    """The file with the rows of a run, of an evaluation's folder, or the file itself."""
    if path.is_file():
        return path
    if not path.exists():
        raise BadInput("no such run or file", where=path, remedy="`dope eval RUN SHARDS` writes RUN/eval")
    if not path.is_dir():
        raise BadInput("is neither a folder nor a file", where=path)
    for folder in (path, path / "eval"):
        for name in NAMES:
            if (folder / name).is_file():
                return folder / name
    inside = sorted(child.name for child in path.iterdir() if child.is_dir() and _has_results(child))
    if inside:
        what = f"holds no results itself, but {len(inside)} of its folders do ({', '.join(inside[:3])}, ...)"
        raise BadInput(what.replace(", ...)", ")") if len(inside) <= 3 else what, where=path, remedy=f"Name {path}/*")
    is_run = (path / "config.yaml").is_file() or (path / "checkpoints").is_dir()
    what = "the run has not been evaluated" if is_run else f"holds neither eval/{NAMES[0]} nor {NAMES[0]}"
    raise BadInput(what, where=path, remedy=f"`dope eval {path if is_run else 'RUN'} SHARDS` writes it")


def _has_results(folder: Path) -> bool:
    return any((place / name).is_file() for place in (folder, folder / "eval") for name in NAMES)


def _read(file: Path) -> list[FoundRow]:
    rows = read_rows(file)
    if not rows:
        raise BadInput("holds no rows", where=file, remedy="`dope eval` writes them")
    for number, row in enumerate(rows):
        if fault := _fault(row):
            raise BadInput(f"row {number} is damaged: {fault}", where=file, remedy="Run `dope eval` again")
    return [FoundRow(row, file) for row in rows]


def _fault(row: ResultRow) -> str | None:
    """What cannot be in a row that `dope eval` wrote (JSON can be edited by hand), or None."""
    for name in ("ways", "shots", "queries", "episodes"):
        value = getattr(row, name)
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            return f"{name} is {value!r}"
    for name in ("accuracy", "ci95", "chance"):
        value = getattr(row, name)
        if not isinstance(value, int | float) or not 0 <= value <= 1:
            return f"{name} is {value!r}"
    for name in ("method", "run", "table", "part", "classifier", "network"):
        if not isinstance(getattr(row, name), str):
            return f"{name} is {getattr(row, name)!r}"
    for name in ("step", "table_split"):
        value = getattr(row, name)
        if not (isinstance(value, int) or (name == "step" and value is None)):
            return f"{name} is {value!r}"
    return None
