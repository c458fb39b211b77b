"""Which sequences a command line means: video files, folders of photos, and folders of either, an id for each.

car.mp4                     one sequence
fox/0001.jpg ...            one sequence (a folder of photos)
fox/images/ + fox/masks/    one sequence named `fox`: a folder that holds `images` with photos is one capture
videos/*.mov                one sequence a video
<category>/<instance>.mp4   any depth of folders above videos and captures

A folder of videos or photos is searched further below, too: of captures/cover.jpg and captures/a/1.jpg ... become two
sequences, `captures` and `a`. What lies beside `images` is not, nor are folders of masks and depth maps (`NOT_PHOTOS`,
and beside photos and videos those that are given).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from dope.common import files
from dope.common.errors import BadInput, UsageError, legible
from pipeline.inputs.photos import PHOTO_SUFFIXES, UNSUPPORTED_PHOTOS, list_photos, natural_order, unsupported_photos
from pipeline.inputs.unique_ids import name_of, with_unique_ids
from pipeline.refused import refused
from pipeline.sequence import find_sequences
from pipeline.stages import StageResult

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v"})
NOT_PHOTOS = frozenset({"mask", "masks", "depth", "depths", "segmentation", "segmentations"})
"""Folder names that lie beside photos and videos and are never taken for a capture unless they are named."""


@dataclass(frozen=True)
class Source:
    """One raw input: a video file, or a folder of photos.

    Attributes:
        path: the video, or the folder that holds the photos themselves.
        id: name of the sequence, unique among the sources of one command.
        kind: "video" or "photos".
        category: the class label, or None; carried for evaluation only.
        instance: name of the object.
        masks: folder of masks made by other tools, or a file of results of a segmentation tool, or None.
        masks_shared: that file is there for other sources, too.
        cameras: cameras found by other tools (`pipeline.cameras.known`), or None.
        depths: folder of depth maps made by other tools (`pipeline.depth.imported`), or None.
    """

    path: Path
    id: str
    kind: Literal["video", "photos"]
    category: str | None = None
    instance: str | None = None
    masks: Path | None = None
    cameras: Path | None = None
    depths: Path | None = None
    masks_shared: bool = False

    @property
    def home(self) -> Path:
        """What the sequence is named after: the video, or the capture's folder (not its `images`)."""
        inner = self.kind == "photos" and self.path.name == "images"
        return self.path.parent if inner and self.path.absolute().parent.name else self.path


SourceError = tuple[str, Path, BadInput]


def find_sources(
    inputs: Iterable[Path],
    *,
    category: str | None = None,
    category_from: str = "none",
    masks: str | None = None,
    cameras: str | None = None,
    depths: str | None = None,
    masks_later: str | None = None,
    known: Mapping[Path, str] | None = None,
) -> tuple[list[Source], list[SourceError]]:
    """The sequences that the paths on a command line stand for, and a row for each path that stands for none.

    Args:
        inputs: videos, folders of photos, or folders of those; order is kept, folders are read in natural order.
        category: label of all sources.
        category_from: "parent" takes the name of the folder above the video or capture where `category` is None.
        masks: folder of masks, or a file of results (for several, `masks`/<id>.json or one for all of them). For one
            source it is the folder itself, for several `masks`/<id>; a "{}" in it
            stands for the capture's folder or the video's path without its suffix (`{}/masks`, `{}_masks`).
        cameras: the same for cameras to reuse: a file, or a COLMAP model's folder.
        depths: the same for folders of depth maps.
        masks_later: masks that are imported after reconstruction: no capture where they lie beside photos.
        known: ids of the sources that WORK holds already (`known_sources`): they keep them, whatever else is given.

    Returns:
        Sources with unique ids (the parent's name is prefixed where two are the same), and (id, path, error) rows: of
        inputs, and of folders below them, that cannot be used.
    """
    if category_from not in ("none", "parent"):
        raise UsageError(f"'{category_from}' is not one of none, parent", where="--category-from")
    found: list[Source] = []
    errors: list[SourceError] = []
    seen: set[Path] = set()
    patterns = {name: given for name, given in (("masks", masks), ("cameras", cameras), ("depths", depths)) if given}
    pictures = [given for given in (masks, depths, masks_later) if given]
    for path in inputs:
        for source in _sources_or_error(path, set(), pictures, top=True):
            if not isinstance(source, Source):
                errors.append(source)
                continue
            place = source.path.resolve()
            if place in seen:  # the same video given twice is one sequence
                continue
            seen.add(place)
            if legible(source.path.absolute()) == str(source.path.absolute()):
                found.append(source)
            else:
                unwritable = BadInput("its name is not UTF-8", where=source.path, remedy="Rename it")
                errors.append((source.id, source.path, unwritable))
    found = [_labelled(source, category, category_from) for source in with_unique_ids(found, known or {})]
    kept: list[Source] = []
    for source in found:
        try:
            several = len(found) > 1
            beside: dict[str, Any] = {name: _beside(source, name, p, several) for name, p in patterns.items()}
        except BadInput as error:
            errors.append((source.id, source.path, error))
        else:
            shared = several and masks is not None and beside["masks"] == Path(masks) and beside["masks"].is_file()
            kept.append(replace(source, **beside, masks_shared=shared))
    return kept, errors


