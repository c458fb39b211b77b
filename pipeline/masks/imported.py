"""Masks made by other tools brought into a prepared sequence: matched by name, checked, thresholded, resized.

They come as a folder of mask files, or as one file of results in COCO's format (`pipeline.masks.coco`).

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
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.inputs.photos import list_photos
from pipeline.masks.agreement import forget_check
from pipeline.masks.coco import picked_masks
from pipeline.masks.fit import Lying, MaskFit
from pipeline.masks.grabcut import GrabCutConfig
from pipeline.masks.image_names import Names
from pipeline.masks.mask_io import read_mask_values, write_masks
from pipeline.masks.pick import Pick
from pipeline.masks.visual_hull import HullConfig
from pipeline.sequence import Frame, Sequence


@dataclass(frozen=True)
class MasksConfig:
    """What counts as a mask, and how one is made where none is given."""

    threshold: float = 0.5
    """Object is above this share of the largest value that the mask's type can hold."""
    lying: Lying = "auto"
    """Do masks lie as the photos' pixels do before their EXIF orientation is applied? "auto": where their size says so,
    which it cannot for square photos and for those that are mirrored or upside down (`pipeline.masks.fit`)."""
    min_share: float = 0.0005
    """A mask with a smaller share of object pixels is empty."""
    pick: Pick = "consistent"
    """Which instance of a frame is the object, in results of a segmentation tool (`pipeline.masks.pick`)."""
    min_score: float = 0.0
    """Instances with a lower score are left out."""
    category_ids: tuple[int, ...] = ()
    """Only instances of these categories; none given = all."""
    category_names: tuple[str, ...] = ()
    """The same by name, where the results or the table of images name their categories."""
    instances: int = 20
    """At most so many instances of a frame, the best by score, are compared."""
    coco_images: str | None = None
    """Table of images for results that hold image ids only: a COCO dataset file, or {id: file name}."""
    names: Names = "auto"
    """Whose names the results' images have: the source's, or those in images/ (`pipeline.masks.image_names`)."""
    shared: bool = False
    """The results are those of several sequences: an image's folders must say whose it is."""
    on_flag: Literal["keep", "drop"] = "drop"
    """What happens to a mask that disagrees with the visual hull of the other views: it is only noted, or left out."""
    hull: HullConfig = field(default_factory=HullConfig)
    """How masks are checked against the other views."""
    grabcut: GrabCutConfig = field(default_factory=GrabCutConfig)
    """How the object is cut out where no masks are given."""


def import_masks(sequence: Sequence, place: Path, config: MasksConfig, *, cameras: bool = True) -> dict[str, Any]:
    """Write masks/ for the frames that have an image and note them in frames.parquet.

    Of a folder, a mask belongs to a photo `IMG_1.jpg` as `IMG_1.png` or `IMG_1.jpg.png`, to a video's frame by the last
    number in its name, the frame's number from 0 (`000123.png`, `frame_000123.png`). A file is taken for COCO results;
    `pipeline.masks.image_names` says which image is which frame. A mask has the size of the source image or of the
    stored one, and is upright, or lies as the photo's pixels do before its EXIF orientation is applied, as
    `config.lying` says.

    Args:
        place: a folder of mask files, or a file of results.
        cameras: may the frames' cameras help to pick an instance? Never for masks that come with the input: those are
            read before there are cameras, and must be the same when they are read again later.

    Returns:
        {"masks", "missing", "empty", "mean_share"}, with "missing_frames" and "empty_frames" (names) and "warnings"
        where there are any, and for results `picked_masks`' details. A frame without a mask has none in
        frames.parquet; an empty mask is written as it is.

    Raises:
        BadInput: no such place, a mask that cannot be read or has another size, no mask matches, all are empty.
            The masks that were there before are untouched then.
    """
    frames = sequence.read_frames()
    shown = [frame for frame in frames if frame.image is not None]
    more: dict[str, Any] = {}
    if place.is_file():
        more, masks, fit = picked_masks(sequence, shown, place, config, cameras=cameras)
        remedy = "Lower --min-score, or see --pick"
    elif place.is_dir():
        fit = MaskFit(Path(sequence.read_info().source), config.lying)
        masks = _folder_masks(sequence, shown, place, config, fit)
        remedy = "Object pixels are bright, the others black"
    else:
        raise BadInput("no such folder or file of masks", where=place)
    nothing = BadInput("all masks are empty", where=place, remedy=remedy)
    details = write_masks(sequence, frames, masks, min_share=config.min_share, nothing=nothing)
    warnings = [*more.pop("warnings", []), *fit.warnings()]
    return details | more | ({"warnings": warnings} if warnings else {})


