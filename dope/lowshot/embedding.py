"""What evaluation needs of whatever makes features: a trained network, one of random weights, or any other encoder."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from dope.common.errors import UsageError

if TYPE_CHECKING:
    import numpy as np

    from dope.lowshot.encoding import ViewCells
    from dope.lowshot.episodes import Episodes, Indices
    from dope.networks import DopeNetwork


class Embedder(ABC):
    """Images to features.

    Attributes:
        name: the method ("dope", "simpleshot", ...) or the encoder's label; a column of the result rows.
        own_classifier: what `--classifier auto` means: local, centroid, nearest, logistic, cl2n or attention.
        has_dense: whether `cells` can be asked for, so that "local" may be chosen.
        image_size: side in pixels that views are resized to; None: as they are.
        wants_masks: whether `pooled` and `cells` take the views' own masks (B, H, W) bool as a second argument.
    """

    name: str
    own_classifier: str
    has_dense: bool = False
    image_size: int | None = None
    wants_masks: bool = False

    @abstractmethod
    def pooled(self, images: Tensor) -> Tensor:
        """One vector an image: float images (B, 3, H, W) in [0, 1] to (B, D) float32, raw: not of unit length unless
        the method says so. Without gradient; a row depends on its own image alone."""

    def cells(self, images: Tensor) -> list[ViewCells]:
        """The descriptors of every cell of float images (B, 3, H, W) in [0, 1], a `ViewCells` an image.

        Raises:
            UsageError: this embedder describes whole images only.
        """
        raise UsageError(
            f"{self.name} has no dense features, and local matching compares cells",
            where="--classifier local",
            remedy=f"Use --classifier auto (here: {self.own_classifier}), centroid, nearest or logistic",
        )

    def classify(self, vectors: NDArray[np.float32], episodes: Episodes) -> Indices:
        """The predicted way (E, ways, queries) of every query, where `own_classifier` is none of the standard ones.

        Args:
            vectors: (V, D), what `pooled` gave for every view; rows of views that no episode needs are zero.
            episodes: indices into them.
        """
        raise NotImplementedError(f"{self.name} has no classifier of its own")


class DopeEmbedder(Embedder):
    """Dense descriptors of a `DopeNetwork` in eval mode; pooled: their mean, weighted by the soft mask."""

    name = "dope"
    own_classifier = "local"
    has_dense = True

    def __init__(self, network: DopeNetwork, image_size: int | None) -> None:
        self.network, self.image_size = network, image_size

    @torch.inference_mode()
    def pooled(self, images: Tensor) -> Tensor:
        return pool(self.network.descriptors(images))

    def cells(self, images: Tensor) -> list[ViewCells]:
        from dope.lowshot.encoding import encode

        return encode(self.network, images)


def pool(descriptors: Tensor) -> Tensor:
    """The direction (B, D) of the mask-weighted mean of unit descriptors; `descriptors` (B, D, h, w) carry the mask."""
    return functional.normalize(descriptors.mean((2, 3)), dim=1)
