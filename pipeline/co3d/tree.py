"""The layout of a CO3D download: categories, set lists of v1 and v2, and which paths may be followed.

ROOT/<category>/frame_annotations.jgz
ROOT/<category>/sequence_annotations.jgz
ROOT/<category>/set_lists.json                       v1: one file, {"train_known": [[sequence, number, path], ...]}
ROOT/<category>/set_lists/set_lists_<subset>.json    v2: a file a subset, {"train": [...], "val": ..., "test": ...}
ROOT/<category>/<sequence>/images, masks, depths, depth_masks, pointcloud.ply
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dope.common.errors import BadInput, UsageError, legible
from pipeline.co3d.annotations import read_rows, text_of
from pipeline.co3d.index import FRAMES_FILE


@dataclass
class Members:
    """What the chosen sets of the set lists name."""

    numbers: dict[str, array[int]] = field(default_factory=dict)
    """Frame numbers by sequence."""
    faults: list[tuple[str, int, str]] = field(default_factory=list)
    """(file, row from 1, what) of entries that name no frame; the first of each set stands for all."""


class NoSuchSet(BadInput):
    """A category does not have the set lists, or the sets in them, that are asked for."""


@dataclass(frozen=True)
class Category:
    """One category's folder."""

    root: Path
    name: str

    @property
    def folder(self) -> Path:
        return self.root / self.name

    @property
    def version(self) -> int:
        """2 where there is a folder of set lists, else 1."""
        return 2 if (self.folder / "set_lists").is_dir() else 1

    def set_list_files(self, subsets: list[str]) -> list[Path]:
        """The set lists of the named subsets, of all where none is named; v1 has one file, whose sets are its subsets.

        Raises:
            NoSuchSet: a subset that this category does not have.
        """
        if self.version == 1:
            path = self.folder / "set_lists.json"
            if not path.is_file():
                raise NoSuchSet("has no set lists", where=self.folder, remedy="Leave --subset and --split away")
            return [path]
        found = {path.stem.removeprefix("set_lists_"): path for path in self.folder.glob("set_lists/set_lists_*.json")}
        missing = [name for name in subsets if name not in found]
        if missing:
            there = ", ".join(sorted(found)) or "none"
            raise NoSuchSet(f"no subset {', '.join(missing)} (there are: {there})", where=self.folder)
        return [found[name] for name in subsets or sorted(found)]

    def members(self, subsets: list[str], sets: list[str]) -> Members | None:
        """The frames that the chosen sets name, or None where neither subsets nor sets are asked for.

        Args:
            subsets: v2: names of set lists ("fewview_dev"); v1: names of sets in the one list ("train_known").
            sets: names of sets in those lists ("train", "train_known"); empty = all.

        Raises:
            NoSuchSet: a subset or set that is not there, or sets that are all empty.
            BadInput: a set list that is damaged.
        """
        if not subsets and not sets:
            return None
        wanted = set(sets) | (set(subsets) if self.version == 1 else set())
        names, members = list[str](), Members()
        for path in self.set_list_files(subsets):
            faulty = set[str | None]()
            for name, number, entry, *_ in read_rows(path, "lists", names):
                if wanted and name not in wanted:
                    continue
                if _is_entry(entry):
                    members.numbers.setdefault(entry[0], array("q")).append(entry[1])
                elif name not in faulty:
                    faulty.add(name)
                    what = f"of set {legible(str(name))} is no [sequence, frame number, path]"
                    members.faults.append((str(path.relative_to(self.folder)), number + 1, what))
        there = ", ".join(sorted({legible(name) for name in names})) or "none"
        if missing := sorted(wanted - set(names)):
            raise NoSuchSet(f"no set {', '.join(missing)} in its set lists (there are: {there})", where=self.folder)
        if not members.numbers and not members.faults:
            what = f"set {', '.join(sorted(wanted)) or there} names no frame in its set lists"
            raise NoSuchSet(what, where=self.folder)
        return members

    def resolve(self, given: str) -> Path:
        """The file that a path of the annotations names.

        Raises:
            BadInput: it leads outside ROOT, by "..", as an absolute path or over links, or there is no such file.
                A category's own folder may be a link (categories on several disks).
        """
        shown = given if len(given) <= 200 else f"{given[:200]}..."
        if not is_inside(given):
            raise BadInput(f"leads outside {self.root} ({shown!r})")
        path = self.root / given
        try:
            real = path.resolve()
            inside = any(real.is_relative_to(place.resolve()) for place in (self.root, self.folder))
            there = real.is_file()
        except (OSError, RuntimeError, ValueError) as error:  # links in a circle, names too long
            reason = error.strerror if isinstance(error, OSError) else "links in a circle"
            raise BadInput(f"cannot be followed ({reason}: {shown!r})") from error
        if not inside:
            raise BadInput(f"leads outside {self.root} over a link ({shown!r})")
        if not there:
            raise BadInput(f"is not there ({shown})")
        return path


def find_categories(root: Path, names: list[str]) -> tuple[list[Category], list[tuple[str, str]]]:
    """The categories of a download, of all or the named ones, and (name, reason) of those that cannot be used.

    Raises:
        UsageError: `root` is no CO3D download, or its name cannot be written down.
    """
    if not root.is_dir():
        raise UsageError("no such folder", where=root)
    if not _is_legible(root.absolute()):
        raise UsageError("its name is not UTF-8", where=root, remedy="Rename it")
    if (root / FRAMES_FILE).is_file():
        name = root.absolute().name
        remedy = f"Give the folder above it, with --category {name}"
        raise UsageError("is one category, not the folder of all", where=root, remedy=remedy)
    there = sorted(path.parent.name for path in root.glob(f"*/{FRAMES_FILE}"))
    if not there:
        raise UsageError(f"holds no <category>/{FRAMES_FILE}", where=root, remedy="Give the folder of a CO3D download")
    chosen = list(dict.fromkeys(names)) or there
    listed = f"{', '.join(map(legible, there[:10]))}{' ...' if len(there) > 10 else ''}"
    usable: list[Category] = []
    unusable: list[tuple[str, str]] = []
    for name in chosen:
        shown = legible(name)
        if name not in there:
            unusable.append((shown, f"{root}: no category '{shown}' (there are: {listed})"))
        elif _is_legible(name):
            usable.append(Category(root, name))
        else:
            unusable.append((shown, f"{root / shown}: its name is not UTF-8. Rename it"))
    return usable, unusable


def _is_legible(name: str | Path) -> bool:
    """Can a file's name be written as UTF-8 text, into annotations' index and into sequence.json?"""
    return legible(name) == str(name)


def is_inside(given: str) -> bool:
    """Does a relative path stay below the folder it starts from, as far as its text says?"""
    return bool(given) and not given.startswith("/") and ".." not in given.split("/") and "\0" not in given


def _is_entry(entry: Any) -> bool:
    """Is it [sequence, frame number, ...]?"""
    if not isinstance(entry, list) or len(entry) < 2 or text_of(entry[0]) is None:
        return False
    return isinstance(entry[1], int) and not isinstance(entry[1], bool) and abs(entry[1]) <= 2**31
