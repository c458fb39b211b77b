"""Seeds that are a function of what they are for, the same in every process and Python version."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


def derive_seed(*parts: int | str) -> int:
    """A 63-bit seed from any sequence of numbers and words, e.g. `derive_seed(seed, "epoch", 3, "rank", 0)`."""
    text = "\0".join(f"{type(part).__name__}:{part}" for part in parts)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def generator(*parts: int | str) -> np.random.Generator:
    """A NumPy generator seeded with `derive_seed(*parts)`."""
    import numpy as np

    return np.random.default_rng(derive_seed(*parts))
