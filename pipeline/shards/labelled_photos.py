"""Labelled photos without cameras to shards of single views: for low-shot evaluation on any folder of pictures.

    PHOTOS/<category>/<object>/*.jpg                     or
    PHOTOS/<category>/<object>/images/*.jpg  with        PHOTOS/<category>/<object>/masks/*.png

There are no pairs in such shards: nothing can be learnt from them by methods that need two views.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common import files, settings
from dope.common.errors import BadInput
from pipeline.correspond.views import object_extent
from pipeline.engines import holding_output
from pipeline.inputs.photos import list_photos, natural_order, read_photo
from pipeline.masks.mask_io import read_mask_values
from pipeline.shards.dataset import FORMAT, check_folder, same_dataset, write_tables
from pipeline.shards.plan import even_parts
from pipeline.shards.writer import WrittenShard, to_json, write_tar

Progress = Callable[[int, int], None]
LARGEST = 4096
"""Long side in pixels that photos are decoded at, at most."""


@dataclass(frozen=True)
class PhotosConfig:
    """Settings of `dope prep photos`."""

    size: int = 224
    """Side of the square views in pixels."""
    crop: Literal["object", "whole"] = "object"
    """"object": the square around it, where there is a mask; "whole": the largest square in the middle."""
    margin: float = 0.1
    """Room around the object's bounding box, as a share of its longer side, on each side; less at the photo's edge."""
    threshold: float = 0.5
    """Values of a mask above it, in [0, 1], are the object."""
    jpeg_quality: int = 95
    """Quality of the views' JPEG files."""
    samples_per_shard: int = 1024
    """Most views in one tar."""

    def __post_init__(self) -> None:
        settings.require_at_least(self, size=16, margin=0, samples_per_shard=1)


@dataclass(frozen=True)
class LabelledPhoto:
    """A photo of an object of a category, its mask where there is one, and its number among the object's photos."""

    path: Path
    mask: Path | None
    category: str
    instance: str
    number: int


@dataclass(frozen=True)
class PhotoView:
    """One view, ready to be written (see `pipeline.shards.writer.Sample`)."""

    photo: LabelledPhoto
    jpg: bytes
    png: bytes
    mask_share: float

    def encode(self) -> tuple[dict[str, Any], dict[str, Any]]:
        photo = self.photo
        sequence = f"{photo.category}-{photo.instance}"
        key = f"{sequence}-{photo.number:06d}".replace(".", "_")  # a dot would end WebDataset's key
        named = {"sequence": sequence, "instance": photo.instance, "category": photo.category}
        facts = {**named, "frame": photo.number, "source": photo.path.name, "mask_share": self.mask_share}
        sample = {"__key__": key, "jpg": self.jpg, "png": self.png, "json": to_json(facts)}
        row = {"key": key, **named, "split": "train", "frame": photo.number, "mask_share": self.mask_share}
        return sample, row


def find_labelled_photos(folder: Path) -> list[LabelledPhoto]:
    """All photos of a tree of categories and objects, in order.

    Raises:
        BadInput: no such folder, or none in it.
    """
    if not folder.is_dir():
        raise BadInput("no such folder", where=folder, remedy="Give one that holds CATEGORY/OBJECT/photo.jpg")
    found: list[LabelledPhoto] = []
    for category in _folders(folder):
        for instance in _folders(category):
            images = instance / "images" if (instance / "images").is_dir() else instance
            masks = {path.stem: path for path in _files(instance / "masks")}
            for number, path in enumerate(list_photos(images)):
                found.append(LabelledPhoto(path, masks.get(path.stem), category.name, instance.name, number))
    if not found:
        remedy = "They must lie in CATEGORY/OBJECT/ or in CATEGORY/OBJECT/images/"
        raise BadInput("holds no labelled photos", where=folder, remedy=remedy)
    return found


