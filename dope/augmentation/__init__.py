"""Augmentation of view pairs and of single views, batched on the device (DOPE, section 3 and supplement)."""

from dope.augmentation.config import AugmentationConfig
from dope.augmentation.draws import WHOLE, Share, uniform_rows
from dope.augmentation.pairs import augment, duplicate_view, no_augmentation
from dope.augmentation.views import augment_images

__all__ = [
    "WHOLE",
    "AugmentationConfig",
    "Share",
    "augment",
    "augment_images",
    "duplicate_view",
    "no_augmentation",
    "uniform_rows",
]
