"""An id for each source that no other has, on any file system."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

from pipeline.sequence import sequence_id


class Named(Protocol):
    """A frozen dataclass of a source."""

    @property
    def path(self) -> Path: ...

    @property
    def id(self) -> str: ...

    @property
    def home(self) -> Path:
        """What the sequence is named after."""
        ...


S = TypeVar("S", bound=Named)


def name_of(path: Path) -> str:
    """The id that a file or folder gives by its own name."""
    path = path.absolute()  # "." and ".." have no name of their own
    path = path if path.name not in ("", "..") else path.resolve()
    return sequence_id(path.name if path.is_dir() else path.stem)


def with_unique_ids(sources: list[S], known: Mapping[Path, str]) -> list[S]:
    """Prefix parents' names until no two ids are equal on any file system, then the file type, then a number.

    Ids depend on the sources given and on what WORK held before them, not on how far their own preparation came: a
    run that goes on, or a container that starts late, gives the ids that the first one gave. Known sources keep their
    ids, and nobody else gets one of those.
    """
    places = [source.path.resolve() for source in sources]
    given = set(places)
    others = {name.casefold() for place, name in known.items() if place not in given}
    named = [
        _renamed(source, known.get(place, source.id))
        for source, place in zip(_unique([*sources], others), places, strict=True)
    ]
    new = [source for source, place in zip(named, places, strict=True) if place not in known]
    renamed = iter(_unique(new, {name.casefold() for name in known.values()}))
    return [source if place in known else next(renamed) for source, place in zip(named, places, strict=True)]


def _unique(sources: list[S], reserved: set[str]) -> list[S]:
    for level in range(1, 5):
        groups: dict[str, list[int]] = defaultdict(list)
        for index, source in enumerate(sources):
            groups[source.id.casefold()].append(index)
        taken_names = [name for name, group in groups.items() if len(group) > 1 or name in reserved]
        clashes = [index for name in taken_names for index in groups[name]]
        if not clashes:
            return sources
        for index in clashes:
            source = sources[index]
            parents = [p.name for p in source.home.absolute().parents if p.name]
            if level <= 3:
                prefix = "_".join(reversed(parents[:level]))
                name = f"{prefix}_{name_of(source.home)}"
            else:
                name = f"{source.id}_{source.path.suffix[1:] or 'photos'}"
            sources[index] = _renamed(source, sequence_id(name))
    taken = set(reserved)
    for index, source in enumerate(sources):
        name, number = source.id, 2
        while name.casefold() in taken:
            name, number = f"{source.id}_{number}", number + 1
        taken.add(name.casefold())
        sources[index] = _renamed(source, name)
    return sources


def _renamed(source: S, name: str) -> S:
    return cast("S", replace(cast("Any", source), id=name))
