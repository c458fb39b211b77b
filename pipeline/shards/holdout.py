"""What is kept from training: an arc of each object's views, or whole objects."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from dope.common import seeds


def held_out_arc(
    frames: NDArray[np.integer], pairs: NDArray[np.integer], fraction: float, *seed: int | str
) -> NDArray[np.bool_]:
    """Choose neighbouring views to hold out, such that pairs remain on both sides.

    Args:
        frames: (V,) frame numbers of the views, ascending.
        pairs: (P, 2) frame numbers.
        fraction: share of the views to hold out.
        seed: chooses among the arcs that hold at least half as many pairs as the best; where no view is of two pairs,
            among those of them that leave the fewest pairs with one view on either side.

    Returns:
        (V,) True = held out; all False where no arc leaves a pair on either side.
    """
    n = len(frames)
    none = np.zeros(n, dtype=bool)
    length = min(max(2, round(fraction * n)), n - 2)
    if fraction <= 0 or length < 2 or len(pairs) == 0:
        return none
    places = np.searchsorted(frames, pairs)
    starts = np.arange(n - length + 1)
    held = (places[None] >= starts[:, None, None]) & (places[None] < starts[:, None, None] + length)  # (S, P, 2)
    n_val, n_train = held.all(axis=2).sum(axis=1), (~held).all(axis=2).sum(axis=1)
    n_val = np.where(n_train > 0, n_val, 0)
    if n_val.max() == 0:
        return none
    good = starts[n_val * 2 >= n_val.max()]
    if len(np.unique(pairs)) == pairs.size:  # renders, where each view is of one pair: an arc need not part any
        parted = len(pairs) - n_val[good] - n_train[good]
        good = good[parted == parted.min()]
    start = int(good[seeds.derive_seed("held-out arc", *seed) % len(good)])
    none[start : start + length] = True
    return none


def held_out_objects(objects: dict[str, tuple[str | None, str]], fraction: float, seed: int) -> set[str]:
    """Choose sequences to hold out, the same share of every category, all sequences of an instance together.

    Args:
        objects: sequence id -> (category, instance).
        fraction: share of the instances; at least one and not all of them, where there are two.

    Returns:
        The ids of the held-out sequences. The order of `objects` does not matter.
    """
    instances: dict[str, set[str]] = defaultdict(set)
    for category, instance in objects.values():
        instances[category or ""].add(instance)
    total = sum(map(len, instances.values()))
    if fraction <= 0 or total < 2:
        return set()
    wanted = min(max(1, round(fraction * total)), total - 1)
    # largest remainders: every category gives its share rounded down, the rest go where most was cut off
    shares = {category: fraction * len(names) for category, names in sorted(instances.items())}
    quota = {category: min(int(share), len(instances[category])) for category, share in shares.items()}
    by_remainder = sorted(
        shares, key=lambda c: (int(shares[c]) - shares[c], seeds.derive_seed("held-out category", seed, c))
    )
    for category in by_remainder * 2:
        if sum(quota.values()) < wanted and quota[category] < len(instances[category]):
            quota[category] += 1
    chosen = set()
    for category, names in instances.items():
        ranked = sorted(names, key=lambda name: seeds.derive_seed("held-out object", seed, category, name))
        chosen |= {(category, name) for name in ranked[: quota[category]]}
    return {id for id, (category, instance) in objects.items() if (category or "", instance) in chosen}
