"""What a study compares: the paper's methods, and the ablations of DOPE (paper, section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Source = Literal["pairs", "labelled", "predicted"]
"""Which shards a variant is trained on: pairs without labels, views with classes, or pairs with predicted masks."""


@dataclass(frozen=True)
class Variant:
    """One line of a study's table."""

    name: str
    """Of its runs' folders."""
    label: str
    """In the table."""
    method: str = "dope"
    """`dope train --method`."""
    settings: tuple[str, ...] = ()
    """`dope train --set`, on top of what all runs share."""
    source: Source = "pairs"
    """What it is trained on."""
    starts_from: str | None = None
    """Another variant, whose run of the same seed must be there first."""


METHODS: tuple[Variant, ...] = (
    Variant("simpleshot", "SimpleShot", "simpleshot", source="labelled"),
    Variant("rfs", "RFS", "rfs", source="labelled"),
    Variant("feat", "FEAT", "feat", ("data.batch_size=1",), "labelled", "simpleshot"),  # it counts episodes
    Variant("supmoco", "SupMoCo", "supmoco", source="labelled"),
    Variant("vispe", "VISPE", "vispe"),
    Variant("vispe_simsiam", "VISPE++ SimSiam", "vispe_simsiam"),
    Variant("vispe_moco", "VISPE++ MoCoV2", "vispe_moco"),
    Variant("dope", "DOPE"),
)
"""The rows of the paper's tables."""

ABLATIONS: tuple[Variant, ...] = (
    Variant("dope", "DOPE (2nd view + other objects)"),
    Variant("other_objects", "other objects only", settings=("loss.negatives=other_objects",)),
    Variant("second_view", "2nd view only", settings=("loss.negatives=second_view",)),
    Variant("one_view_twice", "one image augmented twice", settings=("pairs=one_view_twice",)),
    Variant(
        "no_background_removal",
        "no random background removal",
        settings=("augmentation.background_removal=off",),
    ),
    Variant("no_mask", "no mask prediction", settings=("network.predict_mask=false",)),
    Variant("predicted_masks", "predicted masks instead of given", source="predicted"),
)
"""Table 4 of the paper and the ablations of its text."""

KINDS: dict[str, tuple[Variant, ...]] = {
    "methods": METHODS,
    "ablations": ABLATIONS,
    "all": (*METHODS, *ABLATIONS[1:]),
}
