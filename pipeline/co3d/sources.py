"""Which sequences of a CO3D download are wanted, under which ids, and what identifies their content."""

from __future__ import annotations

import hashlib
import os
from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dope.common.errors import BadInput
from pipeline.co3d.annotations import FrameAnnotation, SequenceAnnotation
from pipeline.co3d.index import FILE_COLUMNS, CategoryIndex, IndexedSequence, Row, frame_of, open_index
from pipeline.co3d.tree import Category, Members, NoSuchSet, find_categories, is_inside
from pipeline.refused import refused
from pipeline.sequence import sequence_id
from pipeline.stages import StageResult

LONGEST_ID = 120


@dataclass(frozen=True)
class Choice:
    """What a command line asks for; nothing here changes how a sequence is prepared, but for its frames' sets."""

    categories: list[str] = field(default_factory=list)
    """Empty: all that are there."""
    subsets: list[str] = field(default_factory=list)
    """Set lists (v2), or sets of the one list (v1); empty: no restriction."""
    sets: list[str] = field(default_factory=list)
    """Sets within the set lists ("train", "val", "test", "train_known" ...); empty: all of the subsets."""
    sequences: list[str] = field(default_factory=list)
    """Names as CO3D has them, or ids; empty: all."""
    min_viewpoint_quality: float | None = None
    """Sequences with a lower score, or with none, are left out."""
    min_point_cloud_quality: float | None = None
    """The same for the point cloud's score."""
    limit: int | None = None
    """At most so many sequences of each category, in the order of their names."""


@dataclass(frozen=True)
class Co3dSource:
    """One sequence of a CO3D download.

    Attributes:
        category: where it lies.
        index: the category's annotations.
        indexed: what the index says of it.
        id: name of the prepared sequence: <category>_<name>, whatever else is chosen.
        members: frame numbers that the set lists allow, or None.
    """

    category: Category
    index: CategoryIndex
    indexed: IndexedSequence
    id: str
    members: array[int] | None = None

    @property
    def annotation(self) -> SequenceAnnotation:
        """Its name, scores and point cloud."""
        return self.indexed.annotation

    @property
    def path(self) -> Path:
        """The sequence's folder, as a name of the source; it need not be there."""
        return self.category.folder.absolute() / self.annotation.name

    @property
    def not_annotated(self) -> list[int]:
        """Frame numbers that the set lists name and the annotations do not."""
        if self.members is None:
            return []
        return sorted(set(self.members) - {row[0] for row in self.index.rows(self.indexed)})

    def frames(self, every: int) -> list[FrameAnnotation]:
        """The frames that are wanted: of the chosen sets, and every k-th by frame number from the first on."""
        return [frame_of(row) for row in self.rows(every)]

    def rows(self, every: int) -> list[Row]:
        """The same as the index holds them."""
        rows = self.index.rows(self.indexed, max(1, every))
        if self.members is None:
            return rows
        allowed = set(self.members)
        return [row for row in rows if row[0] in allowed]


def find_co3d(
    root: Path, work: Path, choice: Choice, tell: Callable[[str], None] = lambda text: None
) -> tuple[list[Co3dSource], list[StageResult], list[StageResult]]:
    """The chosen sequences of a download; rows of what cannot be used; rows of what is left out as was asked for.

    Args:
        tell: called with a line for each category whose annotations are read.

    Raises:
        UsageError: `root` is no CO3D download.
        DiskFull: no room for the index.
    """
    categories, missing = find_categories(root, choice.categories)
    sources: list[Co3dSource] = []
    failed = [_row(name, "failed", reason) for name, reason in missing]
    left_out: list[StageResult] = []
    without_set: list[StageResult] = []
    taken: dict[str, str] = {}
    for category in categories:
        try:
            members = category.members(choice.subsets, choice.sets)
            index = open_index(category.folder, work, tell)
            sequences = index.sequences()
            faults = index.faults()
        except NoSuchSet as error:
            without_set.append(_row(category.name, "failed", str(error)))
            continue
        except BadInput as error:  # the other categories go on
            failed.append(_row(category.name, "failed", str(error)))
            continue
        faults += members.faults if members is not None else []
        failed += [_row(category.name, "failed", _fault(category, *fault)) for fault in faults]
        chosen, bad, out = _choose(category, index, sequences, members, choice, taken)
        sources, failed, left_out = sources + chosen, failed + bad, left_out + out
    if choice.categories or len(without_set) == len(categories):
        failed += without_set
    else:  # not every category has every set list: where none was named, those that do are meant
        left_out += [_row(row.sequence, "empty", f"left out: {row.reason}") for row in without_set]
    told = [*failed, *left_out]
    known = {name for source in sources for name in (source.annotation.name, source.id)}
    known |= {str(name) for row in told for name in (row.sequence, row.details.get("name"))}
    failed += [
        _row(sequence_id(name), "failed", f"{root}: no sequence '{name}' in the chosen categories")
        for name in dict.fromkeys(choice.sequences)
        if name not in known
    ]
    return sources, failed, left_out


