"""The settings of a training run: one frozen dataclass, and `load_config` that resolves presets, files and overrides.

The defaults are the paper's, so `TrainConfig()` and the preset `paper` are the same run.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml as pyyaml

from dope.augmentation import AugmentationConfig
from dope.common import files, settings
from dope.config_rules import check as check  # its callers need not know where the rules lie
from dope.config_rules import flat
from dope.methods.configs import (
    FeatConfig,
    MethodName,
    MoCoConfig,
    SimpleShotConfig,
    SimSiamConfig,
    SupMoCoConfig,
    VispeConfig,
)
from dope.networks import NetworkConfig
from dope.order import Order
from dope.preset_files import merged, method_values, preset_values

RESULT_NEUTRAL = (
    "data.workers", "data.max_bad_samples", "device", "channels_last", "compile", "validation", "checkpoint", "log",
)  # fmt: skip
"""Settings that do not change what is learnt: a run may be resumed with other values of these.

`device`, `channels_last` and `compile` choose among programs that compute the same up to rounding.
"""


@dataclass(frozen=True)
class DataConfig:
    """What a batch is made of."""

    image_size: int = 224
    """Side of the images in pixels, a multiple of 32; the loader resizes the views and scales their points."""
    batch_size: int = 256
    """Pairs in a step over all ranks together; incomplete batches are dropped."""
    micro_batch: int = 0
    """Pairs whose activations a rank has in memory at a time, all keys being contrasted anyway; 0 = its whole share."""
    pairs_per_object: int = 1
    """Pairs of each object in an epoch (1 in the paper)."""
    points: int = 32
    """Corresponding points a pair, by farthest point sampling on view 1."""
    max_points: int = 4096
    """Correspondences read of a pair: the first ones, which the shards keep in farthest-point order."""
    workers: int = 8
    """Processes on each rank that decode; 0 decodes in the training process."""
    order: Order = "shuffled"
    """shuffled, or sequential: blocks of neighbouring samples in long reads, for remote or slow storage."""
    block: int = 32
    """Neighbouring samples that stay together in sequential order: less is more random, more reads longer."""
    min_correspondences: int = 1
    """Training pairs with fewer correspondences are left out."""
    categories: tuple[str, ...] = ()
    """Only objects of these categories; none given: all (and those without a category, where no labels are used)."""
    max_bad_samples: int = 0
    """Damaged samples (by their keys, over all ranks and resumes) that are put up with; one more stops the run."""


@dataclass(frozen=True)
class LossConfig:
    """Contrastive loss over points, and cross entropy on the mask."""

    temperature: float = 0.1
    """Divides the dot products."""
    negatives: Literal["both", "other_objects", "second_view"] = "both"
    """Negatives of a point: other points of its object in view 2, all points of other objects, or both."""
    mask_weight: float = 1.0
    """Weight of the mask loss against the contrastive loss; 0 leaves it out."""
    chunk: int = 512
    """Queries whose logits are in memory at a time."""


@dataclass(frozen=True)
class OptimiserConfig:
    """What moves the weights."""

    name: Literal["adamw", "sgd"] = "adamw"
    """AdamW, or stochastic gradient descent with momentum (weight decay then is part of the gradient)."""

    lr: float = 1e-4
    """Highest learning rate."""
    lr_batch: int = 0
    """data.batch_size that `lr` is for: with another one it becomes lr * data.batch_size / this; 0 = it stays."""
    weight_decay: float = 1e-2
    """Decoupled weight decay."""
    betas: tuple[float, float] = (0.9, 0.999)
    """AdamW: decay rates of the two moments."""
    momentum: float = 0.9
    """SGD: share of the last step that is kept."""
    nesterov: bool = False
    """SGD: Nesterov's form of it."""


@dataclass(frozen=True)
class ScheduleConfig:
    """How long, and how the learning rate falls."""

    epochs: int = 3000
    """Passes in which each object is seen `data.pairs_per_object` times."""
    max_steps: int = 0
    """Ends the run, and the fall of the learning rate, after so many steps though epochs are left; 0 = no limit."""
    shape: Literal["cosine", "constant", "steps"] = "cosine"
    """Cosine to 0 at the end, constant, or falling in steps."""
    milestones: tuple[float, ...] = (0.7, 0.9)
    """steps: shares of the run, in (0, 1), at which the rate falls."""
    factor: float = 0.1
    """steps: what it is multiplied by there."""
    per: Literal["epoch", "step"] = "epoch"
    """Whether the rate changes once an epoch (the paper) or every step."""
    warmup_steps: int = 0
    """Steps of linear rise from 0 (the paper has none)."""


@dataclass(frozen=True)
class ValidationConfig:
    """PCK and mask IoU on held-out pairs (split `val`), before the first step, every so often, and at the end."""

    every: int = 50
    """Epochs between two validations; 0 turns them off."""
    pairs: int = 256
    """Pairs used: the first ones of the split, which hold each object once before any twice."""
    batch_size: int = 32
    """Pairs encoded at a time on a rank."""


@dataclass(frozen=True)
class CheckpointConfig:
    """RUN/checkpoints/step-XXXXXXXX.pt; one is always written at the end and when a signal stops the run."""

    every: int = 50
    """Epochs between two checkpoints; 0 = none in between."""
    every_steps: int = 0
    """Steps between two checkpoints, besides those of `every`; 0 = none."""
    keep: int = 0
    """The newest checkpoints to keep; 0 keeps all of them."""
    keep_best: bool = False
    """Write one at each validation with the best PCK so far, and keep the best besides (RUN/checkpoints/best)."""
    keep_every: int = 0
    """Checkpoints of steps that are multiples of this are never deleted; 0 = none."""


