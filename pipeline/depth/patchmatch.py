"""Dense depth by COLMAP's PatchMatch stereo (Schoenberger et al., ECCV 2016), which needs a CUDA device.

COLMAP works on undistorted images; its depth maps are brought back to each frame's own, distorted pixel grid. The pose
stays the same, so z-depth does too.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dope.common import files
from dope.common.files import TEMPORARY
from pipeline.cameras import colmap
from pipeline.depth.depth_filter import drop_contradicted, drop_islands
from pipeline.depth.neighbours import choose_neighbours
from pipeline.depth.readers import read_colmap_array
from pipeline.depth.resample import redistorted
from pipeline.depth.stereo import Depth, View
from pipeline.sequence import Frame, Sequence

if TYPE_CHECKING:
    from pipeline.cameras.sparse_points import Tracks
    from pipeline.depth.mvs import DepthConfig


def patchmatch_depth(
    sequence: Sequence, frames: list[Frame], views: list[View], tracks: Tracks, config: DepthConfig
) -> list[Depth | None]:
    """Depth at working resolution of every view; None where PatchMatch left no depth map.

    The workspace (undistorted images, photometric and geometric maps) lies in the sequence's folder while it is needed.

    Raises:
        ColmapError: no CUDA device, or PatchMatch failed.
    """
    depths: list[Depth | None] = []
    with tempfile.TemporaryDirectory(prefix=".patchmatch-", suffix=TEMPORARY, dir=sequence.folder) as name:
        workspace = Path(name)
        colmap.undistort(sequence.sparse, sequence.images, workspace, max_image_size=config.long_side)
        colmap.patch_match(workspace, max_image_size=config.long_side)
        cameras = colmap.read_model(workspace / "sparse").cameras()
        for frame, view in zip(frames, views, strict=True):
            image = Path(frame.image or "").name
            path = workspace / "stereo" / "depth_maps" / f"{image}.geometric.bin"
            if frame.frame not in cameras or not path.exists():
                depths.append(None)
                continue
            depths.append(redistorted(read_colmap_array(path), cameras[frame.frame], view.camera))
        if config.fused:
            with files.atomic_path(sequence.folder / "fused.ply") as ply:
                colmap.fuse_depths(workspace, workspace / "fused.ply", threads=config.threads)
                shutil.move(workspace / "fused.ply", ply)
    return _checked(sequence, views, depths, config)


def _checked(
    sequence: Sequence, views: list[View], depths: list[Depth | None], config: DepthConfig
) -> list[Depth | None]:
    """Without what other views look through, what lies outside the region, and small islands.

    That two other views confirm each depth to a pixel, PatchMatch has seen to already (`filter_min_num_consistent`).
    """
    from pipeline.depth.mvs import looked_at, object_centre

    cameras = [view.camera for view in views]
    witnesses_of = choose_neighbours(cameras, looked_at(views, object_centre(sequence, views)), config.witnesses)
    kept, _ = drop_contradicted(cameras, depths, witnesses_of, config.agreement)
    inside = [
        depth if depth is None or view.region is None else np.where(view.region, depth, np.float32(0))
        for view, depth in zip(views, kept, strict=True)
    ]
    return [None if depth is None else drop_islands(depth, config.agreement.min_island_px) for depth in inside]
