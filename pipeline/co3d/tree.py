"""The layout of a CO3D download: categories, set lists of v1 and v2, and which paths may be followed.

ROOT/<category>/frame_annotations.jgz
ROOT/<category>/sequence_annotations.jgz
ROOT/<category>/set_lists.json                       v1: one file, {"train_known": [[sequence, number, path], ...]}
ROOT/<category>/set_lists/set_lists_<subset>.json    v2: a file a subset, {"train": [...], "val": ..., "test": ...}
ROOT/<category>/<sequence>/images, masks, depths, depth_masks, pointcloud.ply
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from pathlib import Path

from dope.common.errors import BadInput, UsageError
from pipeline.co3d.annotations import read_rows
from pipeline.co3d.index import FRAMES_FILE

Members = dict[str, "array[int]"]
"""Frame numbers by sequence."""


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
        """The frames that the set lists name, or None where neither subsets nor sets are asked for.

        Args:
            subsets: v2: names of set lists ("fewview_dev"); v1: names of sets in the one list ("train_known").
            sets: names of sets in those lists ("train", "train_known"); empty = all.

        Raises:
            NoSuchSet: a subset or set that is not there.
            BadInput: a set list that is damaged.
        """
        if not subsets and not sets:
            return None
        wanted = set(sets) | (set(subsets) if self.version == 1 else set())
        names, members = set[str](), Members()
        for path in self.set_list_files(subsets):
            for name, _, entry, *_ in read_rows(path, "lists"):
                names.add(str(name))
                if (not wanted or name in wanted) and _is_entry(entry):
                    members.setdefault(entry[0], array("q")).append(entry[1])
        if missing := sorted(wanted - names):
            there = ", ".join(sorted(names)) or "none"
            raise NoSuchSet(f"no set {', '.join(missing)} in its set lists (there are: {there})", where=self.folder)
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
    """The categories of a download, of all or the named ones, and (name, reason) of those that are not there.

    Raises:
        UsageError: `root` is no CO3D download.
    """
    if not root.is_dir():
        raise UsageError("no such folder", where=root)
    if (root / FRAMES_FILE).is_file():
        name = root.absolute().name
        remedy = f"Give the folder above it, with --category {name}"
        raise UsageError("is one category, not the folder of all", where=root, remedy=remedy)
    there = sorted(path.parent.name for path in root.glob(f"*/{FRAMES_FILE}"))
    if not there:
        raise UsageError(f"holds no <category>/{FRAMES_FILE}", where=root, remedy="Give the folder of a CO3D download")
    chosen = list(dict.fromkeys(names)) or there
    listed = f"{', '.join(there[:10])}{' ...' if len(there) > 10 else ''}"
    missing = [(name, f"{root}: no category '{name}' (there are: {listed})") for name in chosen if name not in there]
    return [Category(root, name) for name in chosen if name in there], missing


def is_inside(given: str) -> bool:
    """Does a relative path stay below the folder it starts from, as far as its text says?"""
    return bool(given) and not given.startswith("/") and ".." not in given.split("/") and "\0" not in given


def _is_entry(entry: object) -> bool:
    return (
        isinstance(entry, list)
        and len(entry) >= 2
        and isinstance(entry[0], str)
        and isinstance(entry[1], int)
        and abs(entry[1]) <= 2**31
    )
