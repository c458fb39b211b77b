"""Which values of a run's settings make sense."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from dope.augmentation import AugmentationConfig
from dope.augmentation.geometry import NOMINAL_PX
from dope.common import settings
from dope.common.errors import UsageError

if TYPE_CHECKING:
    from dope.config import TrainConfig

Rule = tuple[str, bool, str]
"""A setting's dotted key, whether its value is right, and what it must be."""

PROBABILITIES = (
    "colour_p", "jitter_p", "grey_p", "blur_p", "flip_p", "single_background_p", "geometry_p", "one_colour_p",
    "noise_p",
)  # fmt: skip
RANGES = ("hue", "saturation", "brightness", "gamma", "contrast", "blur_px", "rotation_deg", "longest_side_px")


def check(config: TrainConfig) -> None:
    """Raise `UsageError` naming the first setting whose value makes no sense."""
    values = flat(settings.to_dict(config))
    for key, ok, rule in (
        *_finite(values),
        *_rules(config),
        *_augmentation_rules(config.augmentation),
        *_contrast_rules(config),
        *_feat_rules(config),
    ):
        if not ok:
            raise UsageError(f"'{values[key]}' {rule}", where=key, remedy=f"Change it with --set {key}=...")


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted key; tuples become lists."""
    result: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            result |= flat(value, f"{prefix}{key}.")
        else:
            result[prefix + key] = list(value) if isinstance(value, tuple) else value
    return result


def _finite(values: dict[str, Any]) -> Iterator[Rule]:
    for key, value in values.items():
        numbers = [part for part in (value if isinstance(value, list) else [value]) if isinstance(part, float)]
        yield key, all(map(math.isfinite, numbers)), "must be finite"


def _rules(config: TrainConfig) -> tuple[Rule, ...]:
    data, schedule, network, loss = config.data, config.schedule, config.network, config.loss
    validation, checkpoint, optimiser = config.validation, config.checkpoint, config.optimiser
    alone = loss.negatives == "second_view" and data.points < 2
    return (
        ("data.image_size", data.image_size >= 32 and data.image_size % 32 == 0, "must be a positive multiple of 32"),
        ("data.batch_size", data.batch_size >= 1, "must be at least 1"),
        (
            "data.batch_size",
            config.method == "feat" or data.batch_size >= 2,
            "must be at least 2: the other pairs of a batch are the negatives",
        ),
        ("data.micro_batch", data.micro_batch >= 0, "must not be negative"),
        ("data.pairs_per_object", data.pairs_per_object >= 1, "must be at least 1"),
        ("data.points", data.points >= 1, "must be at least 1"),
        ("data.points", not alone, "must be at least 2: the other points of a pair are the negatives"),
        ("data.max_points", data.max_points >= data.points, "must not be less than data.points"),
        ("data.workers", data.workers >= 0, "must not be negative"),
        ("data.block", data.block >= 1, "must be at least 1"),
        ("data.min_correspondences", data.min_correspondences >= 0, "must not be negative"),
        ("data.max_bad_samples", data.max_bad_samples >= 0, "must not be negative"),
        ("data.micro_batch", config.method == "dope" or data.micro_batch == 0, "must be 0 for methods other than dope"),
        ("network.width", network.width > 0, "must be positive"),
        ("network.pyramid", network.pyramid >= 1, "must be at least 1"),
        ("network.projector", bool(network.projector) and min(network.projector) >= 1, "must be one or more widths"),
        ("loss.temperature", loss.temperature > 0, "must be positive"),
        ("loss.mask_weight", loss.mask_weight >= 0, "must not be negative"),
        ("loss.chunk", loss.chunk >= 1, "must be at least 1"),
        ("optimiser.lr", optimiser.lr > 0, "must be positive"),
        ("optimiser.lr_batch", optimiser.lr_batch >= 0, "must not be negative"),
        ("optimiser.weight_decay", optimiser.weight_decay >= 0, "must not be negative"),
        ("optimiser.betas", all(0 <= beta < 1 for beta in optimiser.betas), "must lie in [0, 1)"),
        ("optimiser.momentum", 0 <= optimiser.momentum < 1, "must lie in [0, 1)"),
        (
            "optimiser.nesterov",
            not optimiser.nesterov or optimiser.momentum > 0,
            "needs optimiser.momentum of more than 0",
        ),
        ("schedule.milestones", all(0 < at < 1 for at in schedule.milestones), "must lie between 0 and 1"),
        ("schedule.factor", schedule.factor > 0, "must be positive"),
        ("schedule.epochs", schedule.epochs >= 1, "must be at least 1"),
        ("schedule.max_steps", schedule.max_steps >= 0, "must not be negative"),
        ("schedule.warmup_steps", schedule.warmup_steps >= 0, "must not be negative"),
        ("momentum", 0 <= config.momentum <= 1, "must lie in [0, 1]"),
        ("validation.every", validation.every >= 0, "must not be negative"),
        ("validation.pairs", validation.pairs >= 1, "must be at least 1 (validation.every=0 turns it off)"),
        ("validation.batch_size", validation.batch_size >= 1, "must be at least 1"),
        ("checkpoint.every", checkpoint.every >= 0, "must not be negative"),
        ("checkpoint.every_steps", checkpoint.every_steps >= 0, "must not be negative"),
        ("checkpoint.keep", checkpoint.keep >= 0, "must not be negative"),
        ("checkpoint.keep_every", checkpoint.keep_every >= 0, "must not be negative"),
        (
            "checkpoint.keep_best",
            not checkpoint.keep_best or validation.every > 0,
            "needs validation.every of 1 or more",
        ),
        ("log.every", config.log.every >= 1, "must be at least 1"),
        ("log.pictures", config.log.pictures >= 0, "must not be negative"),
    )


def _augmentation_rules(config: AugmentationConfig) -> Iterator[Rule]:
    for name in PROBABILITIES:
        yield f"augmentation.{name}", 0 <= getattr(config, name) <= 1, "must lie in [0, 1]"
    for name in RANGES:
        low, high = getattr(config, name)
        yield f"augmentation.{name}", low <= high, "must be the least value, then the greatest"
    for name in ("saturation", "brightness", "contrast"):
        yield f"augmentation.{name}", getattr(config, name)[0] >= 0, "must not be negative"
    *factors, hue = config.jitter
    yield "augmentation.jitter", min(config.jitter) >= 0, "must not be negative"
    yield "augmentation.jitter", max(factors) <= 1 and hue <= 0.5, "must be 1 or less, of the hue 0.5 or less"
    yield "augmentation.blur_px", config.blur_px[0] > 0, "must be positive"
    room = NOMINAL_PX - config.longest_side_px[1]
    yield "augmentation.gamma", config.gamma[0] > 0, "must be positive"
    yield "augmentation.noise", 0 <= config.noise <= 256, "must lie in [0, 256]"
    yield "augmentation.clear_border_px", config.clear_border_px >= 0, "must not be negative"
    yield "augmentation.longest_side_px", config.longest_side_px[0] >= 1, "must be at least 1"
    yield "augmentation.longest_side_px", room >= 0, f"must not be more than the view's {NOMINAL_PX} px"
    margin = 0 <= config.margin_px <= room / 2
    yield "augmentation.margin_px", margin, f"must be 0 or more and leave augmentation.longest_side_px of {NOMINAL_PX}"
    yield "augmentation.largest_scale", config.largest_scale > 0, "must be positive"


def _contrast_rules(config: TrainConfig) -> Iterator[Rule]:
    """Of the methods that contrast whole views."""
    supmoco, moco, vispe, simsiam = config.supmoco, config.moco, config.vispe, config.simsiam
    for name in ("keys", "queue", "head"):
        yield f"supmoco.{name}", getattr(supmoco, name) >= 1, "must be at least 1"
    yield "moco.queue", moco.queue >= 1, "must be at least 1"
    yield "moco.head", min(moco.head) >= 1, "must be two widths of at least 1"
    for section, temperature in (("supmoco", supmoco), ("moco", moco), ("vispe", vispe)):
        yield f"{section}.temperature", temperature.temperature > 0, "must be positive"
    yield "vispe.alpha", vispe.alpha >= 0, "must not be negative"
    for name in ("projector", "predictor"):
        yield f"simsiam.{name}", getattr(simsiam, name) >= 1, "must be at least 1"


def _feat_rules(config: TrainConfig) -> Iterator[Rule]:
    feat = config.feat
    for name, least in (("ways", 2), ("shots", 1), ("queries", 1), ("episodes", 1)):
        yield f"feat.{name}", getattr(feat, name) >= least, f"must be at least {least}"
    for name in ("temperature", "centre_temperature"):
        yield f"feat.{name}", getattr(feat, name) > 0, "must be positive"
    for name in ("balance", "encoder_lr_scale"):
        yield f"feat.{name}", getattr(feat, name) >= 0, "must not be negative"
    for name in ("attention_dropout", "output_dropout"):
        yield f"feat.{name}", 0 <= getattr(feat, name) < 1, "must lie in [0, 1)"
