"""The sequences that can be packed, and what of them planning needs, as columns: 100,000 of them fit easily."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.correspond.outline import Outline, read_outline
from pipeline.engines import read_spread
from pipeline.sequence import Sequence
from pipeline.shards.writer import SequenceContents
from pipeline.stages import LATER_STAGES, StageResult, read_marker


@dataclass(frozen=True)
class Catalogue:
    """n sequences, sorted by id.

    Attributes:
        sequences, instances, categories: one of each sequence.
        frames: (sum of V,) int32: the frames of the views, ascending within a sequence.
        view_starts: (n + 1,) where each sequence's views begin.
        pairs: (sum of P, 2) int32: the frames of the pairs, by row of correspondences.parquet.
        pair_starts: (n + 1,) where each sequence's pairs begin.
    """

    sequences: list[Sequence]
    instances: list[str]
    categories: list[str | None]
    frames: NDArray[np.int32]
    view_starts: NDArray[np.int64]
    pairs: NDArray[np.int32]
    pair_starts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.sequences)

    def views_of(self, k: int) -> slice:
        """The places of a sequence's views in `frames`."""
        return slice(int(self.view_starts[k]), int(self.view_starts[k + 1]))

    def pairs_of(self, k: int) -> slice:
        """The places of a sequence's pairs in `pairs`."""
        return slice(int(self.pair_starts[k]), int(self.pair_starts[k + 1]))


def make_catalogue(entries: Iterable[tuple[Sequence, str, str | None, Outline]]) -> Catalogue:
    """A catalogue of (sequence, instance, category, outline), which are sorted by id."""
    sequences, instances, categories, outlines = [], [], [], []
    for sequence, instance, category, outline in entries:
        sequences.append(sequence)
        instances.append(instance)
        categories.append(category)
        outlines.append(outline)
    return Catalogue(
        sequences,
        instances,
        categories,
        np.concatenate([np.zeros(0, np.int32), *(outline.frames for outline in outlines)]),
        _starts([len(outline.frames) for outline in outlines]),
        np.concatenate([np.zeros((0, 2), np.int32), *(outline.pairs for outline in outlines)]),
        _starts([len(outline.pairs) for outline in outlines]),
    )


def _starts(lengths: list[int]) -> NDArray[np.int64]:
    return np.cumsum([0, *lengths], dtype=np.int64)


def read_catalogue(sequences: Iterable[Sequence]) -> tuple[Catalogue, list[list[str | None]], dict[str, str]]:
    """The sequences that can be packed; what identifies each and its content; the others with the reason.

    Raises:
        BadInput: two sequences have the same id.
    """
    ordered = sorted(sequences, key=lambda sequence: sequence.id)
    for before, after in itertools.pairwise(ordered):
        if before.id == after.id:
            raise BadInput(
                f"has the same id as {before.folder}", where=after.folder, remedy="Rename one of the folders"
            )
    entries: list[tuple[Sequence, str, str | None, Outline]] = []
    marks: list[list[str | None]] = []
    left_out: dict[str, str] = {}
    for _, found in read_spread(_read_entries, [sequence.folder for sequence in ordered]):
        for folder, entry in found:
            sequence = Sequence(folder)
            if isinstance(entry, str):
                left_out[sequence.id] = entry
            else:
                entries.append((sequence, entry.instance, entry.category, entry.outline))
                marks.append([sequence.id, entry.fingerprint, entry.content, entry.category, entry.instance])
    return make_catalogue(entries), marks, left_out


@dataclass(frozen=True)
class _Entry:
    instance: str
    category: str | None
    outline: Outline
    fingerprint: str
    content: str | None
    """What was written: the same settings may have given something else (another version, more threads)."""


def _read_entries(folders: list[Path]) -> list[tuple[Path, _Entry | str]]:
    """Each sequence's entry, or why it cannot be packed."""
    return [(folder, _read_entry(Sequence(folder))) for folder in folders]


def _read_entry(sequence: Sequence) -> _Entry | str:
    marker = read_marker(sequence, "correspond")
    if marker is None or not marker.ok:
        return _why_not(sequence, marker)
    try:
        outline, info = _outline(sequence, marker), sequence.read_info()
    except BadInput as error:
        return str(error)
    content = marker.details.get("content")
    return _Entry(info.instance or sequence.id, info.category, outline, marker.fingerprint, content)


def _why_not(sequence: Sequence, marker: StageResult | None) -> str:
    """Why a sequence has no correspondences: the first stage that did not go well."""
    for stage in LATER_STAGES:
        row = marker if stage == "correspond" else read_marker(sequence, stage)
        if row is not None and not row.ok:
            return f"stage '{stage}' {row.status}: {row.reason}"
    return "stage 'correspond' has not been run"


def _outline(sequence: Sequence, marker: StageResult) -> Outline:
    """From the marker, else from the tables. Raises `BadInput` where a table or a view is absent or damaged."""
    outline = read_outline(sequence, marker.details)
    if outline is None:
        contents = SequenceContents.read(sequence)
        outline = Outline(contents.frames, contents.pair_frames)
    return outline
