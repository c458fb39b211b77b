"""Which camera belongs to which frame, by the names of images as other tools write them."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from dope.common.errors import BadInput
from pipeline.inputs.photos import PHOTO_SUFFIXES, UNSUPPORTED_PHOTOS
from pipeline.sequence import Frame

SUFFIXES = frozenset({*PHOTO_SUFFIXES, *UNSUPPORTED_PHOTOS})
LAST_NUMBER = re.compile(r"(\d+)\D*$")


def match_names(
    names: Iterable[str], frames: list[Frame], *, by_number: bool, folder: Path, where: Path | str
) -> dict[int, str]:
    """Frame number -> name. Frames without a name of their own are left out.

    Photos: by file name, whatever the folders above and the suffix. Where several names end in the same file
    name, the one that shares most folders with the photo's own path belongs to it. Of photos that differ in their
    suffix only, the one that is named in full.

    Args:
        names: names of images, with or without folders and suffix.
        frames: frames that have an image.
        by_number: match the last number in the name with the frame's number in the video, from 0.
        folder: where the photos lie.
        where: what the names come from, for messages.

    Raises:
        BadInput: no name belongs to any frame, or it cannot be told which of several does.
    """
    names = list(names)
    by_key: dict[str, list[str]] = defaultdict(list)
    for name in names:
        by_key[_key(name, by_number)].append(name)
    by_key.pop("", None)
    matched: dict[int, str] = {}
    for frame in frames:
        own = folder / frame.source_name
        candidates = by_key.get(_key(frame.source_name, by_number), [])
        if candidates:
            matched[frame.frame] = candidates[0] if len(candidates) == 1 else _nearest(own, candidates, where)
    _only_one_each(matched, {frame.frame: frame.source_name for frame in frames}, where)
    if not matched:
        how = "the frame's number in the video, from 0" if by_number else "the photo's file name"
        raise BadInput(
            f"no camera belongs to any frame: cameras are named {listed(names)}, "
            f"frames {listed(frame.source_name for frame in frames)}",
            where=where,
            remedy=f"A camera is found by {how}",
        )
    return matched


def _only_one_each(matched: dict[int, str], sources: dict[int, str], where: Path | str) -> None:
    """Leave each name to one frame. Raises `BadInput` where it cannot be told to which."""
    claims: dict[str, list[int]] = defaultdict(list)
    for number, name in matched.items():
        claims[name].append(number)
    for name, numbers in claims.items():
        exact = [number for number in numbers if sources[number] == PurePosixPath(name.replace("\\", "/")).name]
        if len(numbers) > 1 and len(exact) != 1:
            raise BadInput(
                f"the camera of '{name}' may belong to several frames: {listed(sources[n] for n in numbers)}",
                where=where,
                remedy="Leave one of these photos in the folder, or name cameras with the photo's suffix",
            )
        for number in numbers:
            if len(numbers) > 1 and number not in exact:
                del matched[number]


def listed(names: Iterable[str], most: int = 3) -> str:
    """A few names, for messages."""
    names = list(names)
    return ", ".join(f"'{name}'" for name in names[:most]) + (" ..." if len(names) > most else "")


def _nearest(own: Path, candidates: list[str], where: Path | str) -> str:
    def closeness(name: str) -> tuple[int, bool]:
        shared = 0
        for a, b in zip(_parts(str(own)), _parts(name), strict=False):
            if a != b:
                break
            shared += 1
        return shared, PurePosixPath(name.replace("\\", "/")).name == own.name

    ranked = sorted(candidates, key=closeness, reverse=True)
    if closeness(ranked[0]) == closeness(ranked[1]):
        raise BadInput(
            f"several cameras may belong to frame '{own.name}': {listed(ranked)}",
            where=where,
            remedy="Keep those of one folder, or name the folders as they are on disk",
        )
    return ranked[0]


def _parts(name: str) -> tuple[str, ...]:
    """The parts of a path, last first, without the suffix of a picture."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    if not parts:
        return ()
    last = PurePosixPath(parts[-1])
    return (last.stem if last.suffix.lower() in SUFFIXES else last.name, *reversed(parts[:-1]))


def _key(name: str, by_number: bool) -> str:
    """What a name and a frame must have in common; empty: nothing can."""
    stem = (*_parts(name), "")[0]
    if not by_number:
        return stem
    found = LAST_NUMBER.search(stem)
    return str(int(found[1])) if found else ""
