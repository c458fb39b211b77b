"""Any encoder as an `Embedder`: dense features are matched cell by cell, pooled ones by a standard classifier."""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from dope.common.errors import BadInput, DopeError, UsageError
from dope.encoders.features import Features, raised, read_features
from dope.encoders.load import LoadedEncoder
from dope.lowshot.embedding import Embedder
from dope.lowshot.encoding import ViewCells

MaskChoice = Literal["none", "given"]

_BATCH_TOLERANCE = 1e-2
"""Share of the features' scale by which they may differ between batch sizes: half precision does, statistics of the
batch do far more."""


class EncoderEmbedder(Embedder):
    """An encoder's features for low-shot recognition.

    Dense features (B, D, h, w): a cell's descriptor is the unit vector of its features times its foreground
    probability, as DOPE's are (paper, section 4), for local matching. Pooled features: the encoder's own where it has
    some, else the mean over cells, weighted by the mask where there is one; raw, not normalised.

    The mask is the encoder's own where it returns one. With `mask="given"` it is the one that the views come with,
    shrunk to the grid by area: an oracle, since it was made by the dataset and not predicted by the encoder. With
    neither, every cell is foreground.

    Args:
        encoder: what `load_encoder` found.
        sample: images (B, 3, H, W) in [0, 1], at least one, of the size of the views. They are encoded at once and the
            first one alone, which tells what kind of features there are, and whether they depend on the batch.
        mask: "none" or "given".

    Raises:
        UsageError: `mask="given"` and features without a grid.
        BadInput: the encoder fails, or returns something else than features, or features that depend on the batch.
    """

    def __init__(self, encoder: LoadedEncoder, sample: Tensor, *, mask: MaskChoice = "none") -> None:
        self.encoder = encoder
        self.image_size: int | None = None  # an encoder resizes by itself where it has to
        self._sizes: tuple[tuple[int, ...], ...] | None = None
        together, alone = self._features(sample), self._features(sample[:1])
        _check_independence(together, alone, encoder.name)
        self.has_dense = together.dense is not None
        if mask == "given" and not self.has_dense:
            what = f"{encoder.name} has pooled features only, which no mask can be applied to"
            raise UsageError(what, where="--encoder-mask given", remedy="Leave it out")
        self.wants_masks = mask == "given"
        self.name = encoder.name + (" + given masks" if self.wants_masks else "")
        self.own_classifier = "local" if self.has_dense else "nearest"

    @torch.inference_mode()
    def pooled(self, images: Tensor, masks: Tensor | None = None) -> Tensor:
        """Images (B, 3, H, W) to raw vectors (B, D) float32; `masks` as for `cells`."""
        features, norms = self._features_and_masks(images, masks)
        if features.pooled is not None:
            return features.pooled
        assert features.dense is not None
        if norms is None:
            return features.dense.mean((2, 3))
        # a view without foreground is the mean of all of its cells
        weights = torch.where(norms.sum((1, 2), keepdim=True) > 0, norms, torch.ones_like(norms))
        return (features.dense * weights[:, None]).sum((2, 3)) / weights.sum((1, 2))[:, None]

    @torch.inference_mode()
    def cells(self, images: Tensor, masks: Tensor | None = None) -> list[ViewCells]:
        """Images (B, 3, H, W) in [0, 1] to descriptors on the grid.

        Args:
            images: the views.
            masks: their own masks (B, H, W) bool, where `wants_masks`.

        Raises:
            UsageError: the features are pooled.
        """
        features, norms = self._features_and_masks(images, masks)
        if features.dense is None:
            return super().cells(images)
        norms = torch.ones_like(features.dense[:, 0]) if norms is None else norms
        descriptors = F.normalize(features.dense, dim=1) * norms[:, None]
        return [ViewCells.of_grid(view) for view in descriptors.permute(0, 2, 3, 1)]

    def _features_and_masks(self, images: Tensor, masks: Tensor | None) -> tuple[Features, Tensor | None]:
        """Features, and foreground probabilities (B, h, w) of the cells where there are some."""
        features = self._features(images)
        if not self.wants_masks or features.dense is None:
            return features, features.mask
        assert masks is not None, "an embedder that wants masks is given some"
        given = masks.to(images.device).float()[:, None]
        return features, F.interpolate(given, features.dense.shape[-2:], mode="area")[:, 0]

    def _features(self, images: Tensor) -> Features:
        try:
            with torch.inference_mode():
                output = self.encoder.encode(images.clone())  # which it may change, as by images.sub_(mean)
        except DopeError:
            raise
        except Exception as error:  # whatever somebody else's code raises
            raise raised(error, images, self.encoder.name) from error
        features = read_features(output, len(images), self.encoder.name)
        parts = (features.dense, features.pooled, features.mask)
        sizes = tuple(() if part is None else tuple(part.shape[1:]) for part in parts)
        if self._sizes is None:
            self._sizes = sizes
        if sizes != self._sizes:
            what = f"returned features of sizes {_said(self._sizes)}, then of {_said(sizes)} for {len(images)} images"
            remedy = "The size of an image's features must not depend on the others of its batch"
            raise BadInput(what, where=f"--encoder {self.encoder.name}", remedy=remedy)
        return features


def _check_independence(together: Features, alone: Features, name: str) -> None:
    """The first image's features must be the same alone and among others."""
    for kind in ("dense", "pooled", "mask"):
        one, other = getattr(alone, kind), getattr(together, kind)
        if one is None:
            continue
        scale = float(torch.maximum(one.abs().max(), other.abs().max()))
        error = float((other[0] - one[0]).abs().max())
        if error > _BATCH_TOLERANCE * scale:
            what = f"{kind} features of an image differ with the others of its batch (by {error / scale:.0%})"
            remedy = "Set BatchNorm and dropout to eval mode, and take no statistics over the batch"
            raise BadInput(what, where=f"--encoder {name}", remedy=remedy)


def _said(sizes: tuple[tuple[int, ...], ...]) -> str:
    names = zip(("dense", "pooled", "mask"), sizes, strict=True)
    return ", ".join(f"{name} {'x'.join(map(str, size))}" for name, size in names if size)
