"""What a method is: how a network is made, fed, trained and used, all of it behind one trainer.

The trainer knows shards, ranks, checkpoints and signals; a method knows its batches, its loss and its features.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import torch
from torch import Tensor, nn

from dope.augmentation import WHOLE, Share
from dope.common import settings
from dope.common.errors import UsageError
from dope.config_rules import flat
from dope.distributed import Ranks
from dope.order import Place

if TYPE_CHECKING:
    from dope.config import TrainConfig
    from dope.lowshot.embedding import Embedder
    from dope.storage import Shards

OF_SOME_METHODS = ("loss", "simpleshot", "feat", "supmoco", "vispe", "moco", "simsiam")
"""Sections of the settings that only some methods read (`Method.sections`)."""
OF_DOPE = ("network.predict_mask",)
"""Settings in sections that all methods read, and that only DOPE reads."""

Facts = dict[str, Any]
"""What a network's shape takes from its data (e.g. the base classes); kept in checkpoints."""


class Losses(Protocol):
    """What a step computes: numbers to report (`loss` among them), whether any rank was asked to stop, a way back."""

    @property
    def report(self) -> dict[str, float]: ...

    @property
    def stop(self) -> bool: ...

    def backward(self) -> None:
        """Add the gradients of the global loss to the weights', the same on every rank."""


@dataclass(frozen=True)
class MeanLoss:
    """The losses of a step as scalars, each a mean over this rank's equal share of the batch.

    Attributes:
        total: scalar with gradient; DistributedDataParallel averages its gradients over ranks.
        report: means over all ranks.
    """

    total: Tensor
    report: dict[str, float]
    stop: bool

    @classmethod
    def of(cls, total: Tensor, ranks: Ranks, stop: bool, **parts: Tensor) -> MeanLoss:
        """Of a total and of whatever else is to be reported (scalars), with one message between ranks."""
        named = {"loss": total, **parts}
        values = [*(value.detach().double() for value in named.values()), total.new_tensor(float(stop)).double()]
        *means, stops = ranks.sum(torch.stack(values)).tolist()
        return cls(total, {name: mean / ranks.world for name, mean in zip(named, means, strict=True)}, stops > 0)

    def backward(self) -> None:
        self.total.backward()


class Order(Protocol):
    """Which samples make up which step (see `dope.order.SampleOrder`)."""

    steps_per_epoch: int
    n_objects: int
    batch_size: int

    def batches(self, start: Place, epochs: int, *, rank: int = 0, world: int = 1) -> Iterator[list[int]]:
        """The dataset's rows of a rank's share of each step, from `start` to the end of `epochs`."""

    def after(self, place: Place) -> Place:
        """The place one step later."""