def known_sources(work: Path) -> dict[Path, str]:
    """The sources of the sequences that WORK holds, where they still are, with their ids.

    A source that has moved is not listed: under its old name it is still the same sequence.
    """
    known: dict[Path, str] = {}
    for sequence in find_sequences(work) if work.is_dir() else ():
        try:
            source = Path(sequence.read_info().source)
        except BadInput:
            continue  # a damaged sequence.json is written anew
        if source.exists():
            known[source.resolve()] = sequence.id
    return known


def input_errors_as_rows(errors: Iterable[SourceError]) -> list[StageResult]:
    """Inputs that cannot be used, as failed rows of the first stage."""
    return [refused(name, "frames", str(error)) for name, _path, error in errors]


def source_fingerprint(source: Source) -> dict[str, Any]:
    """Identifies the content of a source (masks too) by names, sizes and samples of the bytes; JSON values.

    It does not depend on where the source lies. Raises `BadInput` where a file has gone.
    """
    value: dict[str, Any] = {"kind": source.kind, "id": source.id, "category": source.category}
    try:
        if source.kind == "video":
            value["files"] = files.quick_fingerprint(source.path)
        else:
            value["files"] = folder_fingerprint(source.path)
            if unsupported := unsupported_photos(source.path):
                value["unsupported"] = [legible(path.name) for path in unsupported]
        if source.masks is not None:
            value["masks"] = masks_fingerprint(source.masks)
        for name, place in (("cameras", source.cameras), ("depths", source.depths)):
            if place is not None:
                value[name] = place_fingerprint(place, whole=name == "cameras")
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=error.filename or source.path) from error
    return value


def folder_fingerprint(folder: Path) -> str:
    """Identifies the pictures of a folder by number, names, sizes and samples of the bytes."""
    digest = hashlib.sha256()
    paths = list_photos(folder)
    for path in paths:  # 3 x 64 KiB a photo: a folder of a thousand costs well under a second
        digest.update(files.quick_fingerprint(path, chunk=1 << 16).encode())
    return f"{len(paths)}:{digest.hexdigest()}"


def masks_fingerprint(masks: Path) -> str:
    """Identifies a folder of masks, or a file of results."""
    return place_fingerprint(masks) if masks.is_file() else folder_fingerprint(masks)


def place_fingerprint(place: Path, *, whole: bool = False) -> str:
    """Identifies a file, or all files of a folder (not of those below), by names, sizes and samples of the bytes.

    A file given by itself, or with `whole` each file, is read in full up to 48 MiB: one digit of a camera may change.
    """
    chunk = 1 << 24 if whole or place.is_file() else 1 << 16
    paths = [place] if place.is_file() else sorted(path for path in place.iterdir() if path.is_file())
    digest = hashlib.sha256()
    for path in paths:
        digest.update(files.quick_fingerprint(path, chunk=chunk).encode())
    return f"{len(paths)}:{digest.hexdigest()}"


def _sources_or_error(
    path: Path, above: set[Path], beside: list[str], *, top: bool = False
) -> Iterator[Source | SourceError]:
    """The sources at or below `path`, and a row where it cannot be used: never a reason to leave out its neighbours."""
    try:
        yield from _expand(path, above, beside, top=top)
    except BadInput as error:
        yield name_of(path), path, error
    except OSError as error:
        unreadable = BadInput(f"cannot be read ({error.strerror})", where=error.filename or path)
        yield name_of(path), path, unreadable


