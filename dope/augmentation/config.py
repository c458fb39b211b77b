"""Every probability and range of the augmentation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class AugmentationConfig:
    """The paper's augmentation; lengths in pixels are at 224 px and scale with the shorter side of the images."""

    colour_p: float = 0.5
    """Probability of each of the five colour changes, each drawn for itself."""
    hue: tuple[float, float] = (-0.5, 0.5)
    """Shift of the hue in HSV, in turns of the colour circle."""
    saturation: tuple[float, float] = (0.0, 2.0)
    """Weight of the colour against its grey value: 0 = grey, 1 = unchanged."""
    brightness: tuple[float, float] = (0.6, 1.6)
    """Factor on all channels."""
    gamma: tuple[float, float] = (0.5, 1.5)
    """Exponent of all channels."""
    contrast: tuple[float, float] = (0.6, 1.6)
    """Factor on the distance from the image's mean grey value."""
    jitter_p: float = 0.0
    """Probability of colour jitter as a whole: brightness, contrast, saturation and hue in a random order."""
    jitter: tuple[float, float, float, float] = (0.4, 0.4, 0.4, 0.1)
    """How far the jitter goes: the first three's factors lie in 1 -+ this, the hue's shift in -+ this (in turns)."""
    grey_p: float = 0.0
    """Probability that a view loses its colour."""
    blur_p: float = 0.0
    """Probability of a Gaussian blur."""
    blur_px: tuple[float, float] = (0.1, 2.0)
    """Standard deviation of the blur."""
    flip_p: float = 0.5
    """Probability of a horizontal flip, for each view."""
    background_removal: Literal["paired", "off"] = "paired"
    """"paired": of each pair the first, the second or (half the time) both views lose their background."""
    single_background_p: float = 0.5
    """Probability that a view loses its background where views come alone (supervised baselines)."""
    geometry: bool = True
    """Move, rotate and scale the object within views that lose their background."""
    geometry_p: float = 0.5
    """Probability of the geometric step, for each view that loses its background."""
    clear_border_px: float = 5.0
    """Objects closer to the border may be cut off by it, and stay where they are."""
    rotation_deg: tuple[int, int] = (0, 359)
    """Whole degrees, both ends included."""
    longest_side_px: tuple[int, int] = (56, 195)
    """Longest side of the box around the rotated object after scaling, both ends included."""
    largest_scale: float = 1.5
    """Objects are never enlarged by more than this."""
    margin_px: float = 10.0
    """Least distance of the moved object's box from the border."""
    one_colour_p: float = 0.5
    """Probability of a background of one colour; the others are linear gradients between two."""
    noise_p: float = 0.5
    """Probability of noise on a new background."""
    noise: int = 50
    """The noise is the difference of two whole numbers below this, added in 8 bits with wrap-around."""
