"""From a database to models."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pipeline.cameras.colmap.base import explained, pycolmap
from pipeline.cameras.colmap.model import Model


@dataclass(frozen=True)
class Mapping:
    """How models are built.

    Attributes:
        relaxed: accept frames and a first pair with fewer inliers.
        min_model_size: smaller models are not kept, unless it is the only one.
        refine_focal, refine_distortion: in bundle adjustment; neither: the cameras' intrinsics stay as they are.
        seed, threads: with one thread the same database gives the same model.
    """

    relaxed: bool
    refine_focal: bool
    refine_distortion: bool
    seed: int
    threads: int
    min_model_size: int = 3


def map_incrementally(database: Path, images: Path, output: Path, how: Mapping) -> list[Model]:
    """Incremental structure from motion; the models it finds, largest first (none: an empty list)."""
    pycolmap.set_random_seed(how.seed)
    options = _incremental(how)
    options.min_model_size, options.max_num_models = how.min_model_size, 8
    output.mkdir(parents=True, exist_ok=True)
    with explained("mapper failed", images):
        found = pycolmap.incremental_mapping(database, images, output, options)
    return largest_first(found.values())


def extend_model(database: Path, images: Path, model: Model, output: Path, how: Mapping) -> Model:
    """Go on with a model: register what frames of the database it lacks. The given model stays as it is."""
    pycolmap.set_random_seed(how.seed)
    options = _incremental(how)
    options.multiple_models = False
    start = output / "start"
    start.mkdir(parents=True, exist_ok=True)
    model.write(start)
    with explained("mapper failed", images):
        found = pycolmap.incremental_mapping(database, images, output, options, input_path=start)
    return largest_first([*found.values(), model._reconstruction])[0]


def map_globally(database: Path, images: Path, output: Path, how: Mapping) -> list[Model]:
    """Global structure from motion: all rotations, then all positions at once. Models as `map_incrementally`."""
    pycolmap.set_random_seed(how.seed)
    options = pycolmap.GlobalPipelineOptions(num_threads=how.threads, random_seed=how.seed)
    options.min_model_size = how.min_model_size
    options.mapper.num_threads, options.mapper.random_seed = how.threads, how.seed
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length, adjustment.refine_extra_params = how.refine_focal, how.refine_distortion
    output.mkdir(parents=True, exist_ok=True)
    with explained("global mapper failed", images):
        found = pycolmap.global_mapping(database, images, output, options)
    return largest_first(found.values())


def largest_first(found: Iterable[pycolmap.Reconstruction]) -> list[Model]:
    """Models by their number of frames, then of points."""
    return sorted(map(Model, found), key=lambda model: (-len(model.frames), -model.n_points))


def _incremental(how: Mapping) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=how.threads,
        random_seed=how.seed,
        ba_refine_focal_length=how.refine_focal,
        ba_refine_extra_params=how.refine_distortion,
    )
    mapper = options.mapper
    mapper.num_threads, mapper.random_seed = how.threads, how.seed
    if not how.refine_focal:
        mapper.abs_pose_refine_focal_length = False
    if not how.refine_distortion:
        mapper.abs_pose_refine_extra_params = False
    if how.relaxed:
        mapper.init_min_num_inliers, mapper.abs_pose_min_num_inliers = 50, 15
        mapper.abs_pose_min_inlier_ratio = 0.15
    return options
