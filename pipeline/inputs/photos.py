"""Folders of photos: which files are photos, in which order, and each decoded upright at the size that is wanted."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.inputs.exif import Exif, read_exif
from pipeline.inputs.frame_quality import shrink
from pipeline.inputs.image_size import PNG_MAGIC, refuse_huge

PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})
UNSUPPORTED_PHOTOS = frozenset({".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".gif"})
EXIF_WITHIN = 1 << 20
"""Bytes at a JPEG's start that hold its EXIF block: it is one of the first segments, each of 64 KiB at most."""


@dataclass(frozen=True)
class Photo:
    """A decoded photo.

    Attributes:
        image: BGR, (height, width, 3), upright, long side at most what was asked for.
        source_size: (width, height) of the upright photo before resizing.
        jpeg: the file's own bytes where they can be stored as they are (a JPEG that is upright and small enough).
        focal_px: focal length by the photo's EXIF, pixels of `image`; None where it says nothing.
    """

    image: NDArray[np.uint8]
    source_size: tuple[int, int]
    jpeg: bytes | None
    focal_px: float | None = None


def natural_order(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key by which `photo2` comes before `photo10`."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part], path.name


def list_photos(folder: Path) -> list[Path]:
    """The photos of a folder in natural order of their names; hidden files and other files are not photos."""
    names = (path for path in folder.iterdir() if path.suffix.lower() in PHOTO_SUFFIXES)
    return sorted((path for path in names if not path.name.startswith(".") and path.is_file()), key=natural_order)


def unsupported_photos(folder: Path) -> list[Path]:
    """Files of a folder that are photos of a kind that cannot be read, in natural order.

    A raw file that has a readable photo of the same name beside it, as cameras write them in pairs, is not among them.
    """
    twins = {path.stem for path in list_photos(folder)}
    paths = (path for path in folder.iterdir() if path.suffix.lower() in UNSUPPORTED_PHOTOS)
    lost = (path for path in paths if not path.name.startswith(".") and path.stem not in twins and path.is_file())
    return sorted(lost, key=natural_order)


def read_photo(path: Path, long_side: int) -> Photo:
    """Decode a photo upright (EXIF orientation) with its long side at most `long_side` px, never enlarged.

    Raises:
        BadInput: the file cannot be read, is cut off or is not an image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
    header = read_jpeg_header(data)
    factor = 1
    if header is not None:
        # The decoder can skip most of the work for photos much larger than wanted. It rounds up the size, so the
        # aspect ratio (and with it the intrinsics) stays exact only where the factor divides both sides.
        for candidate in (8, 4, 2):
            whole = header.width % candidate == 0 and header.height % candidate == 0
            if whole and max(header.width, header.height) // candidate >= long_side * 1.5:
                factor = candidate
                break
    flags = {1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2}
    flags |= {4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8}
    try:
        image = decode(data, flags[factor])
    except BadInput as error:
        raise BadInput(error.what, where=path, remedy=error.remedy) from error
    height, width = image.shape[:2]
    upright_image = np.asarray(image, dtype=np.uint8)
    resized = shrink(upright_image, long_side)
    upright = header is not None and header.orientation == 1 and header.components in (1, 3)
    as_it_is = upright and factor == 1 and resized is upright_image
    focal = None if header is None else header.exif.focal_px(resized.shape[1], resized.shape[0])
    return Photo(resized, (width * factor, height * factor), data if as_it_is else None, focal)


def read_orientation(path: Path) -> int:
    """How a photo must be turned to be upright: its EXIF orientation 1-8; 1 too where there is no such JPEG."""
    if not path.is_file():
        return 1
    with path.open("rb") as file:
        header = read_jpeg_header(file.read(EXIF_WITHIN))
    return 1 if header is None else header.orientation


def decode(data: bytes, flags: int) -> NDArray[Any]:
    """Decode an image from memory with OpenCV's `flags`. Raises `BadInput` (without a file's name).

    JPEGs and PNGs that are cut off are refused: some versions of the decoders fill the rest with grey or black. So is
    what claims to be huge (`refuse_huge`).
    """
    refuse_huge(data)
    header = read_jpeg_header(data)
    if (header is not None and not header.complete) or (data.startswith(PNG_MAGIC) and b"IEND" not in data):
        raise BadInput("is cut off (it has no end marker)", remedy="Copy the file again")
    try:
        image = cv2.imdecode(np.frombuffer(_without_png_profile(data), np.uint8), flags) if data else None
    except cv2.error as error:
        raise BadInput(f"cannot be decoded ({error.err})") from error
    if image is None:
        raise BadInput("is not an image that can be decoded")
    return image


def turn_upright(image: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Turn pixels (height, width, ...) as they lie in a file upright, by the EXIF orientation 1-8."""
    if orientation in (5, 6, 7, 8):
        image = image.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return np.ascontiguousarray(image)


def _without_png_profile(data: bytes) -> bytes:
    """Leave out a PNG's colour profile: it changes no value, and libpng prints a line for each it does not like."""
    if not data.startswith(PNG_MAGIC):
        return data
    position = 8
    while position + 12 <= len(data):
        kind, end = data[position + 4 : position + 8], position + 12 + int.from_bytes(data[position : position + 4])
        if kind == b"iCCP":
            return data[:position] + data[end:]
        if kind == b"IDAT":  # a profile lies before the image data
            break
        position = end
    return data


@dataclass(frozen=True)
class JpegHeader:
    """What the markers of a JPEG say: stored size, components, if its end is there, and its EXIF. Decoders accept a
    file that is cut off and fill the rest with grey."""

    width: int
    height: int
    components: int
    complete: bool
    exif: Exif = field(default_factory=Exif)

    @property
    def orientation(self) -> int:
        """How the photo must be turned to be upright, 1-8; 1 = not at all."""
        return self.exif.orientation


def read_jpeg_header(data: bytes) -> JpegHeader | None:
    """Walk over the markers of a JPEG up to its image data; None for anything else. A broken header is "cut off"."""
    if data[:2] != b"\xff\xd8":
        return None
    width = height = components = 0
    exif, position = Exif(), 2
    while position + 4 <= len(data):
        marker, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4], "big")
        if data[position] != 0xFF:
            break
        if marker == 0xFF:  # a fill byte before a marker
            position += 1
            continue
        segment = data[position + 4 : position + 2 + length]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and len(segment) >= 6:
            height, width, components = struct.unpack(">HHB", segment[1:6])
        elif marker == 0xE1 and segment.startswith(b"Exif\0\0"):
            exif = read_exif(segment[6:])
        elif marker == 0xDA:
            # in image data 0xFF is followed by 0x00 or a restart marker, so this is the end of the image itself,
            # not of a thumbnail (those lie before), whatever a phone appended after it
            end = data.find(b"\xff\xd9", position + 2 + length)
            return JpegHeader(width, height, components, complete=end >= 0, exif=exif)
        position += 2 + length
    return JpegHeader(width, height, components, complete=False, exif=exif)
