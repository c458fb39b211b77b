"""Tables of splits: which classes are trained on (base), and for every split which validate and which test.

The paper's three tables lie in `dope/splits/`; a user's own is a JSON file of that format or of a shorter one:

    {"base": ["chair", ...], "splits": [{"val": ["cup", ...], "test": ["lamp", ...]}, ...]}

Names are matched to the categories of shards ignoring case, underscores, hyphens and spaces.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dope.common import files
from dope.common.errors import BadInput, UsageError

TABLES = Path(__file__).parents[1] / "splits"
FORMAT = 'It holds {"base": [...], "splits": [{"val": [...], "test": [...]}, ...]}, as `dope eval --help` says'


@dataclass(frozen=True)
class Split:
    """Classes that choose a checkpoint, and classes that test it."""

    val: tuple[str, ...]
    test: tuple[str, ...]

    def part(self, name: str) -> tuple[str, ...]:
        """The classes of "val" or "test"."""
        return self.val if name == "val" else self.test


@dataclass(frozen=True)
class SplitTable:
    """A table of splits; base classes are in no part of any split."""

    name: str
    base: tuple[str, ...]
    splits: tuple[Split, ...]


def table_names() -> list[str]:
    """The paper's tables."""
    return sorted(path.stem for path in TABLES.glob("*.json"))


def paper_table(name: str) -> SplitTable:
    """One of the paper's tables. Raises `UsageError` naming the closest one where there is no such table."""
    known = table_names()
    if name not in known:
        close = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
        hint = f"did you mean '{close[0]}'?" if close else f"there are: {', '.join(known)}"
        raise UsageError(f"no table '{name}' ({hint})", where="--table", remedy="--split-file reads one of your own")
    return read_split_file(TABLES / f"{name}.json")


def named_table(name: str | None, split_file: Path | None) -> SplitTable | None:
    """The table that `--table` or `--split-file` names; None where neither is given.

    Raises:
        UsageError: both are given, or no such table.
        BadInput: see `read_split_file`.
    """
    if name is not None and split_file is not None:
        raise UsageError("names splits, and --table does too", where="--split-file", remedy="Leave one of them out")
    if name is not None:
        return paper_table(name)
    return None if split_file is None else read_split_file(split_file)


def read_split_file(path: Path) -> SplitTable:
    """Read a table of splits.

    Raises:
        BadInput: absent, not JSON, of another form; other splits under the name of one of the paper's tables; a class
            twice, in both parts of a split or in a part and in base; no split, or no test class. Names file, split and
            class.
    """
    values = files.read_json(path, remedy=FORMAT)
    if not isinstance(values, dict) or ("splits" not in values and "val_test" not in values):
        raise BadInput("is no table of splits", where=path, remedy=FORMAT)
    _refuse_doubled_keys(path)
    table = _of_paper(values, path) if "val_test" in values else _of_user(values, path)
    _check(table, path)
    known = TABLES / f"{table.name}.json"
    if known.is_file() and table != _of_paper(files.read_json(known), known):
        # its rows would stand beside the paper's figures
        what = f"has the name of the paper's table '{table.name}', and other splits"
        raise BadInput(what, where=path, remedy="Give the file another name")
    return table


def normalised(name: str) -> str:
    """A class's name as it is compared: no case, underscores, hyphens and spaces."""
    return "".join(c for c in name.casefold() if c not in "_- ")


