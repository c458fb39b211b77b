"""What a camera wrote about a photo into its EXIF block: how it was held, and the focal length."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

FILM_DIAGONAL_MM = math.hypot(36, 24)
"""A 35 mm equivalent is the focal length that has the same diagonal angle of view on 35 mm film (CIPA DCG-001)."""

ORIENTATION, EXIF_IFD, FOCAL_LENGTH, FOCAL_LENGTH_35MM = 0x0112, 0x8769, 0x920A, 0xA405
PIXEL_WIDTH, PIXEL_HEIGHT, FOCAL_PLANE_X, FOCAL_PLANE_UNIT = 0xA002, 0xA003, 0xA20E, 0xA210

FORMATS = {1: "B", 3: "H", 4: "I", 5: "II", 9: "i", 10: "ii"}
"""struct's codes of the TIFF field types that are read: byte, short, long, rational, and the last two signed."""
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""Of FocalPlaneResolutionUnit: inch, centimetre, millimetre, micrometre."""


@dataclass(frozen=True)
class Exif:
    """The fields of an EXIF block that matter here; what is absent or nonsense is None.

    Attributes:
        orientation: 1-8, 1 = upright.
        focal_35mm: focal length in millimetres on 35 mm film.
        focal_mm: the lens's own focal length in millimetres.
        pixels_per_mm: of the sensor, along the longer side of the photo as it was taken.
        long_side: pixels of that side, as it was taken.
    """

    orientation: int = 1
    focal_35mm: float | None = None
    focal_mm: float | None = None
    pixels_per_mm: float | None = None
    long_side: float | None = None

    def focal_px(self, width: int, height: int) -> float | None:
        """The focal length in pixels of the whole photo at any size, or None where EXIF does not tell."""
        if self.focal_35mm is not None:
            return focal_from_35mm(self.focal_35mm, width, height)
        if self.focal_mm is None or self.pixels_per_mm is None:
            return None
        # the sensor's figures are of the photo as taken; programs that shrink photos leave them as they are
        focal = self.focal_mm * self.pixels_per_mm * max(width, height) / (self.long_side or max(width, height))
        return focal if _sensible(focal, width, height) else None


def focal_from_35mm(focal_mm: float, width: int, height: int) -> float | None:
    """Pixels of a 35 mm equivalent focal length on a photo of this size; None where no lens is like that."""
    focal = focal_mm / FILM_DIAGONAL_MM * math.hypot(width, height)
    return focal if _sensible(focal, width, height) else None


def _sensible(focal_px: float, width: int, height: int) -> bool:
    """Between a fisheye and a telescope."""
    return 0.2 < focal_px / max(width, height) < 50


def read_exif(tiff: bytes) -> Exif:
    """Read an EXIF block (what follows "Exif" and two zeros). Damage makes fields absent, never an error."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None or len(tiff) < 8:
        return Exif()
    tags = _read_ifd(tiff, struct.unpack_from(order + "I", tiff, 4)[0], order)
    if EXIF_IFD in tags:
        tags = {**_read_ifd(tiff, int(tags[EXIF_IFD]), order), **tags}
    orientation = int(tags.get(ORIENTATION, 1))
    per_unit, unit = _positive(tags, FOCAL_PLANE_X), MM_PER_UNIT.get(int(tags.get(FOCAL_PLANE_UNIT, 2)))
    return Exif(
        orientation if 1 <= orientation <= 8 else 1,
        focal_35mm=_positive(tags, FOCAL_LENGTH_35MM),
        focal_mm=_positive(tags, FOCAL_LENGTH),
        pixels_per_mm=None if per_unit is None or unit is None else per_unit / unit,
        long_side=max(filter(None, (_positive(tags, PIXEL_WIDTH), _positive(tags, PIXEL_HEIGHT))), default=None),
    )


def _read_ifd(tiff: bytes, offset: int, order: str) -> dict[int, float]:
    """Numbers of a directory by tag; texts and arrays are left out."""
    tags: dict[int, float] = {}
    if not 0 <= offset <= len(tiff) - 2:
        return tags
    (count,) = struct.unpack_from(order + "H", tiff, offset)
    for entry in range(offset + 2, min(offset + 2 + 12 * count, len(tiff) - 11), 12):
        tag, kind, n = struct.unpack_from(order + "HHI", tiff, entry)
        code = FORMATS.get(kind)
        if code is None or n != 1:
            continue
        size = struct.calcsize(order + code)
        at = entry + 8 if size <= 4 else struct.unpack_from(order + "I", tiff, entry + 8)[0]
        if at + size <= len(tiff):
            tags.setdefault(tag, _number(struct.unpack_from(order + code, tiff, at)))
    return tags


def _number(values: tuple[Any, ...]) -> float:
    """A whole number, or a fraction (0 where it has no denominator: EXIF's "unknown")."""
    if len(values) == 1:
        return float(values[0])
    return values[0] / values[1] if values[1] else 0.0


def _positive(tags: dict[int, float], tag: int) -> float | None:
    value = tags.get(tag, 0.0)
    return value if value > 0 else None
