"""FEAT (Ye et al., CVPR 2020): class means that attention adapts to each other, trained by episodes."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dope.augmentation import WHOLE, Share
from dope.common.errors import UsageError
from dope.common.seeds import derive_seed
from dope.config import TrainConfig
from dope.distributed import Ranks
from dope.methods.base import Facts, MeanLoss, Method
from dope.methods.configs import FeatConfig
from dope.methods.data import view_dataset
from dope.methods.episode_order import EpisodeOrder, population
from dope.methods.pooled import PooledEmbedder, PooledNetwork
from dope.methods.set_attention import SetAttention, centres, distance_logits, draw_kept, episode_losses
from dope.methods.supervised import ClassifierNetwork, augmented, base_classes, refuse_pair_settings
from dope.networks import compiling
from dope.queries import autocast
from dope.single_views import ImageBatch, ViewDataset
from dope.validation import evaluating

if TYPE_CHECKING:
    from dope.lowshot.episodes import Episodes, Indices
    from dope.storage import Shards

logger = logging.getLogger(__name__)

STARTS = ("simpleshot", "rfs")
"""Methods whose encoder `feat.start` takes over."""
HELD_OUT_EPISODES = 200
"""Episodes of held-out views that a validation classifies."""
AT_ONCE = 64
"""Episodes whose class means are adapted at a time in evaluation."""


class FeatNetwork(nn.Module):
    """A pooled ResNet-18 and the attention over class means."""

    def __init__(self, width: float) -> None:
        super().__init__()
        self.encoder = PooledNetwork(width)
        self.attention = SetAttention(self.encoder.dim)

    def forward(self, images: Tensor) -> Tensor:
        """Features (B, D) of float images (B, 3, H, W) in [0, 1]."""
        features: Tensor = self.encoder(images)
        return features


@dataclass(frozen=True)
class EpisodeBatch:
    """E augmented episodes.

    Attributes:
        views: E * ways * (shots + queries) images, episode by episode, class by class, the shots first.
        complete: (E,) bool, False where a view of the episode is damaged: another one lies in its place.
    """

    views: ImageBatch
    complete: Tensor


class OnlineFeat(nn.Module):
    """All that has weights in a step, in one forward, which is what DistributedDataParallel wraps."""

    def __init__(self, network: FeatNetwork, config: FeatConfig, *, compiled: bool) -> None:
        super().__init__()
        self.network, self._config = network, config
        encode = network.encoder.forward
        self._encode = compiling.compiled(encode) if compiled else encode

    def forward(self, images: Tensor, seed: int, share: Share) -> tuple[Tensor, Tensor, Tensor]:
        """Images of E episodes to embeddings (E, ways, shots + queries, D), adapted class means (E, ways, D) and the
        regulariser's centres (E, ways, D).

        Args:
            images: as `EpisodeBatch.views` has them.
            seed: of the dropouts of this step.
            share: which part of the global batch these are.
        """
        config, attention = self._config, self.network.attention
        features = self._encode(images)
        with torch.autocast(images.device.type, enabled=False):
            members = config.shots + config.queries
            embeddings = features.float().view(-1, config.ways, members, features.shape[-1])
            prototypes = embeddings[:, :, : config.shots].mean(2)
            kept, kept_of_centres = None, None
            if self.training:
                shapes = [tuple(prototypes.shape[:-1]), tuple(embeddings.shape[:-1])]
                p = (config.attention_dropout, config.output_dropout)
                kept, kept_of_centres = draw_kept(shapes, features.shape[-1], p, seed, images.device, share)
            return embeddings, attention(prototypes, kept), centres(attention, embeddings, kept_of_centres)


class Feat(Method):
    """Few-shot embedding adaptation by a transformer."""

    name = "feat"
    sections = ("feat",)
    own_classifier = "attention"
    pairs = False
    batch_of = "episodes"
    score = "accuracy"

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config)
        refuse_pair_settings(self)

    def dataset(self, shards: Shards, split: str) -> ViewDataset:
        return view_dataset(self.config, shards, split)

    def order(self, dataset: ViewDataset) -> EpisodeOrder:
        return EpisodeOrder(dataset.index, self.config.data.batch_size, self.config.feat, self.config.seed)

    def facts(self, dataset: ViewDataset) -> Facts:
        return {"classes": base_classes(dataset)}

    def new_network(self, facts: Facts) -> FeatNetwork:
        return FeatNetwork(self.config.network.width)

    def start(self, network: nn.Module, facts: Facts) -> Facts:
        assert isinstance(network, FeatNetwork)
        feat = self.config.feat
        if feat.shots > 1 and feat.balance == FeatConfig.balance:
            what = "feat.shots=%d with the paper's feat.balance of 1 shot; for 5 it is 0.1, feat.centre_temperature %g"
            logger.warning(what, feat.shots, feat.temperature / 2)
        if not feat.start:
            logger.warning("feat.start names no run of SimpleShot or RFS: the encoder begins with random weights")
            return facts
        known = take_encoder(network, Path(feat.start), self.config.network.width)
        return {**facts, "classes": sorted({*facts.get("classes", ()), *known})}

    def online(self, network: nn.Module) -> OnlineFeat:
        assert isinstance(network, FeatNetwork)
        return OnlineFeat(network, self.config.feat, compiled=self.config.compile)

    def parameter_groups(self, network: nn.Module) -> list[dict[str, Any]]:
        assert isinstance(network, FeatNetwork)
        scale = self.config.feat.encoder_lr_scale
        return [
            {"params": list(network.encoder.parameters()), "lr_scale": scale},
            {"params": list(network.attention.parameters())},
        ]

    def prepare(self, batch: ImageBatch, step: int, share: Share = WHOLE) -> EpisodeBatch:
        feat = self.config.feat
        of_episode = feat.ways * (feat.shots + feat.queries)
        complete = torch.ones(len(batch) // of_episode, dtype=torch.bool)
        for place in batch.damaged:
            complete[place // of_episode] = False
        return EpisodeBatch(augmented(batch, self.config, step, share), complete.to(batch.images.device))

    def losses(
        self, online: nn.Module, companion: Any, batch: EpisodeBatch, ranks: Ranks, *, step: int = 0, stop: bool = False
    ) -> MeanLoss:
        feat, complete = self.config.feat, batch.complete
        seed = derive_seed(self.config.seed, "dropout", step)
        with autocast(self.config.precision, complete.device):
            embeddings, prototypes, to = online(batch.views.images, seed, Share(ranks.rank, ranks.world))
        temperatures = (feat.temperature, feat.centre_temperature)
        each = episode_losses(embeddings, prototypes, to, feat.shots, temperatures)
        n = ranks.sum(complete.sum()).clamp(min=1)
        queries, regulariser, accuracy = (part.where(complete, 0.0).sum() * ranks.world / n for part in each)
        total = queries + feat.balance * regulariser
        return MeanLoss.of(total, ranks, stop, queries=queries, regulariser=regulariser, accuracy=accuracy)

    def validate(self, network: nn.Module, held_out: list[ImageBatch], ranks: Ranks) -> dict[str, Any]:
        """Accuracy on episodes of held-out views of the base classes, with fewer ways and queries where these do not
        suffice; `chance` says what guessing gives."""
        assert isinstance(network, FeatNetwork)
        device, found = next(network.parameters()).device, []
        with evaluating(network), torch.no_grad():
            for batch in held_out:
                vectors = network(batch.images.to(device).float() / 255).cpu().numpy()
                found.append((vectors, batch.labels.numpy(), batch.objects.numpy(), np.array(batch.keys)))
            parts = [part for some in ranks.collect(found) for part in some]
            none = {"accuracy": float("nan"), "chance": float("nan"), "pairs": 0}
            if not parts:
                return none
            vectors, labels, objects, keys = (np.concatenate(columns) for columns in zip(*parts, strict=True))
            order = np.argsort(keys)  # the same whatever the ranks' shares
            vectors, labels, objects = vectors[order], labels[order], objects[order]
            drawn = held_out_episodes(labels, objects, self.config.feat, self.config.seed)
            if drawn is None:
                return none
            predicted = adapted_nearest(network.attention, vectors, drawn, device)
        hits = predicted == np.arange(predicted.shape[1])[:, None]
        return {"accuracy": float(hits.mean()), "chance": drawn.chance, "pairs": len(vectors)}

    def embedder(self, network: nn.Module) -> FeatEmbedder:
        assert isinstance(network, FeatNetwork)
        return FeatEmbedder(network, self.config.feat, self.config.data.image_size)


class FeatEmbedder(PooledEmbedder):
    """Pooled features, and the nearest of the class means that attention has adapted to each other.

    Args:
        network: in eval mode.
        config: the ways and shots that it was trained for; others are classified all the same, with a warning.
        image_size: side in pixels that views are resized to.
    """

    def __init__(self, network: FeatNetwork, config: FeatConfig, image_size: int | None) -> None:
        super().__init__(network.encoder, Feat.name, Feat.own_classifier, image_size)
        self.attention, self.config = network.attention, config

    def classify(self, vectors: NDArray[np.float32], episodes: Episodes) -> Indices:
        asked, own = (episodes.config.ways, episodes.config.shots), (self.config.ways, self.config.shots)
        if asked != own:
            logger.warning("a FEAT of %d-way %d-shot episodes classifies %d-way %d-shot ones", *own, *asked)
        return adapted_nearest(self.attention, vectors, episodes, next(self.attention.parameters()).device)


@torch.no_grad()
def adapted_nearest(
    attention: SetAttention, vectors: NDArray[np.floating], episodes: Episodes, device: torch.device
) -> Indices:
    """The way (E, ways, queries) with the greatest logit -|p' - q|^2 / T, p' being the adapted class means: T divides
    all of them alike, so it takes no part here.

    Args:
        attention: in eval mode.
        vectors: (V, D) features of all views.
        episodes: indices into them.
        device: of the attention.
    """
    features = torch.from_numpy(np.ascontiguousarray(vectors, np.float32)).to(device)
    predicted = []
    for start in range(0, len(episodes), AT_ONCE):
        support, query = (
            torch.from_numpy(part[start : start + AT_ONCE]).to(device) for part in (episodes.support, episodes.query)
        )
        prototypes = attention(features[support].mean(2))
        logits = distance_logits(features[query].flatten(1, 2), prototypes, 1.0)
        predicted.append(logits.argmax(-1).unflatten(1, query.shape[1:]).cpu().numpy())
    return np.concatenate(predicted)


def held_out_episodes(
    labels: NDArray[np.integer], objects: NDArray[np.integer], config: FeatConfig, seed: int
) -> Episodes | None:
    """Episodes of held-out views (N,), as near to the settings' as these allow; None where they allow none."""
    from dope.lowshot.episodes import EpisodeConfig, sample_episodes

    known = population(labels, objects, tuple(map(str, range(int(labels.max(initial=-1)) + 1))))
    protocol = EpisodeConfig(
        ways=config.ways,
        shots=config.shots,
        queries=config.queries,
        episodes=HELD_OUT_EPISODES,
        seed=derive_seed(seed, "held-out episodes"),
        fit=True,
    )
    try:
        return sample_episodes(known, protocol)
    except UsageError as error:
        logger.warning("nothing is validated: the held-out views make no episode (%s)", error.what)
        return None


def take_encoder(network: FeatNetwork, path: Path, width: float) -> list[str]:
    """Begin with the encoder of a checkpoint of SimpleShot or RFS.

    Returns:
        The classes whose labels it has learnt from, which are no new ones to this network either.

    Raises:
        BadInput: no checkpoint there, or it cannot be read.
        UsageError: of another method, or of another width.
    """
    from dope.checkpoints import load_method

    method, trained, meta = load_method(path)
    where = f"feat.start={meta['path']}"
    if method.name not in STARTS:
        remedy = "Give a checkpoint or run of `dope train --method simpleshot`"
        raise UsageError(f"is of method {method.name}", where=where, remedy=remedy)
    theirs = method.config.network.width
    if theirs != width:
        what = f"has network.width {theirs}, this run {width}"
        raise UsageError(what, where=where, remedy=f"Use --set network.width={theirs}")
    assert isinstance(trained, ClassifierNetwork)
    network.encoder.load_state_dict(trained.encoder.state_dict())
    return list(meta["facts"]["classes"])