def write_photos(
    folder: Path, out: Path, config: PhotosConfig, progress: Progress | None = None, *, overwrite: bool = False
) -> dict[str, Any]:
    """Cut a view out of every photo and pack them into `out`; the old contents of `out` stay until the new are whole.

    Returns:
        `views`, `categories`, `objects`, `without_mask` and `left_out` (path -> reason); "skipped": True where `out`
        already holds exactly this.

    Raises:
        BadInput: no photo can be used, or another process writes `out`.
        UsageError: `out` holds something that is not a dataset.
        DiskFull: no space left; what was in `out` is untouched.
    """
    check_folder(out.resolve())
    photos = find_labelled_photos(folder)
    stamps = [_stamp(path, folder) for photo in photos for path in (photo.path, photo.mask) if path is not None]
    facts = {"settings": settings.to_dict(config)}
    mark = settings.config_hash({"format": FORMAT, "photos": stamps, **facts})
    if not overwrite and (there := same_dataset(out, mark)):
        return {**there, "skipped": True}
    left_out: dict[str, str] = {}
    written: list[WrittenShard] = []
    done = 0

    def views(part: list[LabelledPhoto]) -> Iterator[PhotoView]:
        nonlocal done
        for photo in part:
            try:
                yield cut(photo, config)
            except BadInput as error:
                left_out[str(photo.path.relative_to(folder))] = error.what
            done += 1
            if progress:
                progress(done, len(photos))

    with holding_output(out), files.atomic_folder(out) as partial_out:
        for name, part in even_parts("views", len(photos), config.samples_per_shard):
            shard = write_tar(partial_out / name, "views", views(photos[part]), name)
            if len(shard.rows):
                written.append(shard)
            else:
                (partial_out / name).unlink()
        if not written:
            path, reason = next(iter(left_out.items()))
            raise BadInput(f"none of the {len(photos)} photos can be used; {path}: {reason}", where=folder)
        used = [photo for photo in photos if str(photo.path.relative_to(folder)) not in left_out]
        details = {
            "views": len(used),
            "categories": len({photo.category for photo in used}),
            "objects": len({(photo.category, photo.instance) for photo in used}),
            "without_mask": sum(photo.mask is None for photo in used),
            "left_out": left_out,
        }
        write_tables(partial_out, written, {"fingerprint": mark, "counts": details, **facts})
    return {**details, "skipped": False}


def cut(photo: LabelledPhoto, config: PhotosConfig) -> PhotoView:
    """The square view of a photo. Raises `BadInput` where photo or mask cannot be read or do not fit each other."""
    image = read_photo(photo.path, LARGEST).image
    height, width = image.shape[:2]
    mask: NDArray[np.bool_] | None = None
    if photo.mask is not None:
        values = read_mask_values(photo.mask)
        if values.shape[0] * width != values.shape[1] * height:
            what = f"its mask {photo.mask.name} is {values.shape[1]}x{values.shape[0]} px, it is {width}x{height}"
            raise BadInput(what, where=photo.path)
        if values.shape != (height, width):
            values = np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA), np.float32)
        mask = values > config.threshold
    x, y, side = _square(mask, width, height, config)
    how = cv2.INTER_AREA if side >= config.size else cv2.INTER_LINEAR
    resize = partial(cv2.resize, dsize=(config.size, config.size), interpolation=how)
    view = resize(_window(image, x, y, side, cv2.BORDER_REPLICATE))
    shown = np.ones((config.size, config.size), bool)
    if mask is not None:
        shown = resize(_window(mask.astype(np.uint8) * 255, x, y, side, cv2.BORDER_CONSTANT)) > 127
    quality = [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality]
    jpg = cv2.imencode(".jpg", view, quality)[1].tobytes()
    png = cv2.imencode(".png", shown.astype(np.uint8) * 255)[1].tobytes()
    return PhotoView(photo, jpg, png, float(shown.mean()))


def _square(mask: NDArray[np.bool_] | None, width: int, height: int, config: PhotosConfig) -> tuple[int, int, int]:
    """Left, top and side, whole pixels, of the square that is cut; within the photo where it can be."""
    extent = object_extent(mask) if mask is not None and config.crop == "object" else None
    if extent is None:
        side = min(width, height)
        return (width - side) // 2, (height - side) // 2, side
    low, high = extent.min(axis=0) - 0.5, extent.max(axis=0) + 0.5
    longest = float((high - low).max())
    side = round(max(longest, min(longest * (1 + 2 * config.margin), float(min(width, height)))))
    corner = (low + high - side) / 2
    room = np.maximum(0, np.array([width, height]) - side)
    x, y = np.clip(np.round(corner), 0, room).astype(int).tolist()
    return x, y, max(1, side)


def _window(image: NDArray[Any], x: int, y: int, side: int, border: int) -> NDArray[Any]:
    height, width = image.shape[:2]
    below, right = max(0, y + side - height), max(0, x + side - width)
    if below or right:
        image = cv2.copyMakeBorder(image, 0, below, 0, right, border)
    return image[y : y + side, x : x + side]


def _stamp(path: Path, folder: Path) -> list[str | int]:
    """What tells whether a file has changed."""
    stat = path.stat()
    return [str(path.relative_to(folder)), stat.st_size, stat.st_mtime_ns]


def _folders(folder: Path) -> list[Path]:
    return sorted((p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")), key=natural_order)


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")) if folder.is_dir() else []
