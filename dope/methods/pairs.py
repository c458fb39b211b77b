"""What the methods that learn from pairs of whole views share: samples, augmentation, and a score on held-out pairs."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from dope.augmentation import WHOLE, Share, augment, duplicate_view, no_augmentation, uniform_rows
from dope.batch import PairBatch
from dope.common.seeds import derive_seed
from dope.config import TrainConfig
from dope.distributed import Ranks
from dope.methods.base import Method
from dope.methods.data import pair_dataset, pair_order
from dope.methods.queue import unit
from dope.validation import evaluating

if TYPE_CHECKING:
    from dope.lowshot.embedding import Embedder
    from dope.order import SampleOrder
    from dope.storage import Shards
    from dope.streaming import PairDataset


class PairMethod(Method):
    """A method that describes whole views and learns from pairs of them, without their correspondences."""

    score = "retrieval"

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config)
        reason = "keys and negatives of all ranks are one batch"
        self.refuse("distributed.local_negatives", config.distributed.local_negatives, reason)

    def dataset(self, shards: Shards, split: str) -> PairDataset:
        return pair_dataset(self.config, shards, split)

    def order(self, dataset: PairDataset) -> SampleOrder:
        return pair_order(self.config, dataset)

    def prepare(self, batch: PairBatch, step: int, share: Share = WHOLE) -> PairBatch:
        return augmented_pairs(batch, self.config, step, share)

    def plain_images(self, batches: Iterable[PairBatch]) -> Iterator[Tensor]:
        for batch in batches:  # both views: BatchNorm of vectors needs two images at least
            yield torch.cat([batch.images1, batch.images2]).float() / 255

    def features(self, network: nn.Module, images: Tensor) -> Tensor:
        """What evaluation sees of images (B, 3, H, W): vectors (B, D)."""
        features: Tensor = self.pooled_network(network)(images)
        return features

    @abstractmethod
    def pooled_network(self, network: nn.Module) -> nn.Module:
        """The part of the network that is used after training."""

    def validate(self, network: nn.Module, held_out: list[PairBatch], ranks: Ranks) -> dict[str, Any]:
        device, found = next(network.parameters()).device, []
        with evaluating(network), torch.no_grad():
            for loaded in held_out:
                batch = no_augmentation(loaded.to(device))
                first, second = (unit(self.features(network, images)) for images in (batch.images1, batch.images2))
                found.append((first.cpu(), second.cpu(), loaded.objects))
        parts = [part for some in ranks.collect(found) for part in some]
        if not parts:
            return {"retrieval": float("nan"), "chance": float("nan"), "pairs": 0}
        return retrieval(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))

    def embedder(self, network: nn.Module) -> Embedder:
        from dope.methods.pooled import PooledEmbedder

        return PooledEmbedder(self.pooled_network(network), self.name, self.own_classifier, self.config.data.image_size)


def augmented_pairs(batch: PairBatch, config: TrainConfig, step: int, share: Share = WHOLE) -> PairBatch:
    """Draw which view is first, and augment both: a function of (seed, step) and of a pair's place in the batch."""
    generator = torch.Generator().manual_seed(derive_seed(config.seed, "step", step))
    swap = uniform_rows(len(batch), 1, generator, batch.points.device, share)[:, 0]
    batch = batch.swapped(swap < 0.5)
    if config.pairs == "one_view_twice":
        batch = duplicate_view(batch)
    return augment(batch, config.augmentation, generator, share).laid_out(channels_last=config.channels_last)


def retrieval(first: Tensor, second: Tensor, objects: Tensor) -> dict[str, Any]:
    """Does view 1 find its own view 2 among the view 2s of all other objects?

    Other pairs' views of its own object are no candidates: they would be right as well. A pair counts where there is
    any other object; a tie is no hit, or a network that maps everything to one vector would do well.

    Args:
        first, second: unit vectors (N, D) of both views of N pairs.
        objects: (N,) their objects.

    Returns:
        `retrieval`, the share of hits in [0, 1], `chance`, the share that random vectors have, and `pairs` that count.
    """
    own = (first * second).sum(1)
    others = (objects[:, None] != objects) if len(objects) else torch.zeros(0, 0, dtype=torch.bool)
    best = (first @ second.T).masked_fill(~others, -torch.inf).amax(1) if len(objects) else own
    count = others.sum(1)
    counted = count > 0
    n = int(counted.sum())
    if n == 0:
        return {"retrieval": float("nan"), "chance": float("nan"), "pairs": 0}
    return {
        "retrieval": float((own > best)[counted].double().mean()),
        "chance": float((1 / (1 + count[counted].double())).mean()),
        "pairs": n,
    }
