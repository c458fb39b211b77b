"""The first stage: frames of a video or folder chosen, judged and written as a prepared sequence."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from dope.common import files, settings
from dope.common.errors import BadInput, legible
from pipeline.inputs.frame_quality import Look, QualityConfig, look_at, neighbours_are_alike, reasons_to_drop, shrink
from pipeline.inputs.photos import list_photos, read_photo, unsupported_photos
from pipeline.inputs.sources import Source
from pipeline.inputs.videos import Video, Windows
from pipeline.masks.imported import MasksConfig, import_masks
from pipeline.sequence import Frame, Sequence, SequenceInfo, write_image


@dataclass(frozen=True)
class FramesConfig:
    """Which frames are taken and how they are stored."""

    every: int | None = None
    """Take one frame out of so many (the sharpest of each run of a video; each k-th photo)."""
    count: int | None = None
    """Take about so many frames, equally spaced; default 60 of a video, all photos. `every` goes first."""
    candidates: int = 5
    """Frames of a window that are compared for sharpness (video)."""
    long_side: int = 1024
    """Larger frames are shrunk to this many pixels on the long side; none is enlarged."""
    min_side: int = 64
    """Frames with a shorter side than this many pixels are dropped."""
    jpeg_quality: int = 95
    """Quality of the stored JPEG; a JPEG photo that keeps its size is copied byte for byte."""
    min_frames: int = 5
    """Fewer usable frames than this are an error."""
    ordered: Literal["auto", "yes", "no"] = "auto"
    """Are neighbouring photos neighbouring views? "auto" compares them. Videos always are."""
    quality: QualityConfig = field(default_factory=QualityConfig)
    """What makes a frame not worth keeping."""

    def __post_init__(self) -> None:
        settings.require_at_least(self, long_side=32, min_frames=1, candidates=1)


VIDEO_FRAMES = 60
"""Default number of frames of a video: steps of 6 degrees on one round about the object."""


@dataclass
class Taken:
    """A frame on its way to becoming a row: its row so far and what quality is judged by (None: nothing decoded)."""

    row: Frame
    look: Look | None = None


def extract_frames(
    source: Source, sequence: Sequence, config: FramesConfig, masks: MasksConfig | None = None
) -> dict[str, Any]:
    """Write images/, frames.parquet and sequence.json of a source, and masks/ where the source has masks.

    Frames that are not worth keeping have a row with the reason and no image. All images have one size.

    Returns:
        {"frames", "kept", "dropped": {reason: count}, "ordered", "width", "height", "warnings"}, with "masks"
        (see `import_masks`) where there are masks.

    Raises:
        BadInput: the source cannot be decoded, or fewer than `min_frames` frames are usable; the message says why.
            What was in the sequence before is untouched then.
    """
    warnings: list[str] = []
    with files.atomic_folder(sequence.images) as folder:
        if source.kind == "video":
            taken = list(_take_video(source.path, folder, config, warnings))
        else:
            taken = list(_take_photos(source.path, folder, config))
            if unsupported := unsupported_photos(source.path):
                warnings.append(_left_out(unsupported))
        _judge(taken, source, config)
        rows = [item.row for item in taken]
        kept = [row for row in rows if row.dropped is None]
        if len(kept) < config.min_frames:
            raise _too_few(rows, len(kept), source, config)
        for row in rows:
            if row.dropped is not None:
                row.image = None
                (folder / f"{row.frame:06d}.jpg").unlink(missing_ok=True)
    # Masks and cameras of the frames that were here before say nothing of the new ones.
    shutil.rmtree(sequence.masks, ignore_errors=True)
    sequence.write_frames(rows)
    looks = [item.look for item in taken if item.row.dropped is None and item.look is not None]
    ordered = _is_ordered(source, looks, config)
    info = SequenceInfo(source.id, str(source.path), source.kind, source.category, source.instance)
    info.ordered, info.n_frames = ordered, len(kept)
    info.masks_from = "input" if source.masks is not None else None
    sequence.write_info(info)
    reasons = Counter(_kind(row.dropped) for row in rows if row.dropped is not None)
    details: dict[str, Any] = {"frames": len(rows), "kept": len(kept), "dropped": dict(sorted(reasons.items()))}
    details |= {"ordered": ordered, "width": kept[0].width, "height": kept[0].height, "warnings": warnings}
    if source.masks is not None:
        read = before_cameras(source, masks or MasksConfig())
        details["masks"] = import_masks(sequence, source.masks, read, cameras=False)
        warnings += details["masks"].pop("warnings", [])
    return details


def before_cameras(source: Source, config: MasksConfig) -> MasksConfig:
    """How masks that come with the input are read: nothing has been stored yet that they could be named after."""
    names = "source" if config.names == "auto" else config.names
    return replace(config, names=names, shared=config.shared or source.masks_shared)


def _take_video(path: Path, folder: Path, config: FramesConfig, warnings: list[str]) -> Iterator[Taken]:
    video = Video(path)
    total = video.announced
    if config.every is None and not total:  # streams without an index do not know their length
        total = video.count()
    for _attempt in range(2):
        taken: list[Taken] = []
        for frame in video.sharpest(_windows(config, total)):
            index = len(taken)
            if frame.image is None:
                row = Frame(index, str(frame.number), 0, 0, frame.time_s, dropped="cannot be decoded")
                taken.append(Taken(row))
                continue
            image = shrink(frame.image, config.long_side)
            row = _row(index, str(frame.number), image.shape, (frame.image.shape[1], frame.image.shape[0]))
            row.time_s = frame.time_s
            write_image(folder / f"{index:06d}.jpg", image, jpeg_quality=config.jpeg_quality)
            taken.append(Taken(row, frame.look))
        if config.every is not None or video.decoded >= 0.9 * total or video.decoded == 0:
            break
        total = video.decoded  # far shorter than announced: take the wanted number from what is there
    if video.announced and video.decoded < video.announced - max(2, 0.02 * video.announced):
        warnings.append(f"{video.decoded} of {video.announced} announced frames could be decoded; used up to there")
    if not video.decoded:
        raise BadInput("no frame can be decoded", where=path, remedy="Copy it again or convert it to H.264 MP4")
    yield from taken


def _windows(config: FramesConfig, total: int) -> Windows:
    if config.every is not None:
        return Windows(max(1, config.every), config.candidates)
    return Windows(max(1.0, total / max(1, config.count or VIDEO_FRAMES)), config.candidates)


def _take_photos(path: Path, folder: Path, config: FramesConfig) -> Iterator[Taken]:
    photos = list_photos(path)
    step = float(max(1, config.every or 1))
    if config.every is None and config.count is not None:
        step = max(1.0, len(photos) / max(1, config.count))
    wanted = {int(i * step + step / 2) for i in range(len(photos))} if step > 1 else set(range(len(photos)))
    for index, photo_path in enumerate(photos):
        name = legible(photo_path.name)
        if index not in wanted or name != photo_path.name:
            reason = "not sampled" if index not in wanted else "its name is not UTF-8"
            yield Taken(Frame(index, name, 0, 0, dropped=reason))
            continue
        try:
            photo = read_photo(photo_path, config.long_side)
        except BadInput as error:
            yield Taken(Frame(index, name, 0, 0, dropped=error.what))
            continue
        row = _row(index, name, photo.image.shape, photo.source_size)
        row.focal_px_prior = photo.focal_px
        stored = folder / f"{index:06d}.jpg"
        if photo.jpeg is not None:
            files.write_bytes(stored, photo.jpeg)
        else:
            write_image(stored, photo.image, jpeg_quality=config.jpeg_quality)
        yield Taken(row, look_at(photo.image))


def _row(index: int, name: str, shape: tuple[int, ...], source_size: tuple[int, int]) -> Frame:
    row = Frame(index, name, width=shape[1], height=shape[0], image=f"images/{index:06d}.jpg")
    row.source_width, row.source_height = source_size
    return row


def _judge(taken: list[Taken], source: Source, config: FramesConfig) -> None:
    """Note in each row why it is dropped: another size than most, too small, then its quality."""
    sizes = Counter((t.row.source_width, t.row.source_height) for t in taken if t.look is not None)
    usual = max(sizes, key=lambda size: sizes[size]) if sizes else None
    for t in taken:
        row, size = t.row, (t.row.source_width, t.row.source_height)
        if t.look is None:
            continue
        row.sharpness = t.look.sharpness
        if size != usual and usual is not None:  # one camera is solved for all frames
            row.dropped = f"other size ({size[0]}x{size[1]}, most are {usual[0]}x{usual[1]})"
        elif min(row.width, row.height) < config.min_side:
            row.dropped = f"too small ({row.width}x{row.height})"
    judged = [(t.row, t.look) for t in taken if t.row.dropped is None and t.look is not None]
    looks, numbers = [look for _, look in judged], [row.frame for row, _ in judged]
    quality = config.quality
    compare: Literal["last", "all"] = "last"
    if source.kind != "video":
        quality, compare = replace(quality, blur_relative=quality.blur_relative_photos), "all"
    reasons = reasons_to_drop(looks, numbers, quality, compare=compare)
    for (row, _), reason in zip(judged, reasons, strict=True):
        row.dropped = reason


def _is_ordered(source: Source, looks: list[Look], config: FramesConfig) -> bool:
    if config.ordered != "auto":
        return config.ordered == "yes"
    return source.kind == "video" or neighbours_are_alike(looks)


def _left_out(unsupported: list[Path]) -> str:
    counts = Counter(path.suffix[1:].upper() for path in unsupported)
    listed = ", ".join(f"{count} {kind}" for kind, count in sorted(counts.items()))
    first = legible(unsupported[0].name)
    return f"{listed} files were left out ({first} ...): these kinds are not supported, convert them to JPEG"


def _too_few(rows: list[Frame], kept: int, source: Source, config: FramesConfig) -> BadInput:
    """The error that names what is wrong with most of the frames."""
    if not rows:
        return BadInput("holds no photos", where=source.path)
    reasons = Counter(_kind(row.dropped) for row in rows if row.dropped is not None)
    listed = ", ".join(f"{count} {kind}" for kind, count in reasons.most_common())
    total = f"{kept} of {len(rows)} frames are usable, {config.min_frames} are needed"
    more = "Film longer" if source.kind == "video" else "Take more photos"
    what, remedy = f"too few frames: {total}", f"{more}, or lower --set frames.min_frames={config.min_frames}"
    worst = reasons.most_common(1)[0][0] if reasons else ""
    if worst == "near-duplicate" and kept + reasons[worst] >= config.min_frames:
        what, remedy = f"the camera does not move: {total}", "Walk around the object, or turn it"
    elif worst == "no texture":
        what, remedy = f"the frames show nothing: {total}", "Is the lens covered, or the exposure wrong?"
    elif worst == "blurred":
        setting = "blur_relative" if source.kind == "video" else "blur_relative_photos"
        what, remedy = f"the frames are blurred: {total}", f"Move more slowly, or lower frames.quality.{setting}"
    elif worst == "other size":
        what, remedy = f"the photos have different sizes: {total}", "Give each size a folder of its own"
    elif worst == "not sampled":
        remedy = "Take more of the photos: a smaller --every, a larger --count"
    elif source.kind == "photos" and (unsupported := unsupported_photos(source.path)):
        remedy = _left_out(unsupported)
    return BadInput(f"{what} ({listed})" if listed else what, where=source.path, remedy=remedy)


def _kind(reason: str | None) -> str:
    """The kind of a reason, without the frame's own figures, for counting."""
    return re.split(r" of frame | \(", reason or "")[0]
