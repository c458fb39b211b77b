"""Preparing the trees of `co3d_tree`."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

from pipeline.co3d.frames import Co3dFramesConfig
from pipeline.co3d.prepare import Co3dConfig, prepare_co3d
from pipeline.co3d.sources import Choice, find_co3d
from pipeline.stages import StageResult
from pipeline.tasks import RunOptions
from tests.pipeline.co3d_tree import Tree

NAME = "110_13051_23361"
ALL = Co3dConfig(frames=Co3dFramesConfig(every=1))


def prepare(
    tree: Tree, work: Path, config: Co3dConfig = ALL, choice: Choice = Choice(), **options: Any
) -> tuple[list[StageResult], list[StageResult], list[StageResult]]:
    """The rows of the stages, of what cannot be used and of what is left out."""
    sources, failed, left_out = find_co3d(tree.root, work, choice)
    rows = prepare_co3d(sources, work, config, RunOptions(**options))
    return rows, failed, left_out


def huge_png() -> bytes:
    """A whole PNG that claims 60,000 x 60,000 pixels: 10 GB once decoded."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