@dataclass(frozen=True)
class LogConfig:
    """What a run tells besides its progress: RUN/metrics.jsonl and RUN/tensorboard, always; W&B on request."""

    every: int = 10
    """Steps between two lines of metrics.jsonl and two points of the curves."""
    pictures: int = 4
    """Held-out pairs drawn at each validation (a point found again, predicted masks); 0 = none."""
    wandb: str = ""
    """Project of Weights & Biases that gets the same; empty = none. Needs `pip install 'dope-descriptors[wandb]'`."""


@dataclass(frozen=True)
class DistributedConfig:
    """What changes with more than one rank."""

    sync_batchnorm: bool = False
    """BatchNorm statistics of both encoders over all ranks: N ranks then train as one process would."""
    shuffle_batchnorm: bool = True
    """Shuffle the momentum encoder's images over the ranks, so that BatchNorm does not give pairs away (MoCo); has no
    purpose, and is not done, with `sync_batchnorm`."""
    local_negatives: bool = False
    """Contrast with the own rank's keys only, as the released code: the loss then depends on the number of ranks."""


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides what a training run does."""

    method: MethodName = "dope"
    """What is trained: DOPE, or one of the baselines (`dope train --method`)."""
    data: DataConfig = field(default_factory=DataConfig)
    """Images, batches and points."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Encoder, mask head and projector."""
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    """Colour, geometry and background of each view."""
    pairs: Literal["two_views", "one_view_twice"] = "two_views"
    """Two cameras, or one image augmented twice (ablation)."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Contrastive and mask loss."""
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    """AdamW."""
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    """Epochs and learning rate."""
    momentum: float = 0.999
    """Share of the momentum encoder that stays at each step."""
    distributed: DistributedConfig = field(default_factory=DistributedConfig)
    """Only matters with more than one rank."""
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    """PCK on held-out pairs."""
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    """What is saved, and when."""
    precision: Literal["auto", "fp32", "bf16"] = "fp32"
    """bf16 runs the encoders in autocast, normalisation and losses in fp32 (slow on most CPUs); auto: bf16 on CUDA."""
    channels_last: bool = True
    """Keep weights and feature maps with the channels innermost in memory: faster on CPUs and tensor cores."""
    compile: bool = False
    """Compile the encoders' forward and backward pass by torch.compile: minutes at the start, fewer in each step."""
    device: str = "auto"
    """auto (CUDA where there is one), cpu, cuda or cuda:N."""
    log: LogConfig = field(default_factory=LogConfig)
    """Curves and pictures."""
    simpleshot: SimpleShotConfig = field(default_factory=SimpleShotConfig)
    """Of `method` simpleshot."""
    feat: FeatConfig = field(default_factory=FeatConfig)
    """Of `method` feat."""
    supmoco: SupMoCoConfig = field(default_factory=SupMoCoConfig)
    """Of `method` supmoco."""
    vispe: VispeConfig = field(default_factory=VispeConfig)
    """Of `method` vispe."""
    moco: MoCoConfig = field(default_factory=MoCoConfig)
    """Of `method` vispe_moco."""
    simsiam: SimSiamConfig = field(default_factory=SimSiamConfig)
    """Of `method` vispe_simsiam."""
    seed: int = 12345
    """Everything random derives from it."""


def load_config(
    preset: str | None = None,
    yaml: Path | None = None,
    overrides: Iterable[str] = (),
    *,
    method: str | None = None,
) -> TrainConfig:
    """Resolve a run's settings: the preset, on top of it a YAML file, on top of it `key=value` overrides.

    With a `method`, what its own file (presets/methods/) gives for the preset comes between preset and YAML file.

    Raises:
        UsageError: an unknown preset or key (the closest known one is named), a value of the wrong type or range.
    """
    values = {} if preset is None else preset_values(preset)
    if method is not None:
        values = merged(values, method_values(method, preset))
    if yaml is not None:
        values = merged(values, settings.load_yaml(yaml))
    where = str(yaml) if yaml is not None else f"preset {preset}"
    config = settings.override(settings.from_mapping(TrainConfig, values, where=where), overrides)
    check(config)
    return config


def write_config(path: Path, config: TrainConfig) -> None:
    """Write the resolved settings as YAML, which `--config` reads again, with its hash in the first line."""
    text = pyyaml.safe_dump(_plain(settings.to_dict(config)), sort_keys=False, allow_unicode=True)
    files.write_bytes(path, f"# hash {settings.config_hash(config)}\n{text}".encode())


def differing_keys(ours: dict[str, Any], theirs: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Settings that differ between two configs given as plain dicts: dotted key -> (ours, theirs).

    Those of `RESULT_NEUTRAL` are left out; a key that only one side has counts as None on the other.
    """
    left, right = flat(ours), flat(theirs)
    return {
        key: (left.get(key), right.get(key))
        for key in sorted(left.keys() | right.keys())
        if left.get(key) != right.get(key) and not any(key == n or key.startswith(n + ".") for n in RESULT_NEUTRAL)
    }


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, (list, tuple)) else value
