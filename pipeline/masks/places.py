"""Where the masks of each sequence lie that a command line means."""

from __future__ import annotations

from pathlib import Path

from dope.common.errors import UsageError


def find_masks(given: str, ids: list[str]) -> dict[str, Path]:
    """The masks of each sequence: a folder of mask files, or a file of results in COCO's format.

    results.json             one file for all of them
    masks/<id>/              a folder of mask files for each
    results/<id>.json        a file of results for each
    masks/*.png              the masks themselves, where there is one sequence only
    inference/*.json         the one file of results in a folder that holds nothing else of this

    "{}" in `given` stands for the sequence's id. Sequences without masks are left out.

    Raises:
        UsageError: not one of the sequences has masks, or it cannot be told which masks are meant.
    """
    if "{}" in given:
        expected = {name: Path(given.replace("{}", name)) for name in ids}
        return _there(expected, given)
    folder = Path(given)
    if folder.is_file():
        return dict.fromkeys(ids, folder)
    own = {name: [p for p in (folder / name, folder / f"{name}.json") if p.exists()] for name in ids}
    for name, places in own.items():
        if len(places) > 1:
            remedy = "Leave one of them there, or name one: --from '" + str(folder / "{}.json") + "'"
            raise UsageError(
                f"holds two kinds of masks for '{name}': {name}/ and {name}.json", where=given, remedy=remedy
            )
    found = {name: places[0] for name, places in own.items() if places}
    if found or not folder.is_dir():
        return found or _there({name: folder / name for name in ids}, given)
    files = sorted(path for path in folder.glob("*.json") if path.is_file())
    if len(files) > 1:
        raise UsageError(
            f"holds several files of results: {', '.join(path.name for path in files[:5])}",
            where=given,
            remedy="Name one of them, or call them <sequence>.json",
        )
    if files:
        return dict.fromkeys(ids, files[0])
    return _there({ids[0]: folder} if len(ids) == 1 else {name: folder / name for name in ids}, given)


def is_shared(masks: dict[str, Path]) -> bool:
    """Is one file of results there for several sequences?"""
    return len(set(masks.values())) < len(masks)


def _there(expected: dict[str, Path], given: str) -> dict[str, Path]:
    there = {name: place for name, place in expected.items() if place.is_dir() or place.is_file()}
    if not there:
        places = ", ".join(str(place) for place in list(expected.values())[:3])
        remedy = f"Expected {places}, or a .json file of results"
        raise UsageError("holds no masks for any sequence", where=given, remedy=remedy)
    return there
