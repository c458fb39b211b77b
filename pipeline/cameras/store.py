"""What the `sfm` stage leaves in a sequence, wherever the cameras come from: sparse/, frames.parquet, sequence.json."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dope.common.files import TEMPORARY, atomic_folder, explaining_full_disk
from pipeline.cameras import colmap
from pipeline.sequence import Frame, Sequence


def store_model(
    sequence: Sequence,
    frames: list[Frame],
    attempts: list[dict[str, Any]],
    model: colmap.Model | None,
    scale: float | None = None,
) -> None:
    """Write a model, frames and info; without a model, forget the one that was there."""
    for frame in frames:
        frame.clear_camera()
    cameras = model.cameras() if model else {}
    if model is None:
        shutil.rmtree(sequence.sparse, ignore_errors=True)
    else:
        with atomic_folder(sequence.sparse) as partial:
            model.write(partial)
    by_number = {frame.frame: frame for frame in frames}
    for number, camera in cameras.items():
        by_number[number].set_camera(camera)
    sequence.write_frames(frames)
    info = sequence.read_info()
    info.attempts, info.n_registered = attempts, len(cameras)
    info.registered_share = round(len(cameras) / max(1, attempts[0]["n_frames"]), 4)
    info.unit = "object radius" if model else "arbitrary"
    info.input_scale = scale
    sequence.write_info(info)


@contextmanager
def scratch_folder(sequence: Sequence) -> Iterator[Path]:
    """A folder beside the sequence's files for databases; what a killed run left there goes first."""
    folder = sequence.folder / f".sfm{TEMPORARY}"
    shutil.rmtree(folder, ignore_errors=True)
    with explaining_full_disk(sequence.folder):
        folder.mkdir(parents=True)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def mask_folder(sequence: Sequence, used: list[Frame], scratch: Path) -> Path:
    """Masks under the names that COLMAP looks for: that of `a.jpg` is `a.jpg.png`."""
    folder = scratch / "masks"
    folder.mkdir(exist_ok=True)
    for frame in used:
        link = folder / f"{Path(str(frame.image)).name}.png"
        if frame.mask is not None and not link.exists():
            link.symlink_to((sequence.folder / frame.mask).resolve())
    return folder
