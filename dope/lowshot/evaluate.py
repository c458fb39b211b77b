"""The protocol: draw all episodes, encode each needed view once, classify, and give accuracy with its interval.

Paper section 4: mean accuracy over 2,500 episodes, 95% confidence interval = 1.96 * std / sqrt(episodes).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from dope.common import settings
from dope.common.errors import UsageError
from dope.common.progress import Progress
from dope.lowshot.classifiers import Work, classify_by_centroid, classify_locally
from dope.lowshot.encoding import to_tensor
from dope.lowshot.episodes import EpisodeConfig, Episodes, Population, classes_of, sample_episodes
from dope.lowshot.matching import MatchingConfig
from dope.lowshot.results import ResultRow
from dope.lowshot.views import ViewShards
from dope.networks import DopeNetwork, NetworkConfig
from dope.networks.untrained import settle_batchnorm, untrained_network
from dope.storage import Shards

SETTLING_VIEWS = 64
"""Views from which a network of random weights gets its BatchNorm statistics."""


@dataclass(frozen=True)
class EvaluationConfig:
    """What is measured, and how."""

    protocols: tuple[EpisodeConfig, ...] = (EpisodeConfig(),)
    """Evaluated together: views and pairs of views that they share are computed once."""
    classifier: Literal["local", "centroid"] = "local"
    """1-NN by local matching (the paper), or nearest class mean of pooled descriptors by cosine."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    """How two views are compared."""
    split: Literal["all", "train", "val"] = "all"
    """Views of which objects: all, those trained on, or those held out."""
    categories: tuple[str, ...] = ()
    """Only these categories; none given: all."""
    compare_untrained: bool = False
    """Run the same episodes with the same network with random weights as well."""
    image_size: int | None = None
    """Side in pixels that views are resized to; None: that of the training run (random weights: as they are)."""
    batch: int = 16
    """Views encoded at a time."""
    memory_gb: float = 4.0
    """Descriptors kept on the device; support views beyond it are encoded a second time."""


@dataclass(frozen=True)
class EvaluationResult:
    """Rows of all protocols of the network, then of the untrained one; what it took is not part of a row.

    Attributes:
        rows: one a protocol and network.
        accuracies: for each row, the accuracies (E,) of its episodes.
        encode_ms_per_view: wall time, mean over networks.
        match_ms_per_episode: wall time, mean over protocols and networks.
    """

    rows: tuple[ResultRow, ...]
    accuracies: tuple[NDArray[np.float64], ...]
    encode_ms_per_view: float
    match_ms_per_episode: float


def evaluate(
    checkpoint: Path | None,
    shards: Shards,
    config: EvaluationConfig | None = None,
    *,
    network: NetworkConfig | None = None,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> EvaluationResult:
    """Low-shot accuracy of a checkpoint on the single views of SHARDS.

    Args:
        checkpoint: a checkpoint file; None evaluates random weights.
        shards: a folder of shards.
        config: the protocols and settings; the paper's 5-way 1-shot where None.
        network: sizes of the network of random weights where `checkpoint` is None.
        device: where the network runs and the descriptors are kept.
        progress: told what is done.

    Raises:
        BadInput: checkpoint or shards cannot be used.
        UsageError: the views do not suffice for a protocol.
    """
    config = config or EvaluationConfig()
    if not config.protocols:
        raise UsageError("no protocol to evaluate", where="--ways, --shots")
    views = ViewShards(shards)
    chosen = views.select(config.split, config.categories)
    dataset = views.fingerprint
    populations = [_population(views, chosen, protocol) for protocol in config.protocols]
    episodes = [sample_episodes(*both) for both in zip(populations, config.protocols, strict=True)]

    classify = classify_locally if config.classifier == "local" else classify_by_centroid
    work = Work(views, config.matching, torch.device(device), config.batch, config.memory_gb, progress=progress)

    networks, work.image_size = _networks(checkpoint, network, config, device)
    rows: list[ResultRow] = []
    accuracies: list[NDArray[np.float64]] = []
    for net, weights in networks:
        if weights["network"] == "untrained":
            settle_on(net, views, chosen, work)
        predictions = classify(net, episodes, work)
        for asked, population, drawn, predicted in zip(
            config.protocols, populations, episodes, predictions, strict=True
        ):
            truth = np.arange(drawn.config.ways)[None, :, None]
            accuracies.append((predicted == truth).mean((1, 2)))
            accuracy, ci95 = mean_and_ci95(accuracies[-1])
            columns = {**weights, **_counts(population, drawn), **_settings_of(config, asked, drawn)}
            rows.append(ResultRow(accuracy=accuracy, ci95=ci95, dataset=dataset, **columns))
    n_episodes = sum(map(len, episodes)) * len(networks)
    return EvaluationResult(
        tuple(rows),
        tuple(accuracies),
        encode_ms_per_view=1e3 * work.encode_seconds / max(1, work.encoded),
        match_ms_per_episode=1e3 * work.match_seconds / n_episodes,
    )


def mean_and_ci95(accuracies: NDArray[np.float64]) -> tuple[float, float]:
    """Mean over episodes (E,) and half the 95% confidence interval (standard deviation with ddof 0)."""
    return float(accuracies.mean()), float(1.96 * accuracies.std() / np.sqrt(len(accuracies)))


def _networks(
    checkpoint: Path | None, network: NetworkConfig | None, config: EvaluationConfig, device: torch.device | str
) -> tuple[list[tuple[DopeNetwork, dict[str, Any]]], int | None]:
    """The networks to evaluate, each with the columns that say which weights it has, and their image size."""
    image_size = config.image_size
    found: list[tuple[DopeNetwork, dict[str, Any]]] = []
    if checkpoint is not None:
        from dope.checkpoints import load_network

        trained, meta = load_network(checkpoint, device)
        network = trained.config
        image_size = image_size or meta["config"]["data"]["image_size"]
        weights = {"checkpoint": Path(meta["path"]).name, "checkpoint_sha256": meta["sha256"], "step": meta["step"]}
        found.append((trained, {"network": "trained", "config_hash": meta["config_hash"], **weights}))
    if checkpoint is None or config.compare_untrained:
        network = network or NetworkConfig()
        seed = config.protocols[0].seed
        none = {"checkpoint": None, "checkpoint_sha256": None, "step": None}
        columns = {"network": "untrained", "config_hash": settings.config_hash(network), **none}
        found.append((untrained_network(network, seed).to(device), columns))
    return found, image_size


def settle_on(network: DopeNetwork, views: ViewShards, chosen: NDArray[np.int64], work: Work) -> None:
    """Give a network of random weights the BatchNorm statistics of views spread over those that are evaluated."""
    some = chosen[:: max(1, len(chosen) // SETTLING_VIEWS)][:SETTLING_VIEWS]
    batches = views.batches(some, 32, image_size=work.image_size)  # not work.batch: results must not depend on it
    settle_batchnorm(network, (to_tensor(images, work.device) for images in batches))


def _population(views: ViewShards, chosen: NDArray[np.int64], protocol: EpisodeConfig) -> Population:
    return views.population(chosen, by_category=protocol.classes == "category")


def _counts(population: Population, drawn: Episodes) -> dict[str, int]:
    """Classes, objects and views that the episodes could draw from."""
    classes = classes_of(population, drawn.config)
    used = [classes[name] for name in drawn.names]
    by_category = drawn.config.classes == "category"
    return {
        "n_classes": len(used),
        "n_objects": sum(map(len, used)) if by_category else len(used),
        "n_views": sum(len(views) for objects in used for views in objects.values()),
    }


def _settings_of(config: EvaluationConfig, asked: EpisodeConfig, drawn: Episodes) -> dict[str, Any]:
    """The columns that say what was measured."""
    used = drawn.config
    kept = ("classes", "ways", "shots", "shot_mode", "queries", "episodes", "seed")
    other = {"categories": config.categories, "image_size": config.image_size}
    return {
        **{name: getattr(used, name) for name in kept},
        "asked_ways": asked.ways,
        "asked_queries": asked.queries,
        "chance": drawn.chance,
        "classifier": config.classifier,
        "split": config.split,
        "evaluation_hash": settings.config_hash({**other, "matching": settings.to_dict(config.matching)}),
    }
