"""Which classes are evaluated under which protocol: all that the shards have, or parts of a table's splits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from numpy.typing import NDArray

from dope.common.errors import UsageError
from dope.common.seeds import derive_seed
from dope.lowshot.episodes import EpisodeConfig, Episodes, Population, classes_of, sample_episodes
from dope.lowshot.splits import SplitTable, match_categories
from dope.lowshot.views import ViewShards

Part = Literal["test", "val"]


@dataclass(frozen=True)
class Task:
    """One protocol on some classes; a row of the results for every embedder.

    Attributes:
        asked: the protocol as it was asked for.
        population: class -> object -> views.
        drawn: its episodes.
        columns: `table`, `table_split` and `part` of its row.
        categories: the categories that it was restricted to, as the shards name them; none: all.
    """

    asked: EpisodeConfig
    population: Population
    drawn: Episodes
    columns: Mapping[str, Any]
    categories: tuple[str, ...] = ()

    @classmethod
    def draw(
        cls,
        views: ViewShards,
        chosen: NDArray[Any],
        protocol: EpisodeConfig,
        categories: Sequence[str] = (),
        **columns: Any,
    ) -> Task:
        """Draw the episodes of a protocol from the `chosen` views of some categories (none given: of all).

        Raises:
            UsageError: too few classes, objects or views.
        """
        population = views.population(chosen, by_category=protocol.classes == "category" or bool(categories))
        if categories:
            population = {name: population[name] for name in categories if name in population}
        return cls(protocol, population, sample_episodes(population, protocol), columns, tuple(categories))

    @property
    def counts(self) -> dict[str, int]:
        """Classes, objects and views that the episodes could draw from."""
        classes = classes_of(self.population, self.drawn.config)
        used = [classes[name] for name in self.drawn.names]
        by_category = self.drawn.config.classes == "category"
        return {
            "n_classes": len(used),
            "n_objects": sum(map(len, used)) if by_category else len(used),
            "n_views": sum(len(views) for objects in used for views in objects.values()),
        }


def split_tasks(
    views: ViewShards,
    chosen: NDArray[Any],
    protocols: Sequence[EpisodeConfig],
    table: SplitTable,
    *,
    part: Part,
    only: Sequence[int] = (),
    notes: list[str],
) -> list[Task]:
    """A task for every split of a table and every protocol.

    Args:
        only: which splits; none given: all.
        notes: told what `fit` left out.

    Raises:
        UsageError: no such split; a part without classes; the shards lack some of its classes (unless `fit`), or what
            they have does not suffice for a protocol.
    """
    for number in only:
        if not 0 <= number < len(table.splits):
            what = f"{table.name} has splits 0 to {len(table.splits) - 1}, not {number}"
            raise UsageError(what, where="--table-split")
    there = {name for i in chosen.tolist() if (name := views.columns["category"][i])}
    tasks = []
    for number in sorted(set(only)) or range(len(table.splits)):
        where, wanted = f"{table.name}, {part} classes of split {number}", table.splits[number].part(part)
        if not wanted:
            raise UsageError("there are none", where=where, remedy="Leave out --part val and --select")
        fit = any(protocol.fit for protocol in protocols)
        found, missing = match_categories(wanted, there, where=where, fit=fit)
        if missing:
            notes.append(f"{where}: left out {', '.join(missing)}, which the shards lack")
        for protocol in protocols:
            try:
                task = Task.draw(views, chosen, protocol, found, table=table.name, table_split=number, part=part)
            except UsageError as error:
                raise UsageError(error.what, where=where, remedy=error.remedy) from error
            tasks.append(task)
    return tasks


def validation_protocol(protocol: EpisodeConfig) -> EpisodeConfig:
    """What checkpoints are chosen by: 5-way 1-shot, with a seed of its own."""
    seed = derive_seed(protocol.seed, "validation episodes") % 2**31
    return replace(protocol, ways=5, shots=1, shot_mode="several_instances", seed=seed)
