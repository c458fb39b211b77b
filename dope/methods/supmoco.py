"""SupMoCo (Majumder et al., Supervised Momentum Contrastive Learning, 2021): views of one class are positives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from dope.augmentation import WHOLE, Share, augment_images
from dope.common.seeds import derive_seed
from dope.config import TrainConfig
from dope.distributed import Ranks
from dope.methods.base import Facts, MeanLoss, Method
from dope.methods.class_keys import ClassKeys, KeyedOrder
from dope.methods.data import pair_order, view_dataset
from dope.methods.queue import NO_CLASS, KeyEncoder, UnitVectors, spread, unit
from dope.methods.supervised import base_classes
from dope.methods.vispe_moco import ContrastNetwork, new_key_encoder, shuffle_seed
from dope.queries import autocast
from dope.single_views import ImageBatch, ViewDataset
from dope.validation import evaluating

if TYPE_CHECKING:
    from dope.lowshot.embedding import Embedder
    from dope.storage import Shards


@dataclass(frozen=True)
class KeyedBatch:
    """Augmented views: b queries, and b * P keys, those of the first query first."""

    queries: ImageBatch
    keys: ImageBatch


class SupMoCo(Method):
    """Momentum contrast with labels."""

    name = "supmoco"
    sections = ("supmoco",)
    own_classifier = "logistic"
    pairs = False
    batch_of = "views"
    score = "accuracy"

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config)
        reason = "keys of all ranks are one batch"
        self.refuse("distributed.local_negatives", config.distributed.local_negatives, reason)

    def dataset(self, shards: Shards, split: str) -> ViewDataset:
        return view_dataset(self.config, shards, split)

    def order(self, dataset: ViewDataset) -> KeyedOrder:
        choice = ClassKeys(dataset.index.labels, dataset.index.objects)
        return KeyedOrder(pair_order(self.config, dataset), choice, self.config.supmoco.keys, self.config.seed)

    def facts(self, dataset: ViewDataset) -> Facts:
        return {"classes": base_classes(dataset)}

    def new_network(self, facts: Facts) -> ContrastNetwork:
        return ContrastNetwork(self.config.network.width, (None, self.config.supmoco.head))

    def new_companion(self, network: nn.Module) -> KeyEncoder:
        return new_key_encoder(self.config, network, self.config.supmoco.queue, self.config.supmoco.head)

    def online(self, network: nn.Module) -> UnitVectors:
        return UnitVectors(network, compiled=self.config.compile)

    def prepare(self, batch: ImageBatch, step: int, share: Share = WHOLE) -> KeyedBatch:
        b = len(batch) // (1 + self.config.supmoco.keys)
        parts = {"step": batch.at(slice(0, b)), "keys": batch.at(slice(b, None))}
        return KeyedBatch(*(self._augmented(part, name, step, share) for name, part in parts.items()))

    def _augmented(self, batch: ImageBatch, name: str, step: int, share: Share) -> ImageBatch:
        random = torch.Generator().manual_seed(derive_seed(self.config.seed, name, step))
        images, masks = augment_images(batch.images, batch.masks, self.config.augmentation, random, share)
        return replace(batch, images=images, masks=masks).laid_out(channels_last=self.config.channels_last)

    def losses(
        self, online: nn.Module, companion: KeyEncoder, batch: KeyedBatch, ranks: Ranks, *, step: int = 0,
        stop: bool = False,
    ) -> MeanLoss:  # fmt: skip
        labels, p = batch.queries.labels, self.config.supmoco.keys
        with autocast(self.config.precision, labels.device):
            keys = companion.keys_of_all(batch.keys.images, ranks, shuffle_seed(self.config, step))
            (queries,) = online(batch.queries.images)
        key_labels = ranks.gather(batch.keys.labels)
        companion.remember(*one_of_each(keys, key_labels, p, derive_seed(self.config.seed, "enqueue", step)))
        each, counted = supmoco_losses(
            queries,
            labels,
            ranks.share(keys).unflatten(0, (-1, p)),
            batch.keys.labels.view(-1, p),
            companion.queue.keys,
            companion.queue.labels,
            self.config.supmoco.temperature,
        )
        n = ranks.sum(counted.sum()).clamp(min=1)
        total = each.masked_fill(~counted, 0).sum() * ranks.world / n
        return MeanLoss.of(total, ranks, stop, spread=spread(keys))

    def after_step(self, network: nn.Module, companion: Any) -> None:
        companion.update(network)

    def validate(self, network: nn.Module, held_out: list[ImageBatch], ranks: Ranks) -> dict[str, Any]:
        assert isinstance(network, ContrastNetwork)
        device, found = next(network.parameters()).device, []
        with evaluating(network), torch.no_grad():
            for batch in held_out:
                vectors = unit(network.encoder(batch.images.to(device).float() / 255)).cpu()
                found.append((vectors, batch.labels, batch.objects))
        parts = [part for some in ranks.collect(found) for part in some]
        if not parts:
            return {"accuracy": float("nan"), "chance": float("nan"), "pairs": 0}
        return nearest_of_others(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))

    def embedder(self, network: nn.Module) -> Embedder:
        from dope.methods.pooled import PooledEmbedder

        assert isinstance(network, ContrastNetwork)
        return PooledEmbedder(network.encoder, self.name, self.own_classifier, self.config.data.image_size)


def supmoco_losses(
    queries: Tensor,
    labels: Tensor,
    keys: Tensor,
    key_labels: Tensor,
    queue: Tensor,
    queue_labels: Tensor,
    temperature: float,
) -> tuple[Tensor, Tensor]:
    """-log(exp(l+) / (exp(l+) + sum over the queue of exp(q.m_j / T))), where l+ is the mean of q.k / T over the keys
    of the query's class, its own P and those in the queue.

    Keys of the query's class in the queue are in the sum as well. A key without a class is nobody's positive; so is one
    of another class, which only stands in for a damaged view.

    Args:
        queries: unit vectors (b, D); labels (b,).
        keys: unit vectors (b, P, D) of each query; key_labels (b, P).
        queue: unit vectors (K, D); queue_labels (K,).
        temperature: divides the dot products.

    Returns:
        The loss (b,) of each query, and whether it counts (b,) bool: it has a positive.
    """
    own = torch.einsum("bd,bpd->bp", queries, keys.to(queries.dtype)) / temperature
    remembered = queries @ queue.T.to(queries.dtype) / temperature
    known = (labels != NO_CLASS)[:, None]
    good, same = (key_labels == labels[:, None]) & known, (queue_labels == labels[:, None]) & known
    count = good.sum(1) + same.sum(1)
    positive = (own.masked_fill(~good, 0).sum(1) + remembered.masked_fill(~same, 0).sum(1)) / count.clamp(min=1)
    each = torch.cat([positive[:, None], remembered], 1).logsumexp(1) - positive
    return each, count > 0


def one_of_each(keys: Tensor, labels: Tensor, p: int, seed: int) -> tuple[Tensor, Tensor]:
    """Of keys (B * P, D) with labels (B * P,), one at random of each query's P: (B, D) and (B,)."""
    n = len(keys) // p
    chosen = torch.randint(p, (n,), generator=torch.Generator().manual_seed(seed))
    rows = (torch.arange(n) * p + chosen).to(keys.device)
    return keys[rows], labels[rows]


def nearest_of_others(vectors: Tensor, labels: Tensor, objects: Tensor) -> dict[str, Any]:
    """Is the nearest view among those of all other objects of the same class?

    A view counts where another object of its class is there. A tie between classes is no hit.

    Args:
        vectors: unit vectors (N, D).
        labels, objects: (N,) their classes and objects.

    Returns:
        `accuracy`, the share of hits in [0, 1], `chance`, the share that random vectors have, and `pairs`, how many
        views count.
    """
    other = objects[:, None] != objects
    alike = other & (labels[:, None] == labels)
    counted = alike.any(1)
    n = int(counted.sum())
    if n == 0:
        return {"accuracy": float("nan"), "chance": float("nan"), "pairs": 0}
    similarity = vectors @ vectors.T
    right = similarity.masked_fill(~alike, -torch.inf).amax(1)
    wrong = similarity.masked_fill(~(other & ~alike), -torch.inf).amax(1)
    chance = alike.sum(1)[counted].double() / other.sum(1)[counted]
    return {"accuracy": float((right > wrong)[counted].double().mean()), "chance": float(chance.mean()), "pairs": n}
