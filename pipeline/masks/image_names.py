"""Which image of a file of results is which frame of a sequence.

Tools are run on the source's own photos or frames, or on the images/ that `dope prep` stored, in one folder or in many,
and call an image by its name or by a number only. One rule for all of that:

1. A name with folders belongs to a sequence if one of the folders is the sequence's id (two or three folders together,
   `bottles/01` for `bottles_01`). Where no image in the file names the sequence, folders say nothing, unless the file
   is there for several sequences.
2. Then a name is the source's (`IMG_1.jpg`, with any or no suffix; for videos the last number in it is the frame's
   number from 0), or that of a stored image (`000012.jpg`). An id without a name is the last number in either.
3. Source names are believed, unless all images of the file are stored names and more frames are found by those. Where
   both find as many, but not the same ones, the setting `names` has to say it.
"""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

from dope.common.errors import BadInput
from pipeline.masks.results_file import ImageKey, Results
from pipeline.sequence import Frame, Sequence, sequence_id

Names = Literal["auto", "source", "stored"]
Found = dict[int, ImageKey]
"""Image of each frame, by the frame's index."""


@dataclass(frozen=True)
class Matched:
    """Which image is which frame, and whose name it has."""

    images: Found
    names: Literal["source", "stored", "either"]
    """Whose names the images have; "either" where source and stored images are called the same."""


def match_images(sequence: Sequence, frames: list[Frame], results: Results, names: Names, *, shared: bool) -> Matched:
    """The image of each frame that has one.

    Args:
        shared: the file holds results of several sequences, so a bare name or number says nothing.

    Raises:
        BadInput: no image belongs to any frame, or one frame has two, or it cannot be told which is meant; it says
            what to give.
    """
    numbers = [key for key in results.images if isinstance(key, int) and not results.names.get(key)]
    if shared and numbers:
        raise BadInput(
            f"has image ids without names ({numbers[0]} ...), and is given for several sequences",
            where=results.path,
            remedy="Give the table of images with --coco-images, or a folder with <sequence>.json for each",
        )
    called = {key: results.names.get(key) or [str(key)] for key in results.images if key not in set(numbers)}
    of_sequence = _of_sequence(called, sequence.id, shared)
    by_number = sequence.read_info().kind == "video"
    sources = _Lookup(frames, results, by_number=by_number, stored=False)
    stored = _Lookup(frames, results, by_number=by_number, stored=True)
    for key, file_names in of_sequence.items():
        for name in file_names:
            sources.add_name(key, name)
            stored.add_name(key, name)
    for number in numbers:
        sources.add_number(number)
        stored.add_number(number)
    matched = _chosen(sources, stored, names)
    if not matched.images:
        raise _nothing_found(frames, results, of_sequence, by_number, sequence.id, shared)
    unknown = [number for number in numbers if number not in sources.known and number not in stored.known]
    if unknown and not by_number:
        raise BadInput(
            f"image id {unknown[0]} is the number of no photo: ids and numbers in names seem to be different things",
            where=results.path,
            remedy="Give the table of images with --coco-images",
        )
    return matched


