"""Mask files: read whatever tools write, write what a prepared sequence holds, and say what was written."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common import files
from dope.common.errors import BadInput
from pipeline.inputs.photos import decode
from pipeline.sequence import Frame, Sequence, write_image

LISTED = 10
"""Names listed in the details before only the count is given."""


def read_mask_values(path: Path) -> NDArray[np.float32]:
    """A mask file's values (height, width) in [0, 1]: value / largest value of its type (`pipeline.masks.imported`).

    Raises:
        BadInput: the file cannot be read or decoded.
    """
    try:
        image = decode(path.read_bytes(), cv2.IMREAD_UNCHANGED)
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
    except BadInput as error:
        raise BadInput(error.what, where=path, remedy=error.remedy) from error
    largest = np.iinfo(image.dtype).max if np.issubdtype(image.dtype, np.integer) else 1.0
    if image.ndim == 3:
        alpha = image[..., -1] if image.shape[2] in (2, 4) else None
        informative = alpha is not None and alpha.min() != alpha.max()
        colours = image[..., :-1] if alpha is not None else image
        image = alpha if alpha is not None and informative else colours.max(axis=2)
    return (image / np.float32(largest)).astype(np.float32)


def write_masks(
    sequence: Sequence,
    frames: list[Frame],
    masks: Iterable[tuple[Frame, NDArray[np.bool_]]],
    *,
    min_share: float,
    nothing: BadInput,
) -> dict[str, Any]:
    """Replace the masks of a sequence, all or none, and note them in frames.parquet.

    Args:
        frames: all rows of the sequence.
        masks: (frame, mask of the stored image's size); frames that do not occur are left without a mask.
        min_share: masks with a smaller share of object pixels count as empty.
        nothing: raised where all masks are empty.

    Returns:
        {"masks", "missing", "empty", "mean_share"} with "missing_frames" and "empty_frames" where there are any.
    """
    shares: list[float] = []
    empty: list[str] = []
    names: dict[int, str] = {}
    with files.atomic_folder(sequence.masks) as partial:
        for frame, mask in masks:
            name = f"{frame.frame:06d}.png"
            write_image(partial / name, mask.astype(np.uint8) * 255)
            names[frame.frame] = f"masks/{name}"
            shares.append(float(mask.mean()))
            if shares[-1] < min_share:
                empty.append(frame.source_name)
        if len(empty) == len(shares):
            raise nothing
    for frame in frames:
        frame.mask = names.get(frame.frame)
        frame.mask_iou = frame.mask_flag = None
    sequence.write_frames(frames)
    missing = [frame.source_name for frame in frames if frame.image is not None and frame.mask is None]
    share = round(float(np.mean(shares)), 4)
    details: dict[str, Any] = {"masks": len(shares), "missing": len(missing), "empty": len(empty), "mean_share": share}
    for key, frame_names in (("missing_frames", missing), ("empty_frames", empty)):
        if frame_names:
            details[key] = listed(frame_names)
    return details


def listed(names: list[str]) -> list[str]:
    """The first names, and how many more there are."""
    return names[:LISTED] + ([f"... {len(names) - LISTED} more"] if len(names) > LISTED else [])
