"""What each verified pair of images says of itself, beside what a model says of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.cameras.colmap.base import opened, pycolmap
from pipeline.cameras.colmap.model import Model
from pipeline.geometry import Floats


@dataclass(frozen=True)
class PairPose:
    """The pose of the second camera seen from the first, by the pair's matches alone and by a model.

    Attributes:
        first, second: names of the images.
        by_matches, by_model: (3, 3) rotation from the first to the second camera.
        step_by_matches, step_by_model: (3,) translation of length 1: two views do not tell how far they are apart.
    """

    first: str
    second: str
    by_matches: Floats
    by_model: Floats
    step_by_matches: Floats
    step_by_model: Floats


def pair_poses(database: Path, model: Model, *, min_matches: int, most: int) -> list[PairPose]:
    """Relative poses of the verified pairs whose images a model holds, evenly chosen where there are more than `most`.

    The pose by matches is that of the essential matrix or homography of the verified matches under the model's
    intrinsics (Hartley and Zisserman, 9.6), with the matches in front of both cameras.

    Args:
        min_matches: pairs with fewer verified matches are left out: their pose is uncertain.
    """
    found = model._reconstruction
    placed = {image.name: image for image in found.images.values() if image.has_pose}
    poses = []
    with opened(database) as db:
        images = {image.image_id: image for image in db.read_all_images() if image.name in placed}
        counted = zip(*db.read_two_view_geometry_num_inliers(), strict=True)
        pairs = sorted(pycolmap.pair_id_to_image_pair(pair) for pair, n in counted if n >= min_matches)
        pairs = [(a, b) for a, b in pairs if a in images and b in images]
        pairs = pairs[:: max(1, -(-len(pairs) // most))]
        pixels = {number: db.read_keypoints(number)[:, :2].astype(np.float64) for pair in pairs for number in pair}
        for a, b in pairs:
            one, two = placed[images[a].name], placed[images[b].name]
            geometry = db.read_two_view_geometry(a, b)
            lenses = found.cameras[one.camera_id], found.cameras[two.camera_id]
            if not pycolmap.estimate_two_view_geometry_pose(lenses[0], pixels[a], lenses[1], pixels[b], geometry):
                continue
            pose = geometry.cam2_from_cam1
            if pose is None:
                continue
            relative = two.cam_from_world() * one.cam_from_world().inverse()
            rotations = [np.array(p.rotation.matrix()) for p in (pose, relative)]
            steps = [
                np.array(p.translation) / max(float(np.linalg.norm(p.translation)), 1e-12) for p in (pose, relative)
            ]
            poses.append(PairPose(one.name, two.name, *rotations, *steps))
    return poses