class _Lookup:
    """Frames by their source's names or by their stored names, and which image was found for each."""

    def __init__(self, frames: list[Frame], results: Results, *, by_number: bool, stored: bool) -> None:
        self.where, self.by_number = results.path, by_number and not stored
        self.named: dict[str, int] = {}
        self.numbered: dict[int, list[int]] = defaultdict(list)
        self.frames = {frame.frame: frame for frame in frames}
        self.found: Found = {}
        self.known: set[ImageKey] = set()
        """Images that are frames, with or without an image of their own (dropped frames)."""
        self.strangers = 0
        for frame in frames:
            name = f"{frame.frame:06d}.jpg" if stored else frame.source_name
            self.named[name] = self.named[PurePosixPath(name).stem] = frame.frame
            digits = re.findall(r"\d+", PurePosixPath(name).stem if not by_number or stored else name)
            if digits:
                self.numbered[int(digits[-1])].append(frame.frame)

    def add_name(self, key: ImageKey, name: str) -> None:
        base = PurePosixPath(name.replace("\\", "/")).name
        if self.by_number:
            digits = re.findall(r"\d+", PurePosixPath(base).stem)
            self._note(key, self.numbered.get(int(digits[-1]), []) if digits else [])
            return
        stems = (base, PurePosixPath(base).stem, PurePosixPath(PurePosixPath(base).stem).stem)
        index = next((self.named[stem] for stem in stems if stem in self.named), None)
        self._note(key, [] if index is None else [index])

    def add_number(self, number: int) -> None:
        indices = self.numbered.get(number, [])
        if len(indices) > 1:
            both = " and ".join(f"'{self.frames[index].source_name}'" for index in indices[:2])
            remedy = "Give the table of images with --coco-images"
            raise BadInput(f"image id {number} could be {both}", where=self.where, remedy=remedy)
        self._note(number, indices)

    def _note(self, key: ImageKey, indices: list[int]) -> None:
        if not indices:
            self.strangers += 1
            return
        (index, *_) = indices
        self.known.add(key)
        if self.frames[index].image is None:
            return
        before = self.found.setdefault(index, key)
        if before != key:
            name = self.frames[index].source_name
            raise BadInput(
                f"two images could be '{name}': {before!r} and {key!r}",
                where=self.where,
                remedy="Names with the folder <sequence>/ tell them apart, or a results file for each sequence",
            )


def _of_sequence(called: dict[ImageKey, list[str]], name: str, shared: bool) -> dict[ImageKey, list[str]]:
    """The images whose folders name the sequence; all of them where none does and the file is this sequence's own."""
    own: dict[ImageKey, list[str]] = {}
    for key, file_names in called.items():
        named = [file_name for file_name in file_names if _names(file_name, name)]
        if named:
            own[key] = named
    return own if own or shared else called


def _names(file_name: str, name: str) -> bool:
    parents = [sequence_id(part) for part in PurePosixPath(file_name.replace("\\", "/")).parts[:-1]]
    spans = ("_".join(parents[i : i + n]) for n in (1, 2, 3) for i in range(len(parents) - n + 1))
    return any(span.casefold() == name.casefold() for span in spans)


def _chosen(sources: _Lookup, stored: _Lookup, names: Names) -> Matched:
    if names == "source" or (names == "auto" and (stored.strangers or not stored.found)):
        return Matched(sources.found, "source")
    if names == "stored" or len(stored.found) > len(sources.found):
        return Matched(stored.found, "stored")
    if len(stored.found) == len(sources.found) and stored.found != sources.found:
        index = next(index for index in stored.found if stored.found[index] != sources.found.get(index))
        raise BadInput(
            f"image {stored.found[index]!r} could be the stored image {index:06d}.jpg or a source image of that name",
            where=sources.where,
            remedy="Say which with --set names=stored or --set names=source",
        )
    return Matched(sources.found, "either" if stored.found == sources.found else "source")


def _nothing_found(
    frames: list[Frame], results: Results, own: dict[ImageKey, list[str]], by_number: bool, name: str, shared: bool
) -> BadInput:
    given = ", ".join(str((results.names.get(key) or [str(key)])[0]) for key in list(results.images)[:3])
    wanted = ", ".join(frame.source_name for frame in frames[:3])
    if shared and not own:
        remedy = f"Names need the folder {name}/, or give a folder with {name}.json"
    elif by_number:
        remedy = "A name's last number is the frame's number from 0"
    else:
        remedy = "Give the table of images with --coco-images" if not own else "Names are those of the photos"
    return BadInput(
        f"no image in it ({given} ...) is one of the frames ({wanted} ...)", where=results.path, remedy=remedy
    )