class Method(ABC):
    """One way to train a network, for the settings of one run."""

    name: ClassVar[str]
    own_classifier: ClassVar[str]
    """What `dope eval --classifier auto` means: local, centroid, nearest, logistic, cl2n or attention."""
    has_dense: ClassVar[bool] = False
    """Whether its network describes every cell of an image."""
    pairs: ClassVar[bool] = True
    """Whether it learns from view pairs; else from single views and their classes."""
    batch_of: ClassVar[str] = "pairs"
    """What data.batch_size counts: pairs, views or episodes."""
    sections: ClassVar[tuple[str, ...]] = ()
    """Sections of the settings that it reads and not all methods do."""
    score: ClassVar[str]
    """What `validate` measures and the best checkpoint is chosen by: pck, retrieval or accuracy, in [0, 1]."""

    def __init__(self, config: TrainConfig) -> None:
        self.config = config

    # -- data

    @abstractmethod
    def dataset(self, shards: Shards, split: str) -> Any:
        """The samples of a split: `batch(rows)`, `error(sample)`, `index` and a length, as `PairDataset` has them."""

    @abstractmethod
    def order(self, dataset: Any) -> Order:
        """Which of them make up which step."""

    def held_out_rows(self, dataset: Any, most: int) -> list[int]:
        """Which of the held-out samples are validated on: the first ones of pairs, which hold each object once before
        any twice; of views, as many spread over all."""
        n = len(dataset)
        if self.pairs or n <= most:
            return list(range(min(most, n)))
        return [i * n // most for i in range(most)]

    def facts(self, dataset: Any) -> Facts:
        """What the network's shape takes from the training samples."""
        return {}

    # -- network

    @abstractmethod
    def new_network(self, facts: Facts) -> nn.Module:
        """Random weights by torch's global generator, which the caller has seeded."""

    def start(self, network: nn.Module, facts: Facts) -> Facts:
        """Take over weights that the settings name, before the first step of a run; its companion is made before.

        Returns:
            `facts`, with what these weights have learnt from.
        """
        return facts

    def new_companion(self, network: nn.Module) -> nn.Module:
        """What goes with the network without gradient: a momentum encoder, a queue; its state is in checkpoints."""
        return nn.Module()

    def companion_state(self, companion: nn.Module) -> dict[str, Tensor]:
        """What a checkpoint holds of it."""
        return companion.state_dict()

    def load_companion(self, companion: nn.Module, state: dict[str, Tensor]) -> None:
        """The way back."""
        companion.load_state_dict(state)

    def online(self, network: nn.Module) -> nn.Module:
        """What is called in a step and what DistributedDataParallel wraps."""
        return network

    def parameter_groups(self, network: nn.Module) -> list[dict[str, Any]]:
        """For the optimiser; a group's `lr_scale` multiplies the learning rate, `lr_constant` keeps it from falling."""
        return [{"params": list(network.parameters())}]

    # -- step

    @abstractmethod
    def prepare(self, batch: Any, step: int, share: Share = WHOLE) -> Any:
        """Draw and augment on the batch's device; a function of (seed, step) and of the place in the global batch."""

    @abstractmethod
    def losses(
        self, online: nn.Module, companion: Any, batch: Any, ranks: Ranks, *, step: int = 0, stop: bool = False
    ) -> Losses:
        """The losses of what `prepare` made."""

    def after_step(self, network: nn.Module, companion: Any) -> None:  # noqa: B027 - most methods have nothing to do
        """What follows the optimiser's step."""

    # -- use

    def plain_images(self, batches: Iterable[Any]) -> Iterator[Tensor]:
        """Float images (B, 3, H, W) of held-out batches, for the BatchNorm statistics of random weights."""
        for batch in batches:
            images = batch.images1 if hasattr(batch, "images1") else batch.images
            # one small image alone may have a single value a channel, of which there are no statistics
            yield (images if len(images) > 1 else torch.cat([images, images])).float() / 255

    @abstractmethod
    def validate(self, network: nn.Module, held_out: list[Any], ranks: Ranks) -> dict[str, Any]:
        """`score` on held-out samples, and `pairs`, how many they are; the network's mode is restored."""

    def before_save(  # noqa: B027 - most methods have nothing to do
        self, network: nn.Module, dataset: Any, *, hurry: bool = False
    ) -> None:
        """What a checkpoint must hold that training itself does not need.

        Args:
            hurry: a signal or an error has stopped the run, which may be killed soon: leave out what takes long, and
                mark it.
        """

    @abstractmethod
    def embedder(self, network: nn.Module) -> Embedder:
        """The network as evaluation sees it."""

    def refuse_unread(self) -> None:
        """Raise `UsageError` for a changed setting of other methods, which would change nothing, not even the loss."""
        from dope.config import TrainConfig

        values, plain = (flat(settings.to_dict(config)) for config in (self.config, TrainConfig()))
        own = [f"{section}." for section in self.sections]
        for key, value in values.items():
            section, _, name = key.rpartition(".")
            others = section in OF_SOME_METHODS and section not in self.sections
            if value != plain[key] and (others or (key in OF_DOPE and self.name != "dope")):
                instead = next((own_key for prefix in own if (own_key := prefix + name) in values), None)
                raise UsageError(
                    f"is not read by {self.name}",
                    where=key,
                    remedy=f"Did you mean {instead}?" if instead else f"Leave out {key}, or train another --method",
                )

    def refuse(self, setting: str, wrong: bool, reason: str) -> None:
        """Raise `UsageError` for a setting that this method cannot use."""
        if wrong:
            what = f"cannot be used by {self.name}: {reason}"
            raise UsageError(what, where=setting, remedy=f"Leave out {setting}, or train --method dope")
