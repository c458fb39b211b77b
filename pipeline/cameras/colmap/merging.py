"""Models of one database brought together, and the last refinement of a model."""

from __future__ import annotations

import copy
from pathlib import Path

from pipeline.cameras.colmap.base import explained, pycolmap
from pipeline.cameras.colmap.given import triangulate
from pipeline.cameras.colmap.mapping import Mapping
from pipeline.cameras.colmap.model import Model

MIN_COMMON = 3
"""Images that two models must share: three camera centres fix a similarity."""


def joined_model(models: list[Model]) -> tuple[Model | None, int]:
    """The cameras of the first model and of all that can be aligned to it, without points, and how many these are.

    Two models are aligned by the points that they see in the same features of the images that they share, and only
    where these points then reproject well. An image of several models stays as the first of them has it.

    Returns:
        the joined cameras and the number of models in them; None and 1 where nothing can be joined.
    """
    placed, left = [models[0]._reconstruction], [model._reconstruction for model in models[1:]]
    while True:
        found = next(((other, moved) for other in left if (moved := _moved(other, placed)) is not None), None)
        if found is None:
            break
        left = [other for other in left if other is not found[0]]
        placed.append(found[1])
    return (Model(_union(placed)), len(placed)) if len(placed) > 1 else (None, 1)


def _moved(other: pycolmap.Reconstruction, placed: list[pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    """A copy of a model in the world of those that are placed, by the first that it can be aligned to."""
    for base in placed:
        if len(base.find_common_reg_image_ids(other)) < MIN_COMMON:
            continue
        similarity = pycolmap.align_reconstructions_via_reprojections(other, base)
        if similarity is not None:
            moved = copy.deepcopy(other)
            moved.transform(similarity)
            return moved
    return None


def _union(placed: list[pycolmap.Reconstruction]) -> pycolmap.Reconstruction:
    """All cameras and posed images, under their own ids: all models are of one database."""
    union = pycolmap.Reconstruction()
    images: dict[int, tuple[pycolmap.Image, pycolmap.Rigid3d]] = {}
    for model in placed:
        for camera_id, camera in sorted(model.cameras.items()):
            if not union.exists_camera(camera_id):
                union.add_camera_with_trivial_rig(camera)
        for image_id, image in model.images.items():
            if image.has_pose and image_id not in images:
                fresh = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image_id)
                images[image_id] = fresh, image.cam_from_world()
    for _, (image, pose) in sorted(images.items()):
        union.add_image_with_trivial_frame(image, pose)
    return union


def merge_models(
    database: Path, images: Path, models: list[Model], output: Path, how: Mapping
) -> tuple[list[Model], int]:
    """Join the models that overlap with the largest, with points from all matches, refined.

    Args:
        models: of one database, largest first.

    Returns:
        the joined model and the models that stay apart, largest first; the number of models that were joined (1: none).
    """
    joined, n = joined_model(models) if len(models) > 1 else (None, 1)
    if joined is None:
        return models, 1
    merged = triangulate(database, images, joined, output, seed=how.seed, threads=how.threads)
    merged = refine(merged, how)
    inside = set(merged.frames)
    return [merged, *(model for model in models if not set(model.frames) <= inside)], n


def refine(model: Model, how: Mapping) -> Model:
    """A copy of a model after one more bundle adjustment with a loss that large errors hardly count in (Cauchy, 1 px).

    COLMAP's mapper adjusts with plain squares: matches that are wrong by a few pixels pull at the cameras.
    """
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=how.refine_focal, refine_extra_params=how.refine_distortion
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = 1.0
    options.ceres.solver_options.num_threads = how.threads
    options.ceres.solver_options.max_num_iterations = 25
    found = copy.deepcopy(model._reconstruction)
    with explained("bundle adjustment failed", Path("model")):
        pycolmap.bundle_adjustment(found, options)
    found.update_point_3d_errors()
    return Model(found)
