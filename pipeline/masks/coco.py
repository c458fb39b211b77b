"""Masks out of a segmentation tool's results: the frames' instances found, one picked for each frame, decoded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.masks.fit import MaskFit, source_size
from pipeline.masks.image_names import Found, Matched, match_images
from pipeline.masks.instances import decode_segmentation, encoded_size
from pipeline.masks.pick import Candidates, pick, small
from pipeline.masks.results_file import Results, read_image_table, read_results
from pipeline.sequence import Frame, Sequence

if TYPE_CHECKING:
    from pipeline.masks.imported import MasksConfig

Mask = NDArray[np.bool_]


def picked_masks(
    sequence: Sequence, frames: list[Frame], path: Path, config: MasksConfig, *, cameras: bool
) -> tuple[dict[str, Any], Iterator[tuple[Frame, Mask]], MaskFit]:
    """One instance for each frame that has any, as a mask of the stored size.

    Args:
        frames: those that have an image.
        path: the results (`pipeline.masks.results_file`).
        cameras: may the frames' cameras help to pick.

    Returns:
        {"pick": the rule that was used (`pipeline.masks.pick`), "instances": how many it had to choose from}, with
        "warnings" where there are any; the masks, which are decoded as they are taken; and what they are brought to
        the stored size by.

    Raises:
        BadInput: the file is none of results, its images are not the frames, a segmentation is malformed or has
            another size than its image, or no instance passes the filters. The iterator raises it, too.
    """
    results = read_results(path)
    categories = _with_table(results, config)
    matched = match_images(sequence, sequence.read_frames(), results, config.names, shared=config.shared)
    chosen = _instances(results, matched.images, _wanted_categories(config, categories, path), config)
    if not chosen:
        raise BadInput(
            "no instance of these frames passes the filters",
            where=path,
            remedy=f"Scores are asked to be {config.min_score} or more; see --min-score and --category-id",
        )
    fit = MaskFit(Path(sequence.read_info().source), config.lying, on_stored=matched.names == "stored")
    decoder = _Decoder(results, matched, fit)
    shown = [frame for frame in frames if frame.frame in chosen]
    with path.open("rb") as file:
        candidates = [decoder.candidates(file, frame, chosen[frame.frame], cameras=cameras) for frame in shown]
    picked, rule = pick(candidates, config.pick, config.hull)
    details: dict[str, Any] = {"pick": rule, "instances": sum(len(instances) for instances in chosen.values())}
    details |= {"warnings": decoder.warnings} if decoder.warnings else {}

    def masks() -> Iterator[tuple[Frame, Mask]]:
        with path.open("rb") as file:
            for frame, choice in zip(shown, picked, strict=True):
                yield frame, decoder.mask(file, frame, chosen[frame.frame][choice])

    return details, masks(), fit


def _with_table(results: Results, config: MasksConfig) -> dict[int, str]:
    """Add the given table of images to the results'; the names of categories of both."""
    if config.coco_images is None:
        return results.categories
    table = read_image_table(Path(config.coco_images))
    results.names.update(table.names)
    results.sizes.update(table.sizes)
    return results.categories | table.categories


def _wanted_categories(config: MasksConfig, categories: dict[int, str], path: Path) -> set[int]:
    """Ids of the categories that are wanted; empty for all."""
    wanted = set(config.category_ids)
    for name in config.category_names:
        ids = {number for number, known in categories.items() if known.casefold() == name.casefold()}
        if not ids:
            there = ", ".join(sorted(categories.values())[:10])
            remedy = f"There are {there}" if there else "The file names no categories: use --category-id"
            raise BadInput(f"knows no category '{name}'", where=path, remedy=remedy)
        wanted |= ids
    return wanted


def _instances(results: Results, found: Found, categories: set[int], config: MasksConfig) -> dict[int, list[int]]:
    """The best instances of each frame by score, at most `config.instances`, in the file's order where equal."""
    image_of, score = np.asarray(results.image_of), np.asarray(results.score)
    passed = score >= config.min_score
    if categories:
        passed &= np.isin(np.asarray(results.category), sorted(categories))
    frame_of = np.full(len(results.images), -1)
    for index, key in found.items():
        frame_of[results.images[key]] = index
    frame = np.where(passed, frame_of[image_of], -1)
    numbers = np.flatnonzero(frame >= 0)
    numbers = numbers[np.lexsort((numbers, -score[numbers], frame[numbers]))]
    if not len(numbers):
        return {}
    groups = np.split(numbers, np.flatnonzero(np.diff(frame[numbers])) + 1)
    return {int(frame[group[0]]): group[: config.instances].tolist() for group in groups}


class _Decoder:
    """Makes masks of the stored images' size out of instances."""

    def __init__(self, results: Results, matched: Matched, fit: MaskFit) -> None:
        self.results, self.matched, self.fit = results, matched, fit
        self.warnings: list[str] = []

    def candidates(self, file: BinaryIO, frame: Frame, instances: list[int], *, cameras: bool) -> Candidates:
        masks = [small(self.mask(file, frame, instance)) for instance in instances]
        height, width = masks[0].shape
        camera = frame.camera.resized(width, height) if cameras and frame.registered else None
        scores = np.array([self.results.score[instance] for instance in instances])
        return Candidates(np.stack(masks), scores, camera)

    def mask(self, file: BinaryIO, frame: Frame, instance: int) -> Mask:
        try:
            segmentation = self.results.segmentation(file, instance)
            polygons = isinstance(segmentation, list)
            height, width = self._canvas(frame)[::-1] if polygons else encoded_size(segmentation)
            if not self.fit.accepts((width, height), frame):  # before a mask of any size it likes to claim is made
                right = source_size(frame)
                raise BadInput(f"the mask is {width}x{height}, its image is {right[0]}x{right[1]}")
            return self.fit.fit(decode_segmentation(segmentation, (height, width)), frame)
        except BadInput as error:
            what = f"annotation {instance} (image '{frame.source_name}'): {error.what}"
            raise BadInput(what, where=self.results.path, remedy=error.remedy or "Write the results again") from error

    def _canvas(self, frame: Frame) -> tuple[int, int]:
        """(width, height) of the image that a frame's polygons were drawn on: as the table of images says, else that of
        the image whose name it has."""
        key = self.matched.images[frame.frame]
        if key in self.results.sizes:
            size = self.results.sizes[key]
            if size is None:
                remedy = "Give the table of this sequence's images alone with --coco-images"
                raise BadInput("the table of images gives its image several sizes", remedy=remedy)
            return size
        size, stored = self.fit.canvas(frame), (frame.width, frame.height)
        if self.matched.names == "either" and size != stored and not self.warnings:
            self.warnings.append(
                f"polygons were taken to be drawn on the source's images ({size[0]}x{size[1]}), not on those of the "
                f"same names in images/ ({stored[0]}x{stored[1]}): names=stored or names=source says which, or width "
                "and height in the table of images"
            )
        return size
