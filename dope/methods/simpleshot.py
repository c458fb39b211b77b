"""SimpleShot (Wang et al., 2019): a classifier of the base classes, then the nearest mean of transformed shots."""

from __future__ import annotations

import hashlib
import logging
import sys
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dope.common.errors import UsageError
from dope.common.progress import Progress, progress_lines
from dope.methods.base import Facts
from dope.methods.pooled import PooledEmbedder
from dope.methods.supervised import ClassifierNetwork, Supervised
from dope.streaming import PairLoader
from dope.validation import evaluating

if TYPE_CHECKING:
    from dope.lowshot.episodes import Episodes, Indices
    from dope.single_views import ViewDataset

logger = logging.getLogger(__name__)


class SimpleShotNetwork(ClassifierNetwork):
    """The classifier, and `mean` (dim,): the mean feature of all base training images, in checkpoints that of their own
    weights. Zero before the first one; NaN where the run was stopped at it, as it takes all images to make."""

    mean: Tensor

    def __init__(self, width: float, classes: int) -> None:
        super().__init__(width, classes)
        self.register_buffer("mean", torch.zeros(self.encoder.dim))


class SimpleShot(Supervised):
    """Cross entropy on the base classes; nearest class means of centred, unit features."""

    name = "simpleshot"
    sections = ("simpleshot",)
    own_classifier = "cl2n"

    _mean_is_of: str = ""
    """Which weights `SimpleShotNetwork.mean` is of."""

    def new_network(self, facts: Facts) -> SimpleShotNetwork:
        return SimpleShotNetwork(self.config.network.width, len(facts["classes"]))

    def before_save(self, network: nn.Module, dataset: ViewDataset, *, hurry: bool = False) -> None:
        assert isinstance(network, SimpleShotNetwork)
        now = digest(network.encoder)
        if now == self._mean_is_of:
            return
        if hurry:
            network.mean.fill_(torch.nan)
            self._mean_is_of = ""
            return
        data = self.config.data
        network.mean.copy_(
            mean_feature(
                network.encoder,
                dataset,
                batch_size=self.config.validation.batch_size,
                workers=data.workers,
                tell=progress_lines(lambda line: print(line, file=sys.stderr)),
            )
        )
        self._mean_is_of = now

    def embedder(self, network: nn.Module) -> SimpleShotEmbedder:
        assert isinstance(network, SimpleShotNetwork)
        return SimpleShotEmbedder(network, self.config.simpleshot.transform, self.config.data.image_size)


class SimpleShotEmbedder(PooledEmbedder):
    """Pooled features, and the nearest mean of transformed shots.

    Args:
        network: in eval mode.
        transform: cl2n, l2n or un, as `simpleshot.transform`.
        image_size: side in pixels that views are resized to.
    """

    def __init__(self, network: SimpleShotNetwork, transform: str, image_size: int | None) -> None:
        super().__init__(network.encoder, SimpleShot.name, SimpleShot.own_classifier, image_size)
        self.mean, self.transform = network.mean, transform

    def classify(self, vectors: NDArray[np.float32], episodes: Episodes) -> Indices:
        """Raises `UsageError` where the checkpoint has no mean and the transform needs it."""
        mean = self.mean.cpu().numpy()
        if self.transform == "cl2n" and not np.isfinite(mean).all():
            raise UsageError(
                "this checkpoint has no mean feature of the base images: the run was stopped before it was made",
                where="--classifier cl2n",
                remedy="Go on with the run (`dope train`, the same command), or use --classifier centroid",
            )
        return nearest_mean(vectors, episodes, self.transform, mean)


def nearest_mean(
    vectors: NDArray[np.floating], episodes: Episodes, transform: str, mean: NDArray[np.floating]
) -> Indices:
    """The way (E, ways, queries) whose mean of transformed shots is nearest to the transformed query; of equally near
    ones, the first.

    The means are not scaled to unit length again (DOPE, supplement; Wang et al., section 3).

    Args:
        vectors: (V, D) raw features of all views.
        episodes: indices into them.
        transform: cl2n: (x - mean) / |x - mean|; l2n: x / |x|; un: x.
        mean: (D,) of the base images.
    """
    points = vectors.astype(np.float64)
    if transform == "cl2n":
        points -= mean
    if transform != "un":
        points /= np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
    predicted = np.empty(episodes.query.shape, np.int64)
    for e, (support, query) in enumerate(zip(episodes.support, episodes.query, strict=True)):
        means = points[support].mean(1)  # (ways, D)
        apart = points[query][:, :, None] - means  # (ways, queries, ways, D)
        predicted[e] = np.einsum("wqcd,wqcd->wqc", apart, apart).argmin(-1)
    return predicted


@torch.no_grad()
def mean_feature(
    encoder: nn.Module, dataset: ViewDataset, *, batch_size: int, workers: int = 0, tell: Progress | None = None
) -> Tensor:
    """The mean (D,) of the features of all views as they are, in eval mode; damaged ones are left out, with a warning.

    Args:
        encoder: images (B, 3, H, W) to (B, D); its mode is restored.
        dataset: the base classes' training views.
        batch_size: views encoded at a time.
        workers: processes that decode.
        tell: told how many views are done.
    """
    device, n = next(encoder.parameters()).device, len(dataset)
    total, counted, done = torch.zeros((), dtype=torch.float64, device=device), 0, 0
    rows = (list(range(start, min(start + batch_size, n))) for start in range(0, n, batch_size))
    loader = PairLoader(dataset, rows, workers=workers, pin_memory=device.type == "cuda", fill_damaged=True)
    with evaluating(encoder):
        for loaded in loader:
            batch = loaded.without_damaged()
            done += len(loaded)
            if len(batch):
                total = total + encoder(batch.images.to(device).float() / 255).double().sum(0)
                counted += len(batch)
            if tell is not None:
                tell("mean feature", done, n)
    if counted < n:
        logger.warning("the mean feature leaves out %d damaged views of %d", n - counted, n)
    return total / max(1, counted)


def digest(module: nn.Module) -> str:
    """SHA-256 of a module's weights and buffers."""
    found = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        found.update(name.encode())
        found.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()
