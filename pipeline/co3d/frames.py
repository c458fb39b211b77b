"""Stage `frames` of a CO3D sequence: images and masks written, and a row with a reason for what cannot be used."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common import files
from dope.common.errors import BadInput
from pipeline.co3d.annotations import FrameAnnotation
from pipeline.co3d.cameras import to_opencv
from pipeline.co3d.sources import Co3dSource
from pipeline.co3d.tree import Category
from pipeline.geometry import Camera
from pipeline.inputs.frame_quality import shrink
from pipeline.inputs.photos import decode, read_jpeg_header
from pipeline.masks.agreement import forget_check
from pipeline.masks.imported import MasksConfig, restore_input_masks
from pipeline.masks.mask_io import listed, read_mask_values, write_masks
from pipeline.sequence import Frame, Sequence, SequenceInfo, write_image

LICENCE = "CC BY-NC 4.0"


@dataclass(frozen=True)
class Co3dFramesConfig:
    """Which frames of a CO3D sequence are taken, and how they are stored."""

    every: int = 3
    """Take every k-th frame by frame number, from the sequence's first on."""
    long_side: int = 1024
    """Larger images are shrunk to this many pixels on the long side; none is enlarged."""
    min_side: int = 64
    """Frames with a shorter side than this many pixels are dropped."""
    jpeg_quality: int = 95
    """Quality of the stored JPEG; a JPEG that keeps its size is copied byte for byte."""
    min_frames: int = 5
    """Fewer usable frames than this are an error."""
    mask_threshold: float = 0.4
    """Object is above this share of the largest value that the mask's type can hold."""
    min_mask_share: float = 0.0005
    """A mask with a smaller share of object pixels is empty."""


def extract_frames(source: Co3dSource, sequence: Sequence, config: Co3dFramesConfig) -> dict[str, Any]:
    """Write images/, masks/, frames.parquet and sequence.json of a sequence; a dropped frame's row says why.

    Images of a sequence may differ in size: each frame has its own.

    Returns:
        {"frames", "kept", "dropped": {reason: count}, "ordered", "width", "height", "warnings"}, with "masks" and
        "bad_masks" (see `import_masks`) where there are any.

    Raises:
        BadInput: fewer than `min_frames` frames are usable; the message says why. What was in the sequence before is
            untouched then.
    """
    annotations = source.frames(config.every)
    with files.atomic_folder(sequence.images) as folder:
        rows = list(_rows(source.category, annotations, folder, config))
        kept = [row for row in rows if row.dropped is None]
        if len(kept) < config.min_frames:
            raise _too_few(source, rows, len(kept), config)
    shutil.rmtree(sequence.masks, ignore_errors=True)  # those of the frames that were here before
    sequence.write_frames(rows)
    info = SequenceInfo(source.id, str(source.path), "co3d", source.category.name, source.annotation.name, LICENCE)
    info.ordered, info.n_frames = True, len(kept)  # frames of a video, by number
    info.masks_from = "input" if any(annotations[row.frame].mask for row in kept) else None
    sequence.write_info(info)
    details: dict[str, Any] = {"frames": len(rows), "kept": len(kept), "dropped": _counted(rows)}
    details |= {"ordered": True, "width": kept[0].width, "height": kept[0].height, "warnings": []}
    if numbers := source.not_annotated:
        named = ", ".join(listed([str(number) for number in numbers]))
        details["warnings"].append(f"{len(numbers)} frames that the set lists name are not annotated: {named}")
    masks, bad = import_masks(source, sequence, config)
    if bad:
        given = sum(annotations[row.frame].mask is not None for row in kept)
        first = f"the mask of {rows[min(bad)].source_name} {bad[min(bad)]}"
        details["warnings"].append(f"{len(bad)} of {given} masks cannot be used: {first}")
        details["bad_masks"] = bad
    if masks is None:
        info.masks_from = None
        sequence.write_info(info)
    return details if masks is None else {**details, "masks": masks}


def annotated_camera(annotation: FrameAnnotation) -> Camera:
    """The camera of a frame in pixels of the size that the annotations give. Raises BadInput."""
    if annotation.viewpoint is None or annotation.width is None or annotation.height is None:
        raise BadInput(annotation.problem or "no viewpoint")
    try:
        return to_opencv(annotation.viewpoint, annotation.width, annotation.height)
    except ValueError as error:
        raise BadInput(str(error)) from error


def import_masks(
    source: Co3dSource, sequence: Sequence, config: Co3dFramesConfig
) -> tuple[dict[str, Any] | None, dict[int, str]]:
    """Write masks/ of the frames that have an image; a mask that cannot be used costs its frame only.

    Returns:
        What `write_masks` returns, None without masks; and by frame why its mask cannot be used.

    Raises:
        BadInput: all masks are empty.
    """
    annotations, frames = source.frames(config.every), sequence.read_frames()
    given = [(frame, path) for frame in frames if frame.image and (path := annotations[frame.frame].mask) is not None]
    bad: dict[int, str] = {}

    def masks() -> Iterator[tuple[Frame, NDArray[np.bool_]]]:
        for frame, path in given:
            try:
                yield frame, _mask(source.category, path, frame, config.mask_threshold)
            except BadInput as error:
                bad[frame.frame] = error.what

    nothing = BadInput("no mask can be used, or all are empty", where=source.path)
    details = None
    try:
        if given:
            details = write_masks(sequence, frames, masks(), min_share=config.min_mask_share, nothing=nothing)
    except BadInput:
        if len(bad) < len(given):  # then they are there, and empty
            raise
    return details, bad


