"""Which rows belong to one line of a table or one curve, and what it is called."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dope.common.errors import UsageError
from dope.lowshot.results import ResultRow
from dope.results import paper
from dope.results.sources import FoundRow


@dataclass(frozen=True)
class Line:
    """The rows of one network (or of several that the user gave one label), by one classifier.

    Attributes:
        label: what it is called; no two lines of a table have the same one.
        method: of its rows; "" where they are of several.
        classifier: in words; "" where they are of several.
        chosen: whether validation classes chose its checkpoints (`dope eval --select`).
        found: its rows.
    """

    label: str
    method: str
    classifier: str
    chosen: bool
    found: tuple[FoundRow, ...]


def lines_of(found: Sequence[FoundRow], labels: Mapping[str, str], *, by_step: bool = True) -> list[Line]:
    """Put rows together that are one line, in the order in which they were found.

    A line is a network trained once (a run) or an encoder, by one classifier. Its label is the method, with the run's
    name where several runs share the method. Of a run with several checkpoints, each is a line (`by_step`); those that
    were chosen for a split each (paper section 4) are one, apart from the same ones unchosen.

    Args:
        found: rows of one protocol.
        labels: run's name (or its folder, or method) -> label; runs that get the same label become one line, as FEAT,
            which trains a network for each (ways, shots), needs it.
        by_step: False keeps the checkpoints of a run together: a curve.

    Raises:
        UsageError: a label for what is not there, or one label for rows of the same cell.
    """
    networks: dict[tuple[object, ...], list[FoundRow]] = defaultdict(list)
    for item in found:
        row = item.row
        by = (row.classifier, row.support_copies, row.chosen_by)
        networks[(row.method, _trained_once(item), row.config_hash, row.network, *by)].append(item)
    _check_labels(labels, found)
    parts = [part for items in networks.values() for part in (_by_checkpoint(items) if by_step else [items])]
    lines: dict[tuple[str, int], list[FoundRow]] = defaultdict(list)
    for i, (name, given, items) in enumerate(zip(*_names(parts, labels), parts, strict=True)):
        lines[name, -1 if given else i] += items  # only the user can make one line of several
    made = [_line(name, items) for (name, _), items in lines.items()]
    if by_step:
        for line in made:
            _check_cells(line)
    return made


def read_labels(values: Sequence[str], found: Sequence[FoundRow]) -> dict[str, str]:
    """`--label RUN=TEXT`, where RUN is a run's name or folder or a method, which may contain "=": hf:FOLDER?pool=cls.

    Raises:
        UsageError: not of this form, of no run, or two labels of one.
    """
    known = {name for item in found for name in _handles(item)}
    labels: dict[str, str] = {}
    for value in values:
        names = [name for name in known if value.startswith(f"{name}=")] or [value.partition("=")[0]]
        name = max(names, key=len)
        text = value.removeprefix(name).removeprefix("=")
        if not name or not text.strip():
            raise UsageError(f"'{value}' is not RUN=TEXT", where="--label")
        if name in labels:
            raise UsageError(f"'{name}' is given twice", where="--label")
        labels[name] = text
    return labels


def cell_of(row: ResultRow) -> tuple[int, int, int]:
    return row.ways, row.shots, row.table_split


def column_name(ways: int, shots: int) -> str:
    return f"{ways}w{shots}s"


def columns_of(found: Sequence[FoundRow]) -> list[tuple[int, int]]:
    """(ways, shots) of the rows, as in the paper: 5w1s 5w5s 10w1s 10w5s."""
    return sorted({(item.row.ways, item.row.shots) for item in found})


def _trained_once(item: FoundRow) -> str:
    """What rows of one run have in common; an encoder, which has no run and no steps, is known by its hash."""
    row = item.row
    return row.run or (str(item.run) if row.step is not None else str(row.checkpoint_sha256))


def _by_checkpoint(items: list[FoundRow]) -> list[list[FoundRow]]:
    """The rows apart by their step, unless there is one for each split of a table, as where they were chosen.

    Rows of earlier versions do not say whether they were.
    """
    steps = sorted({-1 if item.row.step is None else item.row.step for item in items})
    splits = {(item.row.table_split, item.row.step) for item in items}
    once = max(Counter(cell_of(item.row) for item in items).values()) == 1
    if len(steps) == 1 or items[0].row.chosen_by or (once and len(splits) == len({split for split, _ in splits})):
        return [items]
    return [[i for i in items if (-1 if i.row.step is None else i.row.step) == step] for step in steps]


@dataclass(frozen=True)
class _Facts:
    """What may tell a line from others, in words; from `folder` on the last resort."""

    base: str
    given: bool
    run: str
    network: str
    classifier: str
    chosen: str
    step: str
    folder: str
    settings: str
    weights: str


def _names(parts: Sequence[Sequence[FoundRow]], labels: Mapping[str, str]) -> tuple[list[str], list[bool]]:
    """A label for each part, no longer than needed to tell it from the others; and whether the user gave it."""
    facts = [_facts(part, labels) for part in parts]
    details = [_details(fact, [other for other in facts if other.base == fact.base]) for fact in facts]
    for last_resort in ("folder", "settings", "weights"):
        keys = [(fact.base, *more) for fact, more in zip(facts, details, strict=True)]
        alike = [i for i, name in enumerate(keys) if keys.count(name) > 1 and not facts[i].given]
        for i in alike:
            same = {getattr(facts[j], last_resort) for j in alike if keys[j] == keys[i]}
            if len(same) > 1:
                details[i] = [*details[i], getattr(facts[i], last_resort)]
    names = [
        legible(f"{fact.base} ({', '.join(more)})" if more else fact.base)
        for fact, more in zip(facts, details, strict=True)
    ]
    return names, [fact.given for fact in facts]


def _facts(part: Sequence[FoundRow], labels: Mapping[str, str]) -> _Facts:
    item, row = part[0], part[0].row
    several = row.chosen_by or row.step is None or len({item.row.step for item in part}) > 1
    given = next((labels[name] for name in _handles(item) if name in labels), None)
    return _Facts(
        base=given or paper.method_name(row.method),
        given=given is not None,
        run=row.run or item.run.name,
        network=row.network,
        classifier=row.classifier_in_words,
        chosen="chosen on validation classes" if row.chosen_by else "",
        step="" if several else f"step {row.step:,}",
        folder=str(item.run),
        settings=f"settings {row.config_hash[:8]}",
        weights=f"weights {str(row.checkpoint_sha256)[:8]}",
    )


def _details(fact: _Facts, alike: Sequence[_Facts]) -> list[str]:
    """What the label needs beside its base, which `alike` have too. Runs with one given label are to be one line."""
    same_run = [other for other in alike if other.run == fact.run]
    same_network = [other for other in same_run if other.network == fact.network]
    same_classifier = [other for other in same_network if other.classifier == fact.classifier]
    details = [fact.run] if not fact.given and len({other.run for other in alike}) > 1 else []
    details += ["untrained"] if fact.network == "untrained" else []
    details += [fact.classifier] if len({other.classifier for other in same_network}) > 1 else []
    details += [fact.chosen] if fact.chosen and len({other.chosen for other in same_classifier}) > 1 else []
    details += [fact.step] if len({other.step for other in same_classifier}) > 1 and fact.step else []
    return details


def legible(text: str) -> str:
    """One line without control characters, whatever a row or the command line said."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))


