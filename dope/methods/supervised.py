"""Cross entropy over the base classes: the training that SimpleShot and RFS have in common."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dope.augmentation import WHOLE, Share, augment_images
from dope.common.errors import BadInput
from dope.common.seeds import derive_seed
from dope.config import TrainConfig
from dope.distributed import Ranks
from dope.methods.base import Facts, MeanLoss, Method
from dope.methods.data import pair_order, view_dataset
from dope.methods.pooled import PooledNetwork
from dope.networks import compiling
from dope.queries import autocast
from dope.single_views import ImageBatch, ViewDataset
from dope.validation import evaluating

if TYPE_CHECKING:
    from dope.order import SampleOrder
    from dope.storage import Shards

IGNORED = -1
"""Label of a place in a batch that is not learnt from."""


class ClassifierNetwork(nn.Module):
    """A pooled ResNet-18 and a linear classifier of the base classes.

    Args:
        width: of the ResNet-18.
        classes: how many.
    """

    def __init__(self, width: float, classes: int) -> None:
        super().__init__()
        self.encoder = PooledNetwork(width)
        self.classifier = nn.Linear(self.encoder.dim, classes)

    def forward(self, images: Tensor) -> Tensor:
        """Logits (B, classes) of float images (B, 3, H, W) in [0, 1]."""
        logits: Tensor = self.classifier(self.encoder(images))
        return logits


class OnlineClassifier(nn.Module):
    """What is called in a step; names in the network's state dict stay where it is compiled."""

    def __init__(self, network: ClassifierNetwork, *, compiled: bool) -> None:
        super().__init__()
        self.network = network
        self._forward = compiling.compiled(network.forward) if compiled else network.forward

    def forward(self, images: Tensor) -> Tensor:
        return self._forward(images)


class Supervised(Method):
    """Learns the base classes from single views, augmented as DOPE's (method of section 4's supervised baselines)."""

    pairs = False
    batch_of = "views"
    score = "accuracy"

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config)
        refuse_pair_settings(self)

    def dataset(self, shards: Shards, split: str) -> ViewDataset:
        return view_dataset(self.config, shards, split)

    def order(self, dataset: ViewDataset) -> SampleOrder:
        return pair_order(self.config, dataset)

    def facts(self, dataset: ViewDataset) -> Facts:
        return {"classes": base_classes(dataset)}

    def new_network(self, facts: Facts) -> ClassifierNetwork:
        return ClassifierNetwork(self.config.network.width, len(facts["classes"]))

    def online(self, network: nn.Module) -> OnlineClassifier:
        assert isinstance(network, ClassifierNetwork)
        return OnlineClassifier(network, compiled=self.config.compile)

    def prepare(self, batch: ImageBatch, step: int, share: Share = WHOLE) -> ImageBatch:
        return augmented(batch, self.config, step, share)

    def losses(
        self, online: nn.Module, companion: Any, batch: ImageBatch, ranks: Ranks, *, step: int = 0, stop: bool = False
    ) -> MeanLoss:
        with autocast(self.config.precision, batch.images.device):
            logits = online(batch.images)
        total, hits, n = cross_entropy(logits.float(), batch.labels)
        share = ranks.world / ranks.sum(n).clamp(min=1)  # ranks may have learnt from different numbers of views
        return MeanLoss.of(total * share, ranks, stop, accuracy=hits * share)

    def validate(self, network: nn.Module, held_out: list[ImageBatch], ranks: Ranks) -> dict[str, Any]:
        device = next(network.parameters()).device
        counts = torch.zeros(2, dtype=torch.float64, device=device)
        with evaluating(network), torch.no_grad():
            for batch in held_out:
                logits = network(batch.images.to(device).float() / 255)
                _, hits, n = cross_entropy(logits, batch.labels.to(device))
                counts += torch.stack([hits, n]).to(counts)
        hits, n = ranks.sum(counts).tolist()
        return {"accuracy": hits / n if n else float("nan"), "pairs": int(n)}


def cross_entropy(logits: Tensor, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The sum of the cross entropies (a scalar with gradient), how many of the greatest logits are right, and how many
    views count.

    Args:
        logits: (B, classes) float.
        labels: (B,) long; `IGNORED` ones do not count.
    """
    counted = labels != IGNORED
    total = F.cross_entropy(logits, labels, ignore_index=IGNORED, reduction="sum")
    return total, ((logits.argmax(1) == labels) & counted).sum(), counted.sum()


def augmented(batch: ImageBatch, config: TrainConfig, step: int, share: Share = WHOLE) -> ImageBatch:
    """Augment single views: a function of (seed, step) and of a view's place in the global batch.

    A view that only fills the place of a damaged one is `IGNORED`: its own place is in the batch already.
    """
    random = torch.Generator().manual_seed(derive_seed(config.seed, "step", step))
    images, masks = augment_images(batch.images, batch.masks, config.augmentation, random, share)
    labels = batch.labels
    if batch.damaged:
        labels = labels.clone()
        labels[list(batch.damaged)] = IGNORED
    changed = replace(batch, images=images, masks=masks, labels=labels)
    return changed.laid_out(channels_last=config.channels_last)


def base_classes(dataset: ViewDataset) -> list[str]:
    """The classes in the order of the labels.

    Raises:
        BadInput: there is only one, so nothing could be told apart.
    """
    if len(dataset.classes) < 2:
        what = f"has views of one class only ('{dataset.classes[0]}')"
        remedy = "Give shards of several classes, or more of them by --set data.categories=[...]"
        raise BadInput(what, where=dataset.index.storage.where("views.parquet"), remedy=remedy)
    return list(dataset.classes)


def refuse_pair_settings(method: Method) -> None:
    """Raise `UsageError` for ablations of DOPE that mean nothing where single views and classes are learnt from."""
    config = method.config
    method.refuse("pairs", config.pairs != "two_views", "it learns from single views")
    method.refuse("distributed.local_negatives", config.distributed.local_negatives, "it has no negatives")
