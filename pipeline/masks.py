"""Masks made by other tools brought into a prepared sequence: matched by name, checked, thresholded, resized.

What counts as object in a mask file, whatever its bit depth:

- one channel: the value; an alpha channel that is not the same everywhere: alpha; else the largest of the colours;
- object = value above `threshold` times the largest value the file's type can hold (255, 65535);
- label images, whose values are 0, 1, 2 ...: where no value in any of the masks reaches that, object = not zero.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput, UsageError
from pipeline.grabcut import GrabCutConfig
from pipeline.mask_io import read_mask_values, write_masks
from pipeline.photos import list_photos, read_jpeg_header, turn_upright
from pipeline.sequence import Frame, Sequence


@dataclass(frozen=True)
class MasksConfig:
    """What counts as a mask, and how one is made where none is given."""

    threshold: float = 0.5
    """Object is above this share of the largest value that the mask's type can hold."""
    min_share: float = 0.0005
    """A mask with a smaller share of object pixels is empty."""
    grabcut: GrabCutConfig = field(default_factory=GrabCutConfig)
    """How the object is cut out where no masks are given."""


def import_masks(sequence: Sequence, folder: Path, config: MasksConfig) -> dict[str, Any]:
    """Write masks/ for the frames that have an image and note them in frames.parquet.

    A mask belongs to a photo `IMG_1.jpg` as `IMG_1.png` or `IMG_1.jpg.png`, to a video's frame by the last number in
    its name, the frame's number from 0 (`000123.png`, `frame_000123.png`). It has the size of the source image
    or of the stored one, and is upright, or lies as the photo's pixels do before its EXIF orientation is applied.

    Returns:
        {"masks", "missing", "empty", "mean_share"}, with "missing_frames" and "empty_frames" (names) where there are
        any. A frame without a mask has none in frames.parquet; an empty mask is written as it is.

    Raises:
        BadInput: no such folder, a mask that cannot be read or has another size, no mask matches, all are empty.
            The masks that were there before are untouched then.
    """
    if not folder.is_dir():
        raise BadInput("no such folder of masks", where=folder)
    frames = sequence.read_frames()
    shown = [frame for frame in frames if frame.image is not None]
    info = sequence.read_info()
    by_number = info.kind == "video"
    found = _match(shown, folder, by_number=by_number)
    if not found:
        names = ", ".join(frame.source_name for frame in shown[:3])
        how = "the frame's number from 0, e.g. 000012.png" if by_number else "the photo's name, e.g. IMG_1.png"
        raise BadInput(f"no mask belongs to any frame ({names} ...)", where=folder, remedy=f"A mask's name is {how}")
    cutoff = config.threshold if _any_above(found.values(), config.threshold) else 0.0

    def fitted() -> Iterator[tuple[Frame, NDArray[np.bool_]]]:
        for frame in shown:
            if frame.frame in found:
                path = found[frame.frame]
                yield frame, _fitted(read_mask_values(path) > cutoff, frame, path, Path(info.source))

    nothing = BadInput("all masks are empty", where=folder, remedy="Object pixels are bright, the others black")
    return write_masks(sequence, frames, fitted(), min_share=config.min_share, nothing=nothing)


def restore_input_masks(sequence: Sequence, folder: Path | None, config: MasksConfig) -> None:
    """Put the masks that came with the input (`folder`, or none) in the place of those that were made later.

    A new reconstruction starts from its input alone, so that it does not depend on what was run before.
    """
    info = sequence.read_info()
    if not info.masks_are_later:
        return
    if folder is not None:
        import_masks(sequence, folder, config)
    else:
        frames = sequence.read_frames()
        for frame in frames:
            frame.mask = None
        sequence.write_frames(frames)
        shutil.rmtree(sequence.masks, ignore_errors=True)
    info.masks_from = None if folder is None else "input"
    sequence.write_info(info)


def find_mask_folders(given: str, ids: list[str]) -> dict[str, Path]:
    """The folder of masks of each sequence: `given`/<id>, or `given` itself where there is one sequence only.

    "{}" in `given` stands for the sequence's id. Sequences without a folder are left out.

    Raises:
        UsageError: not one of the sequences has a folder of masks.
    """
    if "{}" in given:
        folders = {name: Path(given.replace("{}", name)) for name in ids}
    elif len(ids) == 1 and not (Path(given) / ids[0]).is_dir():
        folders = {ids[0]: Path(given)}
    else:
        folders = {name: Path(given) / name for name in ids}
    there = {name: folder for name, folder in folders.items() if folder.is_dir()}
    if not there:
        expected = ", ".join(str(folder) for folder in list(folders.values())[:3])
        raise UsageError("holds no folder of masks for any sequence", where=given, remedy=f"Expected {expected}")
    return there


def _match(frames: list[Frame], folder: Path, *, by_number: bool) -> dict[int, Path]:
    """Mask files of frames, by frame index."""
    named: dict[str, Path] = {}
    for path in list_photos(folder):
        # what COLMAP expects (a.jpg.png) and what most tools write (a.png); PNG wins over the lossy kinds
        if path.stem not in named or path.suffix.lower() == ".png":
            named[path.stem] = path
    if not by_number:
        pairs = ((frame, named.get(frame.source_name, named.get(Path(frame.source_name).stem))) for frame in frames)
        return {frame.frame: path for frame, path in pairs if path is not None}
    numbered = {int(digits[-1]): path for stem, path in named.items() if (digits := re.findall(r"\d+", stem))}
    return {f.frame: numbered[int(f.source_name)] for f in frames if int(f.source_name) in numbered}


def _any_above(paths: Iterable[Path], threshold: float) -> bool:
    """Does any mask reach the threshold? The first nearly always does, so this seldom reads a second."""
    return any(float(read_mask_values(path).max(initial=0)) > threshold for path in paths)


def _fitted(mask: NDArray[np.bool_], frame: Frame, path: Path, photos: Path) -> NDArray[np.bool_]:
    """The mask at the size of the stored image."""
    stored, source = (frame.width, frame.height), (frame.source_width, frame.source_height)
    size = (mask.shape[1], mask.shape[0])
    if size not in (stored, source) and size[::-1] in (stored, source):
        mask = _upright(mask, photos / frame.source_name)
    if (mask.shape[1], mask.shape[0]) == stored:
        return mask
    if (mask.shape[1], mask.shape[0]) != source:
        raise BadInput(
            f"the mask is {size[0]}x{size[1]}, its image '{frame.source_name}' is {source[0]}x{source[1]}",
            where=path,
            remedy="A mask has the size of its image",
        )
    small = cv2.resize(mask.astype(np.float32), stored, interpolation=cv2.INTER_AREA)
    return np.asarray(small >= 0.5)


def _upright(mask: NDArray[np.bool_], photo: Path) -> NDArray[np.bool_]:
    """Turn a mask that was drawn on a photo's pixels as they lie in the file (annotation tools ignore EXIF)."""
    header = read_jpeg_header(photo.read_bytes()) if photo.is_file() else None
    return mask if header is None else turn_upright(mask, header.orientation)
