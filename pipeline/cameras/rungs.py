"""The rungs of the ladder: each costs more than the one before, and holds on to less texture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Rung:
    """One set of features and matches to map from."""

    name: str
    first_octave: int | None = None
    """None: as configured."""
    guided: bool = False
    size: Literal["max_image_size", "fine_image_size", "fallback_image_size"] = "max_image_size"
    """The setting that says at which size features are found."""
    exhaustive: bool = False
    """All pairs, where the set is small."""


LADDER = (
    Rung("default"),
    Rung("fine", first_octave=-1, guided=True, size="fine_image_size"),
    Rung("large", first_octave=-1, guided=True, size="fallback_image_size", exhaustive=True),
)
