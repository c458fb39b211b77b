"""Training by episodes: which views make up which one, as in evaluation, a function of (seed, epoch) alone."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import UsageError
from dope.common.seeds import derive_seed
from dope.lowshot.episodes import EpisodeConfig, sample_episodes
from dope.methods.configs import FeatConfig
from dope.order import EpochOrder

if TYPE_CHECKING:
    from dope.view_index import ViewIndex

logger = logging.getLogger(__name__)


class EpisodeOrder(EpochOrder):
    """Cuts epochs into steps of whole episodes.

    An episode draws classes, then objects without overlap between shots and queries, then one random view of each.
    Classes with too few objects for that are left out.

    Args:
        index: the views.
        batch_size: episodes in a step over all ranks.
        config: ways, shots, queries and how many episodes an epoch has.
        seed: the run's seed.

    Attributes:
        n_objects: those of the classes that can be drawn.
        left_out: names of the classes that cannot.

    Raises:
        UsageError: too few classes are large enough, or an epoch has fewer episodes than a step.
    """

    unit: ClassVar[str] = "episodes"

    def __init__(self, index: ViewIndex, batch_size: int, config: FeatConfig, seed: int) -> None:
        self.batch_size, self.config, self.seed = batch_size, config, seed
        every = population(index.labels, index.objects, index.classes)
        need = config.shots + config.queries
        self._population = {name: objects for name, objects in every.items() if len(objects) >= need}
        self.left_out = tuple(name for name in every if name not in self._population)
        self.n_objects = sum(map(len, self._population.values()))
        if len(self._population) < config.ways:
            raise _too_few({name: len(objects) for name, objects in every.items()}, config)
        if self.left_out:
            names = ", ".join(self.left_out)
            logger.warning("classes with fewer than %d objects take no part in episodes: %s", need, names)
        self.steps_per_epoch = config.episodes // batch_size
        if self.steps_per_epoch == 0:
            raise UsageError(
                f"{config.episodes} episodes an epoch are less than one step of {batch_size}",
                where="data.batch_size",
                remedy=f"Use --set data.batch_size={config.episodes} or less, or more of feat.episodes",
            )

    def epoch(self, epoch: int) -> NDArray[np.int64]:
        """(steps_per_epoch, batch_size, ways, shots + queries) sample rows; of each class the shots first."""
        config, whole = self.config, self.steps_per_epoch * self.batch_size
        protocol = EpisodeConfig(
            ways=config.ways,
            shots=config.shots,
            queries=config.queries,
            episodes=config.episodes,
            seed=derive_seed(self.seed, "training episodes", epoch),
        )
        drawn = sample_episodes(self._population, protocol)
        rows = np.concatenate([drawn.support, drawn.query], axis=2)[:whole]
        return rows.reshape(self.steps_per_epoch, self.batch_size, *rows.shape[1:])


def population(
    labels: NDArray[np.integer], objects: NDArray[np.integer], classes: tuple[str, ...]
) -> dict[str, dict[str, list[int]]]:
    """class -> object -> its rows, of the classes that have any, for `dope.lowshot.episodes.sample_episodes`.

    Args:
        labels: (N,) places in `classes`.
        objects: (N,) numbers of the views' objects.
        classes: the names.
    """
    found: dict[str, dict[str, list[int]]] = {}
    for row in np.lexsort((objects, labels)).tolist():  # a stable order, whatever that of the rows
        found.setdefault(classes[labels[row]], {}).setdefault(str(objects[row]), []).append(row)
    return found


def _too_few(counts: dict[str, int], config: FeatConfig) -> UsageError:
    """What was asked, what is there, and what could be asked instead."""
    need, ways = config.shots + config.queries, config.ways
    enough = sum(count >= need for count in counts.values())
    least = sorted(counts.values(), reverse=True)[ways - 1] if len(counts) >= ways else 0
    remedy = "Give shards with more classes"
    if least > config.shots:
        remedy = f"Use --set feat.queries={least - config.shots} or less"
    elif enough >= 2:
        remedy = f"Use --set feat.ways={enough} or less"
    return UsageError(
        f"episodes of {ways} classes with {need} objects each are asked for (shots and queries), and {enough} of "
        f"{len(counts)} classes have as many",
        where="feat.ways",
        remedy=remedy,
    )