def _handles(item: FoundRow) -> list[str]:
    """What the user may call a row's run by, the most telling first."""
    return [name for name in (str(item.run), item.row.run, item.run.name, item.row.method) if name]


def _check_labels(labels: Mapping[str, str], found: Sequence[FoundRow]) -> None:
    handles = {name for item in found for name in _handles(item)}
    for name in labels:
        if name not in handles:
            shown = ", ".join(sorted({item.row.run or item.row.method for item in found})[:8])
            raise UsageError(f"no run '{name}' (there are: {shown})", where=f"--label {name}=...")


def _check_cells(line: Line) -> None:
    first: dict[tuple[int, int, int], FoundRow] = {}
    for item in line.found:
        other = first.setdefault(cell_of(item.row), item)
        if other is not item:
            files = str(item.file) if item.file == other.file else f"{other.file} and {item.file}"
            what = f"'{line.label}' has two measurements of {item.row.protocol} (in {files})"
            remedy = "Choose by --only checkpoint_sha256=..., or give the runs labels of their own by --label"
            raise UsageError(what, remedy=remedy)


def _line(name: str, items: Sequence[FoundRow]) -> Line:
    methods = {item.row.method for item in items}
    classifiers = {item.row.classifier_in_words for item in items}
    only = [next(iter(values)) if len(values) == 1 else "" for values in (methods, classifiers)]
    return Line(name, only[0], only[1], any(item.row.chosen_by for item in items), tuple(items))
