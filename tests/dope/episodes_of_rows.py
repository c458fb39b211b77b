"""Episodes of given rows."""

from __future__ import annotations

from typing import Any

import numpy as np

from dope.lowshot.episodes import EpisodeConfig, Episodes


def episodes_of(support: Any, query: Any) -> Episodes:
    """Of support rows (E, ways, shots) and query rows (E, ways, queries), in classes without names."""
    support, query = np.array(support), np.array(query)
    config = EpisodeConfig(support.shape[1], support.shape[2], query.shape[2], len(support))
    return Episodes(support, query, np.zeros(support.shape[:2], np.int64), (), config)
