"""Dense depth by COLMAP's PatchMatch stereo (Schoenberger et al., ECCV 2016), which needs a CUDA device.

COLMAP works on undistorted images; its depth maps are brought back to each frame's own, distorted pixel grid. The pose
stays the same, so z-depth does too.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from dope.common.files import TEMPORARY
from pipeline import colmap
from pipeline.depth_filter import drop_islands
from pipeline.geometry import Camera
from pipeline.sequence import Frame, Sequence
from pipeline.stereo import Depth, View, pixel_rays, sample_within_surfaces

if TYPE_CHECKING:
    from pipeline.mvs import DepthConfig
    from pipeline.sparse_points import Tracks

EDGE = 0.03  # relative step between neighbouring depths beyond which they are two surfaces


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
            depth = redistorted(read_array(path), cameras[frame.frame], view.camera)
            if view.region is not None:
                depth = np.where(view.region, depth, np.float32(0))
            depths.append(drop_islands(depth, config.agreement.min_island_px))
    return depths


def read_array(path: Path) -> NDArray[np.float32]:
    """COLMAP's dense array, (h, w) or (h, w, channels): a text head `width&height&channels&`, then float32 columns.

    Raises:
        BadInput: the head or the size is not that of such a file.
    """
    data = path.read_bytes()
    head = data[:64].split(b"&", 3)
    try:
        width, height, channels = (int(number) for number in head[:3])
        start = sum(len(number) + 1 for number in head[:3])
        values = np.frombuffer(data, "<f4", offset=start).reshape((width, height, channels), order="F")
    except ValueError as error:
        raise BadInput(f"is not a depth map of COLMAP ({error})", where=path) from error
    return np.ascontiguousarray(values.transpose(1, 0, 2).squeeze(axis=2) if channels == 1 else values.swapaxes(0, 1))


def redistorted(depth: Depth, pinhole: Camera, camera: Camera) -> Depth:
    """Depth (h, w) of an undistorted view on the pixel grid of the distorted `camera` of the same pose.

    Args:
        depth: z-depth of `pinhole`, whose size may differ from the camera's; 0 or less = unknown.
    """
    height, width = depth.shape
    K = pinhole.resized(width, height).K
    rays = pixel_rays(camera)
    u = (rays[..., 0] * K[0, 0] + (K[0, 2] - 0.5)).astype(np.float32)
    v = (rays[..., 1] * K[1, 1] + (K[1, 2] - 0.5)).astype(np.float32)
    known = depth > 0
    if not known.any():
        return np.zeros((camera.height, camera.width), np.float32)
    smallest = depth[known].min()
    # in logarithms a step at an edge is relative, and 0 stays free for the unknown
    logarithms = np.where(known, 1 + np.log(np.where(known, depth, smallest) / smallest), 0).astype(np.float32)
    sampled = sample_within_surfaces(logarithms, u, v, tolerance=np.float32(EDGE))
    return np.where(sampled > 0, np.exp(sampled - 1) * smallest, 0).astype(np.float32)