def co3d_id(category: str, name: str) -> str:
    """A sequence's id in WORK: the same whatever else is chosen, and different for different names."""
    plain = f"{category}_{name}"
    if sequence_id(plain) == plain and len(plain.encode()) <= LONGEST_ID:
        return plain
    mark = hashlib.sha256(f"{category}\0{name}".encode()).hexdigest()[:8]
    short = sequence_id(plain).encode()[: LONGEST_ID - 9].decode(errors="ignore")
    return f"{short}-{mark}"


def source_fingerprint(source: Co3dSource, every: int) -> tuple[dict[str, Any], int, int]:
    """Identifies a sequence by its annotations and by its files' sizes (JSON values); its frames, and images there.

    Files are not opened: a download has millions, and CO3D's do not change without a new size.
    """
    digest, present, rows = hashlib.sha256(), 0, source.rows(every)
    for row in rows:
        sizes = [_size(source, row[column]) for column in FILE_COLUMNS]
        present += sizes[0] is not None
        digest.update(f"{row}{sizes}".encode())
    a = source.annotation
    digest.update(f"{a.point_cloud!r}{_size(source, a.point_cloud)}".encode())
    value = {"kind": "co3d", "id": source.id, "category": source.category.name, "name": a.name}
    return {**value, "frames": f"{len(rows)}:{digest.hexdigest()}"}, len(rows), present


def _choose(
    category: Category,
    index: CategoryIndex,
    sequences: list[IndexedSequence],
    members: Members | None,
    choice: Choice,
    taken: dict[str, str],
) -> tuple[list[Co3dSource], list[StageResult], list[StageResult]]:
    """The sequences of one category that are wanted, and rows of those that cannot be used or are left out.

    Args:
        taken: ids of all categories so far, without case, and whose they are; those of this one are added.
    """
    chosen: list[Co3dSource] = []
    failed: list[StageResult] = []
    left_out: list[StageResult] = []
    for sequence in sequences:
        name = sequence.annotation.name
        number = co3d_id(category.name, name)
        if choice.sequences and name not in choice.sequences and number not in choice.sequences:
            continue
        if members is not None and name not in members.numbers:
            continue  # not part of what was asked for
        if (reason := _too_poor(sequence.annotation, choice)) is not None:
            left_out.append(_row(number, "empty", reason, name))
        elif not sequence.n_frames:
            failed.append(_row(number, "failed", f"{category.folder}: no frame of '{name}' is annotated", name))
        elif choice.limit is not None and len(chosen) >= choice.limit:
            break
        elif number.casefold() in taken:
            reason = f"{category.folder}: '{name}' has the id of {taken[number.casefold()]} (case does not count)"
            failed.append(_row(number, "failed", reason, name))
        else:
            taken[number.casefold()] = f"'{name}' of {category.name}"
            allowed = None if members is None else members.numbers[name]
            chosen.append(Co3dSource(category, index, sequence, number, allowed))
    annotated = {sequence.annotation.name for sequence in sequences}
    for name in members.numbers if members is not None else ():
        number = co3d_id(category.name, name)
        if name not in annotated and (not choice.sequences or name in choice.sequences or number in choice.sequences):
            reason = f"{category.folder}: its set lists name the sequence '{name}', its annotations do not"
            failed.append(_row(number, "failed", f"{reason}. Download the category again", name))
    return chosen, failed, left_out


def _too_poor(annotation: SequenceAnnotation, choice: Choice) -> str | None:
    """Why a sequence is left out for its scores, or None. Without a score nothing is known: it is left out, too."""
    scores: Iterable[tuple[str, float | None, float | None]] = (
        ("viewpoint", annotation.viewpoint_quality, choice.min_viewpoint_quality),
        ("point-cloud", annotation.point_cloud_quality, choice.min_point_cloud_quality),
    )
    for what, score, least in scores:
        if least is None:
            continue
        if score is None:
            return f"left out: it has no {what.replace('-', ' ')} quality score (--min-{what}-quality {least:g})"
        if score < least:
            return f"left out: {what.replace('-', ' ')} quality {score:.3g} (--min-{what}-quality {least:g})"
    return None


def _fault(category: Category, file: str, row: int, what: str) -> str:
    return f"{category.folder / file}: row {row} {what}; such rows were left out"


def _row(name: str, status: str, reason: str, given: str | None = None) -> StageResult:
    row = refused(name, "frames", reason) if status == "failed" else StageResult(name, "frames", "empty", reason=reason)
    row.details |= {"name": given} if given is not None else {}
    return row


def _size(source: Co3dSource, path: str | None) -> int | None:
    """Bytes of a file, None where there is none or it is not to be looked at."""
    if path is None or not is_inside(path):
        return None
    try:
        return os.stat(f"{source.category.root}/{path}").st_size  # noqa: PTH116 - a Path each would cost more
    except OSError:
        return None
