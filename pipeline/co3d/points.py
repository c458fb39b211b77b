"""Points of a CO3D sequence's object: its point cloud, or its depth maps inside the masks.

They say where the object is and how large; with them no feature has to be matched.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.co3d.depth import Co3dDepths
from pipeline.co3d.frames import annotated_camera
from pipeline.co3d.sources import Co3dSource
from pipeline.geometry import Floats
from pipeline.ply import Points, read_ply
from pipeline.sequence import Sequence

MOST_POINTS = 20_000


def cloud_points(source: Co3dSource) -> Points | None:
    """The sequence's point cloud; None where none is annotated. Raises BadInput where it cannot be read."""
    given = source.annotation.point_cloud
    if given is None:
        return None
    try:
        points = read_ply(source.category.resolve(given))
    except BadInput as error:
        raise BadInput(f"the point cloud {error.what}") from error
    if not len(points.xyz):
        raise BadInput("the point cloud holds no points")
    return points.thinned(MOST_POINTS)


def depth_points(sequence: Sequence, depths: Co3dDepths) -> Points | None:
    """Points of the depth maps, inside the masks where there are any; None where no depth is annotated.

    Raises:
        BadInput: no map can be used.
    """
    frames = [frame for frame in sequence.read_frames() if frame.image is not None]
    xyz: list[Floats] = []
    rgb: list[NDArray[np.uint8]] = []
    reason: str | None = None
    for frame in frames:
        try:
            depth = depths.read(frame)
        except BadInput as error:
            reason = error.what
            continue
        if depth is None:
            continue
        reason = reason or "none shows the object"
        height, width = depth.shape
        mask, image = sequence.read_mask(frame), sequence.read_image(frame)
        rows, columns = np.nonzero(depth)
        centres = np.stack([columns + 0.5, rows + 0.5], axis=1)
        at = np.floor(centres * (frame.width / width, frame.height / height)).astype(np.intp)
        x, y = np.minimum(at, (frame.width - 1, frame.height - 1)).T
        if mask is not None:
            inside = mask[y, x]
            centres, x, y, rows, columns = (values[inside] for values in (centres, x, y, rows, columns))
        if not len(centres):
            continue
        chosen = np.linspace(0, len(centres) - 1, min(len(centres), MOST_POINTS // len(frames) + 1)).astype(np.int64)
        camera = annotated_camera(depths.annotations[frame.frame]).resized(width, height)
        xyz.append(camera.unproject(centres[chosen], depth[rows[chosen], columns[chosen]]))
        rgb.append(image[y[chosen], x[chosen], ::-1])
    if not xyz:
        if reason is None:
            return None
        raise BadInput(f"no depth map gives points ({reason})")
    return Points(np.concatenate(xyz), np.concatenate(rgb)).thinned(MOST_POINTS)
