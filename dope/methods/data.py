"""Samples and their order, as the settings say, for methods that share a kind of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dope.order import SampleOrder
from dope.streaming import PairDataset

if TYPE_CHECKING:
    from dope.config import TrainConfig
    from dope.single_views import ViewDataset
    from dope.storage import Shards


def pair_dataset(
    config: TrainConfig, shards: Shards, split: str, *, max_points: int = 1, min_correspondences: bool = False
) -> PairDataset:
    """The view pairs of a split.

    Args:
        max_points: correspondences that are read of each.
        min_correspondences: leave out pairs with fewer than the settings ask for.
    """
    data = config.data
    return PairDataset(
        shards,
        split,
        image_size=data.image_size,
        max_points=max_points,
        min_correspondences=data.min_correspondences if min_correspondences else 0,
        categories=data.categories,
    )


def view_dataset(config: TrainConfig, shards: Shards, split: str) -> ViewDataset:
    """The single views of a split, with their classes."""
    from dope.single_views import ViewDataset

    return ViewDataset(shards, split, image_size=config.data.image_size, categories=config.data.categories)


def pair_order(config: TrainConfig, dataset: PairDataset | ViewDataset) -> SampleOrder:
    """Each object once a round, with a pair (or a view) of its own."""
    data = config.data
    return SampleOrder(
        dataset.index.objects,
        data.batch_size,
        pairs_per_object=data.pairs_per_object,
        seed=config.seed,
        order=data.order,
        block=data.block,
    )