def restore_masks(source: Co3dSource, sequence: Sequence, config: Co3dFramesConfig) -> None:
    """Put CO3D's masks in the place of those that were made later: cameras and depth depend on the input alone."""
    forget_check(sequence)
    if not sequence.read_info().masks_are_later:
        return
    masks, _ = import_masks(source, sequence, config)
    if masks is None:
        restore_input_masks(sequence, None, MasksConfig())
        return
    info = sequence.read_info()
    info.masks_from = "input"  # last: a run that is killed before does all of it again
    sequence.write_info(info)


def _rows(
    category: Category, annotations: list[FrameAnnotation], folder: Path, config: Co3dFramesConfig
) -> Iterator[Frame]:
    """A row for each frame; the images of those that are kept are written to `folder`."""
    seen: set[int] = set()
    names: set[str] = set()
    for index, annotation in enumerate(annotations):
        name = PurePosixPath(annotation.image or f"frame {annotation.number}").name
        row = Frame(index, name, 0, 0, annotation.timestamp)
        try:
            if annotation.number in seen:
                raise BadInput(f"the same frame number again (number {annotation.number})")
            seen.add(annotation.number)
            stem = PurePosixPath(name).stem
            if stem in names:  # cameras, masks and depths are matched by it
                raise BadInput(f"the same file name again ({name})")
            annotated_camera(annotation)
            _store(category, annotation, row, folder, config)
            names.add(stem)
        except BadInput as error:
            row.dropped = error.what
        yield row


def _store(category: Category, annotation: FrameAnnotation, row: Frame, folder: Path, config: Co3dFramesConfig) -> None:
    """Write the image of a frame and note its size and name in its row. Raises BadInput with why it is not usable."""
    data = read_inside(category, annotation.image, "image")
    try:
        # as the pixels lie in the file: CO3D's cameras are of these, whatever an EXIF orientation says
        image = np.asarray(decode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION), np.uint8)
    except BadInput as error:
        raise BadInput(f"image {error.what}") from error
    height, width = image.shape[:2]
    require_shape((width, height), (annotation.width or 0, annotation.height or 0), "image")
    stored = shrink(image, config.long_side)
    row.source_width, row.source_height = width, height
    row.width, row.height = stored.shape[1], stored.shape[0]
    if min(row.width, row.height) < config.min_side:
        raise BadInput(f"too small ({row.width}x{row.height})")
    row.image = f"images/{row.frame:06d}.jpg"
    path = folder / f"{row.frame:06d}.jpg"
    header = read_jpeg_header(data)
    if header is not None and header.orientation == 1 and header.components in (1, 3) and stored is image:
        files.write_bytes(path, data)
    else:
        write_image(path, stored, jpeg_quality=config.jpeg_quality)


def read_inside(category: Category, given: str | None, what: str) -> bytes:
    """The bytes of a file that the annotations name. Raises BadInput, in words that go on from `what`."""
    try:
        return category.resolve(given or "").read_bytes()
    except OSError as error:
        raise BadInput(f"{what} cannot be read ({error.strerror}: {given})") from error
    except BadInput as error:
        raise BadInput(f"{what} {error.what}") from error


def require_shape(size: tuple[int, int], wanted: tuple[int, int], what: str) -> None:
    """Refuse a (width, height) of another shape than is wanted. Intrinsics in NDC hold for any size of one shape."""
    if size == wanted:
        return
    factor = max(size) / max(wanted)
    if any(abs(a - b * factor) > max(1.0, factor) for a, b in zip(size, wanted, strict=True)):
        raise BadInput(f"{what} of another shape than annotated ({size[0]}x{size[1]}, not {wanted[0]}x{wanted[1]})")


def _mask(category: Category, given: str, frame: Frame, threshold: float) -> NDArray[np.bool_]:
    """The object in a frame, at the size of the stored image."""
    mask = read_mask_values(category.resolve(given)) > threshold
    size = (mask.shape[1], mask.shape[0])
    require_shape(size, (frame.source_width or frame.width, frame.source_height or frame.height), "is")
    if size == (frame.width, frame.height):
        return mask
    small = cv2.resize(mask.astype(np.float32), (frame.width, frame.height), interpolation=cv2.INTER_AREA)
    return np.asarray(small >= 0.5)


def _counted(rows: list[Frame]) -> dict[str, int]:
    """Dropped frames by the kind of the reason, without the frame's own names and figures."""
    kinds = Counter(re.split(r" \(", row.dropped)[0] for row in rows if row.dropped is not None)
    return dict(sorted(kinds.items()))


def _too_few(source: Co3dSource, rows: list[Frame], kept: int, config: Co3dFramesConfig) -> BadInput:
    listed = ", ".join(f"{count} {kind}" for kind, count in _counted(rows).items())
    what = f"too few frames: {kept} of {len(rows)} are usable, {config.min_frames} are needed"
    first = next((f"; {row.source_name}: {row.dropped}" for row in rows if row.dropped is not None), "")
    remedy = f"Take more frames with a smaller --every, or lower --set frames.min_frames={config.min_frames}"
    if rows and kept < len(rows):
        remedy = f"Is the download of {source.category.name} complete?"
    return BadInput(f"{what} ({listed}{first})" if listed else what, where=source.path, remedy=remedy)
