"""The masks of a sequence checked across its views, and what becomes of those that disagree."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from pipeline.masks.mask_io import listed
from pipeline.masks.visual_hull import HullConfig, check_masks
from pipeline.sequence import Frame, Sequence


def check_across_views(sequence: Sequence, config: HullConfig, on_flag: Literal["keep", "drop"]) -> dict[str, Any]:
    """Compare the masks of the registered frames with their visual hull; note it in frames.parquet.

    Sets `mask_iou` and `mask_flag` of the frames. With "drop" a flagged frame loses its mask, and so makes no view; the
    file stays, and `forget_check` brings it back.

    Returns:
        {"hull_iou", "flagged"} with "flagged_frames" (names) where there are any and "hull_note" where nothing could
        be checked. `hull_iou` is the median of the masks that are not flagged, or None.
    """
    forget_check(sequence)
    frames = sequence.read_frames()
    there = [frame for frame in frames if frame.registered and frame.image is not None and frame.mask is not None]
    masks = [mask for frame in there if (mask := sequence.read_mask(frame)) is not None]
    normalised = sequence.read_info().unit != "arbitrary"
    details: dict[str, Any] = {"hull_iou": None, "flagged": 0}
    if not normalised:
        return details | {"hull_note": "masks not checked: the sequence has no cameras in the object's frame"}
    check = check_masks(masks, [frame.camera for frame in there], config)
    for frame, iou, flag in zip(there, check.iou, check.flags, strict=True):
        frame.mask_iou = round(float(iou), 4) if np.isfinite(iou) else None
        frame.mask_flag = flag
        if flag is not None and on_flag == "drop":
            frame.mask = None
    sequence.write_frames(frames)
    if np.isfinite(check.median):
        details["hull_iou"] = round(check.median, 4)
    flagged = [frame.source_name for frame in there if frame.mask_flag is not None]
    details["flagged"] = len(flagged)
    if flagged:
        details["flagged_frames"] = listed(flagged)
    if check.note is not None:
        details["hull_note"] = check.note
    return details


def was_checked(frames: list[Frame]) -> bool:
    """Has `check_across_views` left anything in these frames?"""
    return any(frame.mask_iou is not None or frame.mask_flag is not None for frame in frames)


def forget_check(sequence: Sequence) -> None:
    """Undo `check_across_views`: dropped masks are the frames' again."""
    frames = sequence.read_frames()
    if not was_checked(frames):
        return
    for frame in frames:
        name = f"masks/{frame.frame:06d}.png"
        if frame.mask_flag is not None and frame.mask is None and (sequence.folder / name).is_file():
            frame.mask = name
        frame.mask_iou = frame.mask_flag = None
    sequence.write_frames(frames)
