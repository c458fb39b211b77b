"""What the correspond stage notes in its marker of the tables it wrote, so that planning shards opens no table.

Opening two Parquet files of a sequence costs milliseconds, its marker is read anyway: that is minutes of 100,000.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.correspond.views import views_table
from pipeline.sequence import Sequence


@dataclass(frozen=True)
class Outline:
    """The frames of a sequence's views and pairs.

    Attributes:
        frames: (V,) int32 frame numbers of the views, ascending.
        pairs: (P, 2) int32 frame numbers of the pairs, in order of the rows of correspondences.parquet.
    """

    frames: NDArray[np.int32]
    pairs: NDArray[np.int32]


def outline_details(sequence: Sequence, views: pa.Table, pairs: pa.Table) -> dict[str, Any]:
    """The outline of tables as they lie on the disk now, as short text for the marker."""
    flat = np.stack([pairs["frame1"].to_numpy(), pairs["frame2"].to_numpy()], axis=1).ravel()
    return {
        "frames": " ".join(map(str, views["frame"].to_pylist())),
        "pairs": " ".join(map(str, flat.tolist())),
        "bytes": _sizes(sequence),
    }


def read_outline(sequence: Sequence, details: dict[str, Any]) -> Outline | None:
    """The outline in a marker's details; None where there is none or the files are not those that it was made of."""
    try:
        noted = details["outline"]
        frames = np.array(noted["frames"].split(), dtype=np.int32)
        pairs = np.array(noted["pairs"].split(), dtype=np.int32).reshape(-1, 2)
        with os.scandir(sequence.views) as entries:
            there = {entry.name for entry in entries}
        whole = noted["bytes"] == _sizes(sequence)
    except (KeyError, TypeError, ValueError, AttributeError, OSError):
        return None
    names = {f"{frame:06d}{suffix}" for frame in frames.tolist() for suffix in (".jpg", ".png")}
    return Outline(frames, pairs) if whole and names <= there else None


def _sizes(sequence: Sequence) -> list[int]:
    return [path.stat().st_size for path in (views_table(sequence), sequence.correspondences)]
