"""Augmentation of view pairs and of single views, batched on the device (DOPE, section 3 and supplement)."""

from dope.augmentation.config import AugmentationConfig
from dope.augmentation.pairs import augment, duplicate_view, no_augmentation
from dope.augmentation.views import augment_images

__all__ = ["AugmentationConfig", "augment", "augment_images", "duplicate_view", "no_augmentation"]
