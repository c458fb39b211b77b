"""Masks out of a segmentation tool's results: the frames' instances found, one picked for each frame, decoded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.masks.image_names import match_images
from pipeline.masks.instances import decode_segmentation, encoded_size
from pipeline.masks.mask_io import fit_to_frame, fits_frame, source_size
from pipeline.masks.pick import Candidates, pick, small
from pipeline.masks.results_file import Results, read_image_table, read_results
from pipeline.sequence import Frame, Sequence

if TYPE_CHECKING:
    from pipeline.masks.imported import MasksConfig

Mask = NDArray[np.bool_]


def picked_masks(
    sequence: Sequence, frames: list[Frame], path: Path, config: MasksConfig, *, shared: bool
) -> tuple[dict[str, Any], Iterator[tuple[Frame, Mask]]]:
    """One instance for each frame that has any, as a mask of the stored size.

    Args:
        frames: those that have an image.
        path: the results (`pipeline.masks.results_file`).
        shared: the file holds results of several sequences.

    Returns:
        {"pick": the rule that was used (`pipeline.masks.pick`), "instances": how many it had to choose from}, and the
        masks, which are decoded as they are taken.

    Raises:
        BadInput: the file is none of results, its images are not the frames, a segmentation is malformed or has
            another size than its image, or no instance passes the filters. The iterator raises it, too.
    """
    results = read_results(path)
    categories = _with_table(results, config)
    found = match_images(sequence, sequence.read_frames(), results, config.names, shared=shared)
    chosen = _instances(results, found, _wanted_categories(config, categories, path), config)
    if not chosen:
        raise BadInput(
            "no instance of these frames passes the filters",
            where=path,
            remedy=f"Scores are asked to be {config.min_score} or more; see --min-score and --category-id",
        )
    photos = Path(sequence.read_info().source)
    shown = [frame for frame in frames if frame.frame in chosen]
    with path.open("rb") as file:
        candidates = [_candidates(results, file, frame, chosen[frame.frame], photos) for frame in shown]
    picked, rule = pick(candidates, config.pick, config.hull)
    details = {"pick": rule, "instances": sum(len(instances) for instances in chosen.values())}

    def masks() -> Iterator[tuple[Frame, Mask]]:
        with path.open("rb") as file:
            for frame, choice in zip(shown, picked, strict=True):
                yield frame, _decoded(results, file, frame, chosen[frame.frame][choice], photos)

    return details, masks()


def _with_table(results: Results, config: MasksConfig) -> dict[int, str]:
    """Add the given table of images to the results'; the names of categories of both."""
    if config.coco_images is None:
        return results.categories
    names, categories = read_image_table(Path(config.coco_images))
    for key, file_names in names.items():
        results.names[key] = file_names
    return results.categories | categories


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


def _instances(
    results: Results, found: dict[int, int | str], categories: set[int], config: MasksConfig
) -> dict[int, list[int]]:
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


def _candidates(results: Results, file: BinaryIO, frame: Frame, instances: list[int], photos: Path) -> Candidates:
    masks = [small(_decoded(results, file, frame, instance, photos)) for instance in instances]
    height, width = masks[0].shape
    camera = frame.camera.resized(width, height) if frame.registered else None
    return Candidates(np.stack(masks), np.array([results.score[instance] for instance in instances]), camera)


def _decoded(results: Results, file: BinaryIO, frame: Frame, instance: int, photos: Path) -> Mask:
    """An instance's mask of the stored image's size."""
    try:
        segmentation = results.segmentation(file, instance)
        size = source_size(frame)[::-1] if isinstance(segmentation, list) else encoded_size(segmentation)
        if not fits_frame(size, frame):  # before a mask of any size it likes to claim is made
            width, height = source_size(frame)
            raise BadInput(f"the mask is {size[1]}x{size[0]}, its image is {width}x{height}")
        return fit_to_frame(decode_segmentation(segmentation, size), frame, photos)
    except BadInput as error:
        what = f"annotation {instance} (image '{frame.source_name}'): {error.what}"
        raise BadInput(what, where=results.path, remedy=error.remedy or "Write the results again") from error