def _expand(path: Path, above: set[Path], beside: list[str], *, top: bool) -> Iterator[Source | SourceError]:
    """The sources at or below `path`.

    Args:
        above: the folders that it was found in.
        beside: where pictures lie that are no photos, as given: beside photos or videos, these are no captures.
        top: the user named it.

    Raises:
        BadInput: it cannot be used. That it holds no source is one only where the user named it, or where it holds
            photos of a kind that cannot be read.
    """
    if not path.exists():
        raise BadInput("no such file or folder", where=path, remedy="Check how it is spelt")
    if path.is_file():
        if path.suffix.lower() not in VIDEO_SUFFIXES:
            known = ", ".join(sorted(suffix[1:] for suffix in VIDEO_SUFFIXES))
            remedy = f"Give videos ({known}) or folders of photos"
            raise BadInput("is neither a video nor a folder of photos", where=path, remedy=remedy)
        yield _source(path, "video")
        return
    if (path / "sequence.json").is_file():  # WORK lies among the inputs: what was made of them is none of them
        if top:
            raise BadInput("is a prepared sequence", where=path, remedy="Give the video or photos that it was made of")
        return
    if (path / "frame_annotations.jgz").is_file():  # its photos are those of one sequence each, and have their cameras
        remedy = "Give the folder that holds it to `dope prep co3d`"
        raise BadInput("is a category of a CO3D download", where=path, remedy=remedy)
    entries = sorted((p for p in path.iterdir() if not p.name.startswith(".")), key=natural_order)
    images = path / "images"
    if images.is_dir() and list_photos(images):
        yield _source(images, "photos")
        return
    videos = [entry for entry in entries if entry.suffix.lower() in VIDEO_SUFFIXES and entry.is_file()]
    for video in videos:
        yield _source(video, "video")
    has_photos = bool(list_photos(path))
    if has_photos:
        yield _source(path, "photos")
    below = False
    place = path.resolve()
    if place not in above:  # a link to a folder above would never end
        homes = [*([path] if has_photos else []), *(video.with_suffix("") for video in videos)]
        given = {Path(pattern.replace("{}", str(home))).resolve() for pattern in beside for home in homes}
        for entry in entries:
            if entry.is_dir() and entry.name.lower() not in NOT_PHOTOS and entry.resolve() not in given:
                for source in _sources_or_error(entry, above | {place}, beside):
                    below = True
                    yield source
    foreign = any(entry.suffix.lower() in UNSUPPORTED_PHOTOS for entry in entries)
    if (top or foreign) and not (videos or has_photos or below):
        what = "holds neither photos nor videos" if entries else "is an empty folder"
        raise BadInput(what, where=path, remedy=_remedy(entries))


def _source(path: Path, kind: Literal["video", "photos"]) -> Source:
    source = Source(path, "", kind)
    return replace(source, id=name_of(source.home))


def _remedy(entries: list[Path]) -> str:
    foreign = sorted({e.suffix.lower() for e in entries} & UNSUPPORTED_PHOTOS)
    if foreign:
        return f"Convert {', '.join(foreign)} files to JPEG first"
    known = ", ".join(sorted(suffix[1:] for suffix in PHOTO_SUFFIXES))
    return f"Photos are {known} files"


def _labelled(source: Source, category: str | None, category_from: str) -> Source:
    if category is None and category_from == "parent":
        category = source.home.absolute().parent.name or None
    return replace(source, category=category, instance=source.id)


def _beside(source: Source, what: str, given: str, several: bool) -> Path:
    """Where the masks, cameras or depths of a source lie. Raises `BadInput` where there is nothing."""
    if "{}" in given:
        home = source.home.with_suffix("") if source.kind == "video" else source.home
        place = Path(given.replace("{}", str(home)))
    else:
        place = Path(given) / source.id if several else Path(given)
    if what == "masks" and several and "{}" not in given:  # results of a segmentation tool: one file for all, or each
        results = (Path(given), place.with_name(f"{place.name}.json"))
        place = next((path for path in results if path.is_file() and not place.is_dir()), place)
    may_be_file = what in ("cameras", "masks")
    if place.is_dir() or (may_be_file and place.is_file()):
        return place
    flag = "--reuse-cameras" if what == "cameras" else f"--{what}"
    kind = "file or folder" if may_be_file else "folder"
    remedy = f"{flag} is a {kind}: for several inputs it holds a {kind} for each id; {{}} stands for the input"
    raise BadInput(f"no such {kind} of {what}", where=place, remedy=remedy)
