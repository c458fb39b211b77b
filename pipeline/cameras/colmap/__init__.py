"""The one door to COLMAP: nothing else imports pycolmap, whose API drifts from release to release.

Everything here runs on the CPU with the given seed and number of threads. With one thread the same input gives the
same bytes. Errors of COLMAP's C++ checks come out as `ColmapError`; it can also abort the process or eat memory, so
callers run a reconstruction in a child process with limits.
"""

from pipeline.cameras.colmap.base import CameraModel, ColmapError
from pipeline.cameras.colmap.database import (
    Lens,
    MatchedPair,
    extract_features,
    forget_pairs,
    import_images,
    match_pairs,
    read_features,
    read_matched_pairs,
    read_verified_pairs,
)
from pipeline.cameras.colmap.dense import fuse_depths, has_cuda_gpu, patch_match, undistort
from pipeline.cameras.colmap.given import (
    NamedModel,
    add_points,
    enter_images,
    enter_model,
    model_of_cameras,
    read_named_model,
    read_verified_matches,
    triangulate,
)
from pipeline.cameras.colmap.mapping import Mapping, extend_model, map_globally, map_incrementally
from pipeline.cameras.colmap.merging import merge_models, refine
from pipeline.cameras.colmap.model import Model, read_model, read_points
from pipeline.cameras.colmap.two_view import PairPose, pair_poses

__all__ = [
    "CameraModel",
    "ColmapError",
    "Lens",
    "Mapping",
    "MatchedPair",
    "Model",
    "NamedModel",
    "PairPose",
    "add_points",
    "enter_images",
    "enter_model",
    "extend_model",
    "extract_features",
    "forget_pairs",
    "fuse_depths",
    "has_cuda_gpu",
    "import_images",
    "map_globally",
    "map_incrementally",
    "match_pairs",
    "merge_models",
    "model_of_cameras",
    "pair_poses",
    "patch_match",
    "read_features",
    "read_matched_pairs",
    "read_model",
    "read_named_model",
    "read_points",
    "read_verified_matches",
    "read_verified_pairs",
    "refine",
    "triangulate",
    "undistort",
]
