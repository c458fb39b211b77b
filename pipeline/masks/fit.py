"""Masks of source images brought to the stored images' size, whichever of the two they were drawn on, and how it lay.

A tool that knows EXIF orientations draws a mask on the upright photo, one that does not on the pixels as they lie in
the file. Where turning swaps width and height, a mask's own size tells which; where it does not (the photo is
mirrored or upside down, orientations 2-4, or it is square), only who made the mask can say: the setting `lying`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.inputs.photos import read_orientation, turn_upright
from pipeline.masks.mask_io import listed
from pipeline.sequence import Frame

Mask = NDArray[np.bool_]
Lying = Literal["auto", "yes", "no"]

TURNED = (5, 6, 7, 8)
"""EXIF orientations that swap width and height."""


class MaskFit:
    """Brings the masks of one sequence to the stored size; remembers where it could not tell how they lie.

    Args:
        photos: the folder of the source's photos, whose EXIF orientation masks may have to be turned by.
        lying: do masks lie as the photos' pixels do in their files? "auto": where their size says so.
        on_stored: the masks were drawn on the stored images, which are upright.
    """

    def __init__(self, photos: Path, lying: Lying, *, on_stored: bool = False) -> None:
        self.photos, self.lying, self.on_stored = photos, lying, on_stored
        self._orientations: dict[str, int] = {}
        self._unclear: dict[str, None] = {}

    def canvas(self, frame: Frame) -> tuple[int, int]:
        """(width, height) of the image that masks were drawn on, as far as it is not said with them."""
        if self.on_stored:
            return frame.width, frame.height
        size = source_size(frame)
        return size[::-1] if self.lying == "yes" and self._orientation(frame) in TURNED else size

    def accepts(self, size: tuple[int, int], frame: Frame) -> bool:
        """Is (width, height) that of the stored or of the source image, upright or lying?"""
        sizes = (frame.width, frame.height), source_size(frame)
        return size in sizes or (size[::-1] in sizes and self.lying != "no" and not self.on_stored)

    def fit(self, mask: Mask, frame: Frame) -> Mask:
        """The mask upright and of the stored size. Raises `BadInput` (without a file's name) if its size is wrong."""
        stored, source = (frame.width, frame.height), source_size(frame)
        given = (mask.shape[1], mask.shape[0])
        if self._is_lying(given, frame):
            mask = turn_upright(mask, self._orientation(frame))
        size = (mask.shape[1], mask.shape[0])
        if size == stored:
            return mask
        if size != source:
            what = f"the mask is {given[0]}x{given[1]}, its image '{frame.source_name}' is {source[0]}x{source[1]}"
            raise BadInput(what, remedy="A mask has the size of its image")
        small = cv2.resize(mask.astype(np.float32), stored, interpolation=cv2.INTER_AREA)
        return np.asarray(small >= 0.5)

    def warnings(self) -> list[str]:
        """What a person should look at: masks that were taken to be upright because nothing says that they are not."""
        if not self._unclear:
            return []
        names = ", ".join(listed(list(self._unclear)))
        what = f"{len(self._unclear)} masks were taken to be upright, which their size cannot tell ({names})"
        return [f"{what}: lying=yes turns them by their photo's EXIF orientation, lying=no says that they are right"]

    def _is_lying(self, size: tuple[int, int], frame: Frame) -> bool:
        if self.lying != "auto" or self.on_stored:
            return self.lying == "yes" and not self.on_stored
        stored, source = (frame.width, frame.height), source_size(frame)
        if size not in (stored, source):
            return size[::-1] in (stored, source)
        orientation = self._orientation(frame)
        if orientation != 1 and (size[0] == size[1] or orientation not in TURNED):
            self._unclear[frame.source_name] = None
        return False

    def _orientation(self, frame: Frame) -> int:
        name = frame.source_name
        if name not in self._orientations:
            self._orientations[name] = read_orientation(self.photos / name)
        return self._orientations[name]


def source_size(frame: Frame) -> tuple[int, int]:
    """(width, height) of the source image, upright; of the stored one where that is not known."""
    return frame.source_width or frame.width, frame.source_height or frame.height
