"""Cameras and sparse points of a sequence, few and small enough to be drawn in the page."""

from __future__ import annotations

import base64
import mmap
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.geometry import Camera
from pipeline.sequence import Frame

POINT = struct.Struct("<Q3d3Bd")
COUNT = struct.Struct("<Q")
OBSERVATION_BYTES = 8
FARTHEST = 1.25
"""Points farther out than this many times the farthest camera are background and are not drawn."""


def read_point_cloud(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Coordinates (N, 3) and RGB (N, 3) of points3D.bin, COLMAP's binary format; none where there is no such file.

    COLMAP itself would build the whole model with its tracks, ten times slower, and a damaged file can abort the
    process that reads it.

    Raises:
        BadInput: the file is cut off.
    """
    path = folder / "points3D.bin"
    if not path.is_file() or not path.stat().st_size:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        values: list[tuple[Any, ...]] = []
        place = COUNT.size
        try:
            (count,) = COUNT.unpack_from(data)
            for _ in range(count):
                values.append(POINT.unpack_from(data, place))
                (track,) = COUNT.unpack_from(data, place + POINT.size)
                place += POINT.size + COUNT.size + OBSERVATION_BYTES * track
        except struct.error:
            raise BadInput("is cut off", where=path, remedy="Run `dope prep colmap --overwrite`") from None
    table = np.array(values, dtype=np.float64).reshape(-1, 8)
    return table[:, 1:4], table[:, 4:7].astype(np.uint8)


def orbit_of(frames: list[Frame], sparse: Path, n_points: int, n_cameras: int) -> dict[str, Any] | None:
    """What the page draws: z is up, lengths are shares of `extent`, arrays are base64 of little-endian integers.

    Returns:
        {"n": cameras in all, "extent": length of the unit in the sequence's, "cameras": int16 (M, 9) of centre,
        viewing direction and right-hand direction, 32767 = 1, "frames": their numbers, "points": int8 (N, 3),
        127 = FARTHEST, "colours": uint8 (N, 3)}; None where no frame has a camera.
    """
    chosen = [frame for frame in frames if frame.registered and frame.R and frame.t]
    if not chosen:
        return None
    cameras = [frame.camera for frame in chosen]
    if not all(np.isfinite(camera.R).all() and np.isfinite(camera.t).all() for camera in cameras):
        raise BadInput("a camera is not a number", where=sparse.parent)
    centres = np.array([camera.centre for camera in cameras])
    turn, extent = upright(cameras), float(np.linalg.norm(centres, axis=1).max()) or 1.0
    some = np.unique(np.linspace(0, len(cameras) - 1, min(n_cameras, len(cameras))).round().astype(int))
    poses = [np.concatenate([turn @ centres[i] / extent, turn @ cameras[i].R[2], turn @ cameras[i].R[0]]) for i in some]
    xyz, rgb = read_point_cloud(sparse)
    xyz = xyz @ turn.T / extent
    near = np.linalg.norm(xyz, axis=1) < FARTHEST
    xyz, rgb = _thin(xyz[near], rgb[near], n_points, extent)
    return {
        "n": len(chosen),
        "extent": round(extent, 4),
        "cameras": _packed(np.array(poses) * 32767, "<i2"),
        "frames": [chosen[i].frame for i in some],
        "points": _packed(xyz * (127 / FARTHEST), "i1"),
        "colours": _packed(rgb, "u1"),
    }


def upright(cameras: list[Camera]) -> NDArray[np.float64]:
    """A rotation (3, 3) that turns the mean "up" of the images to +z: people hold cameras upright."""
    up = -np.mean([camera.R[1] for camera in cameras], axis=0)
    length = float(np.linalg.norm(up))
    if length < 0.2:  # they were turned all ways: the axis they move around will do
        _, _, axes = np.linalg.svd(np.array([camera.centre for camera in cameras]), full_matrices=True)
        up, length = axes[-1], 1.0
    up = up / length
    helper = np.eye(3)[int(np.argmin(np.abs(up)))]
    side = np.cross(helper, up)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(up, side), up])


def _thin(
    xyz: NDArray[np.float64], rgb: NDArray[np.uint8], count: int, extent: float
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """At most `count` points: two thirds of the object (within 1.2 radii of the origin), the rest around it."""
    on_object = np.linalg.norm(xyz, axis=1) * extent < 1.2
    inner, outer = np.flatnonzero(on_object), np.flatnonzero(~on_object)
    n_inner = min(len(inner), max(count * 2 // 3, count - len(outer)))
    n_outer = min(len(outer), count - n_inner)
    picks = [
        group[np.linspace(0, len(group) - 1, n).astype(int)] for group, n in ((inner, n_inner), (outer, n_outer)) if n
    ]
    chosen = np.concatenate(picks) if picks else np.zeros(0, int)
    return xyz[chosen], rgb[chosen]


def _packed(values: NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.rint(values).astype(kind).tobytes()).decode()
