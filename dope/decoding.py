"""From the bytes of a sample's members to arrays. Pixel centres lie at +0.5 in images of every size."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from dope.tar_samples import REMAKE

REDUCED = {8: cv2.IMREAD_REDUCED_COLOR_8, 4: cv2.IMREAD_REDUCED_COLOR_4, 2: cv2.IMREAD_REDUCED_COLOR_2}
"""The shares of its size at which a JPEG can be decoded, at a fraction of the time."""
START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
END_OF_IMAGE = b"\xff\xd9"
NPY = re.compile(
    rb"\x93NUMPY\x01\0..\{'descr': '<f4', 'fortran_order': False, 'shape': \((\d+), 4\), \} *\n", re.DOTALL
)
"""The head of a .npy file (format 1.0) of N x 4 float32, as NumPy and the shards have it."""


@dataclass(frozen=True)
class DecodedPair:
    """One sample: images (3, S, S) uint8 RGB, masks (S, S) bool, points (N, 4) float32, its object's number and key."""

    images: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    masks: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    points: NDArray[np.float32]
    object: int
    key: str


def decode_pair(
    members: Mapping[str, bytes],
    number: int,
    key: str,
    *,
    images: NDArray[np.uint8],
    masks: NDArray[np.bool_],
    max_points: int,
    where: str,
) -> DecodedPair:
    """Decode the members of a pair sample; views of another size are resized and their points scaled.

    Args:
        members: `1.jpg`, `2.jpg`, `1.png`, `2.png` and `corr.npy`.
        number: of the object.
        images, masks: (2, 3, S, S) and (2, S, S), where the views are to be written.
        max_points: correspondences kept.
        where: the shard and the sample, for errors.

    Raises:
        BadInput: a member is missing or cannot be decoded.
    """
    scale = [*_image(members, "1.jpg", images[0], where), *_image(members, "2.jpg", images[1], where)]
    for view in (0, 1):
        _mask(members, f"{view + 1}.png", masks[view], where)
    points = decode_points(_member(members, "corr.npy", where), max_points, where)
    if scale != [1, 1, 1, 1]:
        points = points * np.array(scale, np.float32)
    return DecodedPair((images[0], images[1]), (masks[0], masks[1]), points, number, key)


def decode_view(members: Mapping[str, bytes], *, image: NDArray[np.uint8], mask: NDArray[np.bool_], where: str) -> None:
    """Decode the members `jpg` and `png` of a view sample into an image (3, S, S) uint8 RGB and a mask (S, S) bool.

    Raises:
        BadInput: a member is missing or cannot be decoded; `where` names the shard.
    """
    _image(members, "jpg", image, where)
    _mask(members, "png", mask, where)


def decode_jpeg(data: bytes, smallest: int) -> tuple[NDArray[np.uint8] | None, int]:
    """A JPEG no larger than needed, and by what it was reduced (1, 2, 4 or 8).

    The image (h, w, 3) is BGR, with both sides `smallest` or more where those of the whole are; None where it cannot be
    decoded. Only sizes that the reduction divides are reduced, so that x becomes exactly x / reduction.
    """
    height, width = jpeg_size(data)
    for reduction, flag in REDUCED.items():
        if min(height, width) >= reduction * smallest and height % reduction == width % reduction == 0:
            return _imdecode(data, flag), reduction
    return _imdecode(data, cv2.IMREAD_COLOR), 1


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Height and width in pixels that a JPEG's header gives; (0, 0) where it has none."""
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        if data[position + 1] in START_OF_FRAME:
            height, width = data[position + 5 : position + 7], data[position + 7 : position + 9]
            return int.from_bytes(height, "big"), int.from_bytes(width, "big")
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return 0, 0


def decode_points(data: bytes, max_points: int, where: str) -> NDArray[np.float32]:
    """The first rows of a .npy file of (N, 4) floats. Raises `BadInput` where it is anything else, or cut off."""
    head = NPY.match(data)
    if head and len(data) == head.end() + 16 * int(head[1]):  # NumPy's own reader takes some 50 times as long
        return np.frombuffer(data, "<f4", min(max_points, int(head[1])) * 4, head.end()).reshape(-1, 4)
    try:
        points = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception as error:  # its header is Python, which fails in as many ways, or asks for terabytes
        reason = str(error).split("\n", 1)[0]
        raise BadInput(f"corr.npy cannot be read ({reason})", where=where, remedy=REMAKE) from error
    if not isinstance(points, np.ndarray):
        raise BadInput("corr.npy is no array", where=where, remedy=REMAKE)
    if points.ndim != 2 or points.shape[1] != 4 or points.dtype.kind != "f":
        raise BadInput(f"corr.npy is {points.dtype} {points.shape}, not float32 (N, 4)", where=where, remedy=REMAKE)
    return points[:max_points].astype(np.float32)


def resized(image: NDArray[Any], size: int | None) -> NDArray[Any]:
    """The image as a square of `size` pixels, the same in training, evaluation and figures; as it is where None."""
    if size is None or image.shape[:2] == (size, size):
        return image
    shrinks = min(image.shape[:2]) >= size
    return cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _image(members: Mapping[str, bytes], name: str, out: NDArray[np.uint8], where: str) -> tuple[float, float]:
    """Write a JPEG into `out` (3, S, S) as RGB; return by what x and y of its points are multiplied."""
    size, data = out.shape[-1], _member(members, name, where)
    image, reduction = decode_jpeg(data, size)
    if image is None:
        raise BadInput(f"{name} cannot be decoded", where=where, remedy=REMAKE)
    if not data.rstrip(b"\0").endswith(END_OF_IMAGE):  # the decoder fills up with grey
        raise BadInput(f"{name} is cut off", where=where, remedy=REMAKE)
    height, width = (reduction * side for side in image.shape[:2])
    cv2.split(resized(image, size), list(out[::-1]))  # into these arrays, BGR to RGB
    return size / width, size / height


def _mask(members: Mapping[str, bytes], name: str, out: NDArray[np.bool_], where: str) -> None:
    mask = _imdecode(_member(members, name, where), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise BadInput(f"{name} cannot be decoded", where=where, remedy=REMAKE)
    np.greater(resized(mask, out.shape[-1]), 127, out=out)


def _member(members: Mapping[str, bytes], name: str, where: str) -> bytes:
    if name not in members:
        raise BadInput(f"has no {name}", where=where, remedy=REMAKE)
    return members[name]


def _imdecode(data: bytes, flags: int) -> NDArray[np.uint8] | None:
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None  # type: ignore[return-value]
    except cv2.error:  # e.g. a size beyond all limits
        return None
