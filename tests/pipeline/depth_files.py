"""Depth maps as files of every kind, for the tests of what reads them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest


def write_png(path: Path, depth: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(".png", np.rint(np.nan_to_num(depth) * 1000).astype(np.uint16))[1].tobytes())


def write_tiff(path: Path, depth: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(".tiff", depth.astype(np.float32))[1].tobytes())


def write_exr(path: Path, depth: np.ndarray, channel: str = "Z") -> None:
    exr = pytest.importorskip("OpenEXR")
    with exr.File({"type": exr.scanlineimage}, {channel: depth.astype(np.float32)}) as file:
        file.write(str(path))


def write_bin(path: Path, depth: np.ndarray) -> None:
    height, width = depth.shape
    path.write_bytes(f"{width}&{height}&1&".encode() + depth.astype("<f4").tobytes())


WRITERS: dict[str, Callable[[Path, np.ndarray], None]] = {
    ".png": write_png,
    ".tiff": write_tiff,
    ".exr": write_exr,
    ".npy": np.save,
    ".npz": lambda path, depth: np.savez_compressed(path, depth=depth.astype(np.float16)),
    ".jpg.geometric.bin": write_bin,
}


def write_all(folder: Path, depths: list[np.ndarray], suffix: str = ".npy") -> Path:
    folder.mkdir(exist_ok=True)
    for i, depth in enumerate(depths):
        WRITERS[suffix](folder / f"{i:04d}{suffix}", depth)
    return folder
