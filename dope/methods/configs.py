"""What the methods set besides what all share; the defaults are the paper's (supplement, and the methods' own)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

MethodName = Literal["dope", "simpleshot", "rfs", "feat", "supmoco", "vispe", "vispe_moco", "vispe_simsiam"]


@dataclass(frozen=True)
class SimpleShotConfig:
    """SimpleShot (Wang et al., 2019): a classifier of the base classes, then nearest class means."""

    transform: Literal["cl2n", "l2n", "un"] = "cl2n"
    """What features go through before the means: centred by the mean of the base images and scaled to unit length,
    scaled to unit length, or nothing."""


@dataclass(frozen=True)
class FeatConfig:
    """FEAT (Ye et al., CVPR 2020): set-to-set attention over class means, trained by episodes."""

    start: str = ""
    """Checkpoint or run of SimpleShot whose encoder it begins with; empty: random weights."""
    ways: int = 5
    """Classes of a training episode."""
    shots: int = 1
    """Labelled views a class; a model is for one (ways, shots)."""
    queries: int = 15
    """Queries a class."""
    episodes: int = 100
    """Training episodes an epoch."""
    temperature: float = 32.0
    """Divides the distances to the adapted class means."""
    centre_temperature: float = 32.0
    """Divides the distances to the adapted centres of the regulariser."""
    balance: float = 0.01
    """Weight of the regulariser (5-shot: 0.1)."""
    encoder_lr_scale: float = 0.1
    """Learning rate of the encoder over that of the attention."""
    attention_dropout: float = 0.1
    """Dropout of attention weights."""
    output_dropout: float = 0.5
    """Dropout after the attention's output layer."""


@dataclass(frozen=True)
class SupMoCoConfig:
    """SupMoCo (Majumder et al., 2021): momentum contrast in which views of one class are positives."""

    keys: int = 3
    """P: positive keys of a query, views of objects of its class."""
    queue: int = 4096
    """Keys that are kept with their labels."""
    temperature: float = 0.07
    """Divides the similarities."""
    head: int = 128
    """Length of the vectors that are contrasted."""


@dataclass(frozen=True)
class VispeConfig:
    """VISPE (Ho et al., NeurIPS 2020): views of one object are alike, in view and in distribution over the batch."""

    temperature: float = 0.05
    """Lambda: divides the similarities."""
    alpha: float = 5.0
    """Weight of the divergence between the two views' distributions."""


@dataclass(frozen=True)
class MoCoConfig:
    """VISPE++ with MoCo v2 (Chen et al., 2020): two views of an object are the positive pair."""

    queue: int = 4096
    """Keys that are kept (ABC: 16,384)."""
    temperature: float = 0.2
    """Divides the similarities."""
    head: tuple[int, int] = (1024, 128)
    """Widths of the projection head."""


@dataclass(frozen=True)
class SimSiamConfig:
    """VISPE++ with SimSiam (Chen and He, CVPR 2021): a view predicts the other one, without negatives."""

    projector: int = 2048
    """Width of the three layers of the projector."""
    predictor: int = 512
    """Width of the predictor's hidden layer."""
    constant_predictor_lr: bool = True
    """The predictor keeps its learning rate while the others' falls."""