def match_categories(
    wanted: Sequence[str], categories: Iterable[str], *, where: str, fit: bool = False
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The shards' categories that the table's classes `wanted` are, sorted, and the classes that the shards lack.

    Raises:
        UsageError: two categories are one class; or classes are missing and not `fit`; or all are.
    """
    by_name: dict[str, str] = {}
    for category in sorted(set(categories)):
        other = by_name.setdefault(normalised(category), category)
        if other != category:
            what = f"categories '{other}' and '{category}' of the shards are one class of the table"
            raise UsageError(what, where=where, remedy="Give both one name in `dope prep shards`")
    found = tuple(sorted(by_name[normalised(name)] for name in wanted if normalised(name) in by_name))
    missing = tuple(name for name in wanted if normalised(name) not in by_name)
    if missing and (not fit or not found):
        there = ", ".join(sorted(by_name.values())) or "none"
        raise UsageError(
            f"the shards lack {len(missing)} of its {len(wanted)} classes: {', '.join(missing)}. There are: {there}",
            where=where,
            remedy="Name the categories in the shards as the table does"
            + ("" if fit else ", or leave them out: --fit"),
        )
    return found, missing


def _of_user(values: Mapping[str, Any], path: Path) -> SplitTable:
    unknown = sorted(set(values) - {"base", "splits", "dataset", "source"})
    if unknown:
        raise BadInput(f"unknown key '{unknown[0]}'", where=path, remedy=FORMAT)
    base = _names(values.get("base"), "base", path)
    if not isinstance(values["splits"], list):
        raise BadInput("'splits' is not a list", where=path, remedy=FORMAT)
    splits = []
    for number, split in enumerate(values["splits"]):
        if not isinstance(split, dict) or set(split) != {"val", "test"}:
            raise BadInput(f"split {number} has not just 'val' and 'test'", where=path, remedy=FORMAT)
        splits.append(Split(*(_names(split[part], f"{part} of split {number}", path) for part in ("val", "test"))))
    return SplitTable(path.stem, base, tuple(splits))


def _of_paper(values: Mapping[str, Any], path: Path) -> SplitTable:
    """The letters of each class, by position: what the table printed as indices is partly wrong."""
    base = values.get("train")
    letters = values["val_test"]
    if not isinstance(base, dict) or not isinstance(letters, dict):
        raise BadInput("'train' or 'val_test' is not a mapping of classes", where=path, remedy=FORMAT)
    assignment: dict[str, list[str]] = {}
    for name, entry in letters.items():
        given = entry.get("assignment") if isinstance(entry, dict) else None
        if not isinstance(given, list) or any(letter not in ("v", "t") for letter in given):
            what = f"class '{name}' has no assignment of 'v' (validation) and 't' (test), one a split"
            raise BadInput(what, where=path, remedy=FORMAT)
        assignment[name] = given
        n_splits = len(next(iter(assignment.values())))
        if len(given) != n_splits:
            raise BadInput(f"class '{name}' is assigned in {len(given)} splits, others in {n_splits}", where=path)
    n_splits = max(map(len, assignment.values()), default=0)
    splits = tuple(
        Split(*(tuple(name for name, given in assignment.items() if given[number] == letter) for letter in "vt"))
        for number in range(n_splits)
    )
    return SplitTable(path.stem, tuple(base), splits)


def _refuse_doubled_keys(path: Path) -> None:
    """JSON of which readers forget the first of two equal keys in silence."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        seen: set[str] = set()
        for key, _ in pairs:
            if key in seen:
                raise BadInput(f"'{key}' is there twice", where=path, remedy="Name every class once")
            seen.add(key)
        return dict(pairs)

    json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=once)


def _names(value: Any, what: str, path: Path) -> tuple[str, ...]:
    if not isinstance(value, list) or any(not isinstance(name, str) or not normalised(name) for name in value):
        raise BadInput(f"{what} is not a list of classes", where=path, remedy=FORMAT)
    return tuple(value)


def _check(table: SplitTable, path: Path) -> None:
    if not table.splits:
        raise BadInput("has no split", where=path, remedy=FORMAT)
    base = _unique(table.base, "base", path)
    for number, split in enumerate(table.splits):
        val = _unique(split.val, f"val of split {number}", path)
        test = _unique(split.test, f"test of split {number}", path)
        if not test:
            raise BadInput(f"split {number} has no test classes", where=path, remedy=FORMAT)
        for part, names in (("val", val), ("test", test)):
            for name in sorted(names.keys() & base.keys()):
                what = f"class '{names[name]}' is trained on (base) and in {part} of split {number}"
                raise BadInput(what, where=path, remedy="Leave it in one of them")
        for name in sorted(val.keys() & test.keys()):
            what = f"class '{val[name]}' is in val and in test of split {number}"
            raise BadInput(what, where=path, remedy="Leave it in one of them")


def _unique(names: Sequence[str], what: str, path: Path) -> dict[str, str]:
    """normalised name -> name. Raises `BadInput` where a class is there twice."""
    found: dict[str, str] = {}
    for name in names:
        other = found.setdefault(normalised(name), name)
        if other != name or names.count(name) > 1:
            raise BadInput(f"class '{name}' is twice in {what}", where=path, remedy="Name every class once")
    return found
