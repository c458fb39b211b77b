"""Episodes: which views are the labelled shots and which the queries, all drawn before anything is encoded.

Paper section 4: an episode draws classes, then objects without overlap between shots and queries, then one random
view of each object.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import UsageError
from dope.common.seeds import generator

Indices = NDArray[np.int64]
Population = Mapping[str, Mapping[str, Sequence[int]]]
"""class -> object -> the indices of its views."""

_PERMUTATION_ENTRIES = 1 << 22  # rows are permuted in chunks of this many entries, so that memory stays small


@dataclass(frozen=True)
class EpisodeConfig:
    """One protocol, e.g. "5-way 1-shot"."""

    ways: int = 5
    """Classes an episode."""
    shots: int = 1
    """Labelled views a class."""
    queries: int = 15
    """Views to be recognised a class."""
    episodes: int = 2500
    """Number of episodes."""
    seed: int = 0
    """Seed of the draw: the same seed and views give the same episodes."""
    classes: Literal["category", "instance"] = "category"
    """What is to be recognised: the category of unseen objects, or which object it is (shots and queries are then
    distinct views of one object)."""
    shot_mode: Literal["several_instances", "one_instance"] = "several_instances"
    """The shots of a category: one view each of several objects (the paper), or several views of one object."""
    fit: bool = False
    """Use fewer ways and queries where the views do not suffice, instead of refusing."""

    @property
    def name(self) -> str:
        return f"{self.ways}-way {self.shots}-shot"


@dataclass(frozen=True)
class Episodes:
    """E drawn episodes.

    Attributes:
        support: (E, ways, shots) indices of views.
        query: (E, ways, queries) indices of views.
        classes: (E, ways) indices into `names`.
        names: the classes that could be drawn, sorted.
        config: what was drawn; with `fit`, its ways and queries may be lower than what was asked for.
        left_out: the classes with too few objects (only with `fit`).
    """

    support: Indices
    query: Indices
    classes: Indices
    names: tuple[str, ...]
    config: EpisodeConfig
    left_out: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.support)

    @property
    def chance(self) -> float:
        """Accuracy of guessing."""
        return 1 / self.config.ways


def sample_episodes(population: Population, config: EpisodeConfig) -> Episodes:
    """Draw all episodes; a function of the population and `config` alone.

    Args:
        population: class -> object -> indices of its views. With `classes="instance"` each object becomes a class.
        config: the protocol.

    Raises:
        UsageError: a number out of range, or too few classes, objects or views for what is asked (unless `fit`).
    """
    _check_numbers(config)
    population = classes_of(population, config)
    if config.classes == "instance":
        config = replace(config, shot_mode="several_instances")  # an instance's shots are views of it either way
    pools = {name: _Pool.of(population[name].values(), config) for name in sorted(population)}
    config, names = _suited(pools, config)

    rng = generator(config.seed, "episodes")
    classes = _distinct(rng, config.episodes, len(names), config.ways)
    support = np.empty((config.episodes, config.ways, config.shots), np.int64)
    query = np.empty((config.episodes, config.ways, config.queries), np.int64)
    for number, name in enumerate(names):
        rows = np.nonzero(classes == number)
        support[rows], query[rows] = pools[name].draw(rng, len(rows[0]), config)
    return Episodes(support, query, classes, names, config, tuple(name for name in pools if name not in names))


def classes_of(population: Population, config: EpisodeConfig) -> Population:
    """What is told apart: the categories as they are, or each object as a class whose "objects" are its views."""
    if config.classes == "category":
        return population
    return {
        f"{name}/{obj}" if name else obj: {str(view): [view] for view in views}
        for name, objects in population.items()
        for obj, views in objects.items()
    }


@dataclass(frozen=True)
class _Pool:
    """The objects of one class; `views[starts[i] : starts[i] + counts[i]]` are the views of object i."""

    views: Indices
    starts: Indices
    counts: Indices
    n_shot_objects: int
    """The first so many objects have views enough to give all the shots of a class."""

    @classmethod
    def of(cls, objects: Iterable[Sequence[int]], config: EpisodeConfig) -> _Pool:
        # objects with views enough come first, so that the shots' object is a draw below n_shot_objects
        ordered = sorted((views for views in objects if len(views)), key=lambda views: len(views) < config.shots)
        counts = np.array([len(views) for views in ordered], np.int64)
        views = np.concatenate([np.asarray(views, np.int64) for views in ordered]) if ordered else counts
        return cls(views, np.cumsum(counts) - counts, counts, int(np.sum(counts >= config.shots)))

    def queries_left(self, config: EpisodeConfig) -> int:
        """Objects that remain for queries once the shots are drawn; negative where even the shots are too many."""
        if config.shot_mode == "one_instance":
            return len(self.counts) - 1 if self.n_shot_objects else -1
        return len(self.counts) - config.shots

    def draw(self, rng: np.random.Generator, rows: int, config: EpisodeConfig) -> tuple[Indices, Indices]:
        """Shots (rows, shots) and queries (rows, queries) of `rows` episodes."""
        one_object = config.shot_mode == "one_instance"
        shot_objects = 1 if one_object else config.shots
        objects = _distinct(
            rng,
            rows,
            len(self.counts),
            shot_objects + config.queries,
            first=self.n_shot_objects if one_object else None,
        )
        if one_object:
            counts = self.counts[objects[:, 0]]
            shots = self.views[self.starts[objects[:, :1]] + _distinct(rng, rows, counts, config.shots)]
        else:
            shots = self._one_view_each(rng, objects[:, :shot_objects])
        return shots, self._one_view_each(rng, objects[:, shot_objects:])

    def _one_view_each(self, rng: np.random.Generator, objects: Indices) -> Indices:
        return self.views[self.starts[objects] + rng.integers(0, self.counts[objects])]


def _distinct(rng: np.random.Generator, rows: int, n: int | Indices, k: int, *, first: int | None = None) -> Indices:
    """`rows` draws (rows, k) without replacement of range(n), n one number or one a row; the first below `first`.

    The first k steps of Fisher and Yates's shuffle, in all rows at once.
    """
    draws = np.stack([rng.integers(j, n if j or first is None else first, size=rows) for j in range(k)], axis=1)
    width = int(np.max(n, initial=1))
    chosen = np.empty((rows, k), np.int64)
    step = max(1, _PERMUTATION_ENTRIES // width)
    for start in range(0, rows, step):
        part = draws[start : start + step]
        line = np.arange(len(part))
        order = np.tile(np.arange(width, dtype=np.int32), (len(part), 1))
        for j in range(k):
            order[line, j], order[line, part[:, j]] = order[line, part[:, j]], order[line, j]
        chosen[start : start + step] = order[:, :k]
    return chosen


def _check_numbers(config: EpisodeConfig) -> None:
    lowest = {"ways": 2, "shots": 1, "queries": 1, "episodes": 1}
    for name, low in lowest.items():
        if getattr(config, name) < low:
            raise UsageError(f"must be at least {low}, not {getattr(config, name)}", where=f"--{name}")


def _suited(pools: Mapping[str, _Pool], config: EpisodeConfig) -> tuple[EpisodeConfig, tuple[str, ...]]:
    """The protocol that these classes allow, and the classes that take part."""
    left = {name: pool.queries_left(config) for name, pool in pools.items()}
    wanted = 1 if config.fit else config.queries
    names = tuple(name for name, queries in left.items() if queries >= wanted)
    if config.fit and len(names) >= 2:
        queries = min(config.queries, *(left[name] for name in names))
        return replace(config, ways=min(config.ways, len(names)), queries=queries), names
    if len(names) < config.ways or len(names) < len(pools):
        remedy = "Lower --ways, --shots or --queries, or let --fit choose"
        if config.classes == "category":
            remedy += "; --classes instance needs only many views of a few objects"
        raise UsageError(_too_few(pools, names, config), remedy=remedy)
    return config, names


def _too_few(pools: Mapping[str, _Pool], names: tuple[str, ...], config: EpisodeConfig) -> str:
    """What was asked and what is there."""
    by_instance = config.classes == "instance"
    things, kinds = ("views", "objects") if by_instance else ("objects", "classes")
    shot_objects = 1 if config.shot_mode == "one_instance" else config.shots
    queries = 1 if config.fit else config.queries
    need = (
        f"at least {max(config.ways if not config.fit else 2, 2)} {kinds} of {shot_objects + queries} {things} or more"
    )
    if config.shot_mode == "one_instance":
        need += f", one of them with {config.shots} views or more"
    small = [f"{name} ({len(pools[name].counts)})" for name in pools if name not in names]
    there = f"{len(pools)} {kinds}, {len(names)} of them large enough"
    if small:
        there += f"; too small: {', '.join(small[:8])}{' ...' if len(small) > 8 else ''}"
    return f"{config.name} episodes with {config.queries} queries a class need {need}; there are {there}"