def _folder_masks(
    sequence: Sequence, frames: list[Frame], folder: Path, config: MasksConfig, fit: MaskFit
) -> Iterator[tuple[Frame, NDArray[np.bool_]]]:
    """The masks of a folder, of the stored size."""
    by_number = sequence.read_info().kind == "video"
    found = _match(frames, folder, by_number=by_number)
    if not found:
        names = ", ".join(frame.source_name for frame in frames[:3])
        how = "the frame's number from 0, e.g. 000012.png" if by_number else "the photo's name, e.g. IMG_1.png"
        raise BadInput(f"no mask belongs to any frame ({names} ...)", where=folder, remedy=f"A mask's name is {how}")
    cutoff = config.threshold if _any_above(found.values(), config.threshold) else 0.0
    for frame in frames:
        if frame.frame in found:
            path = found[frame.frame]
            try:
                yield frame, fit.fit(read_mask_values(path) > cutoff, frame)
            except BadInput as error:
                raise BadInput(error.what, where=path, remedy=error.remedy) from error


def restore_input_masks(sequence: Sequence, place: Path | None, config: MasksConfig) -> None:
    """Put the masks that came with the input (a folder or file, or none) in the place of those that were made later.

    A new reconstruction starts from its input alone, so that it does not depend on what was run before.
    """
    forget_check(sequence)  # cameras must not depend on what other cameras made of the masks
    info = sequence.read_info()
    if not info.masks_are_later:
        return
    if place is not None:
        import_masks(sequence, place, config, cameras=False)
    else:
        frames = sequence.read_frames()
        for frame in frames:
            frame.mask = None
        sequence.write_frames(frames)
        shutil.rmtree(sequence.masks, ignore_errors=True)
    info.masks_from = None if place is None else "input"
    sequence.write_info(info)


def _match(frames: list[Frame], folder: Path, *, by_number: bool) -> dict[int, Path]:
    """Mask files of frames, by frame index. Raises `BadInput` where two files have the number of one frame."""
    named: dict[str, Path] = {}
    for path in list_photos(folder):
        # what COLMAP expects (a.jpg.png) and what most tools write (a.png); PNG wins over the lossy kinds
        if path.stem not in named or path.suffix.lower() == ".png":
            named[path.stem] = path
    if not by_number:
        pairs = ((frame, named.get(frame.source_name, named.get(Path(frame.source_name).stem))) for frame in frames)
        return {frame.frame: path for frame, path in pairs if path is not None}
    numbered: dict[int, Path] = {}
    for stem, path in named.items():
        if not (digits := re.findall(r"\d+", stem)):
            continue
        before = numbered.setdefault(int(digits[-1]), path)
        if before != path:
            raise BadInput(
                f"{before.name} and {path.name} are both masks of frame {int(digits[-1])}, by the last number in their "
                "names",
                where=folder,
                remedy="Put the frame's number last, and give one mask for each frame",
            )
    return {f.frame: numbered[int(f.source_name)] for f in frames if int(f.source_name) in numbered}


def _any_above(paths: Iterable[Path], threshold: float) -> bool:
    """Does any mask reach the threshold? The first nearly always does, so this seldom reads a second."""
    return any(float(read_mask_values(path).max(initial=0)) > threshold for path in paths)
