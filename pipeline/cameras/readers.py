"""Cameras found by other tools: COLMAP models, nerfstudio's transforms.json, cameras.json, in one convention.

nerfstudio: https://docs.nerf.studio/quickstart/data_conventions.html (camera to world, OpenGL axes: y up, z backward).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dope.common import files
from dope.common.errors import BadInput
from pipeline.cameras import colmap
from pipeline.cameras.compare import CAMERAS_REMEDY, read_reference
from pipeline.geometry import Camera, Floats
from pipeline.ply import read_ply
from pipeline.sequence import read_image

MAX_DRIFT = 0.01  # a matrix whose axes are longer or shorter by more is no rotation with rounding errors
OPENGL = np.diag([1.0, -1.0, -1.0])  # x right, y up, z backward; turned round x by 180 degrees: OpenCV
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")


@dataclass(frozen=True)
class KnownCameras:
    """Cameras that need not be found.

    Attributes:
        cameras: by the source image's name, with or without folders and suffix; pixels of an image of the camera's
            own width x height, which may be larger or smaller than the stored frame.
        xyz, rgb: (N, 3) points in the cameras' world and their colours, or None.
        where: what they were read from, for messages.
    """

    cameras: dict[str, Camera]
    xyz: Floats | None
    rgb: NDArray[np.uint8] | None
    where: str


def read_known_cameras(path: Path) -> KnownCameras:
    """Read a COLMAP model (its folder), a transforms.json or a cameras.json (the file, or the folder that holds it).

    Raises:
        BadInput: nothing of that kind is there, or it is damaged; the message names the file and the frame.
    """
    if path.is_dir():
        path = _find(path)
    if path.is_dir():
        model = colmap.read_named_model(path)
        found = KnownCameras(model.cameras, model.xyz, model.rgb, f"the COLMAP model {path}")
    else:
        content = files.read_json(path, remedy=CAMERAS_REMEDY)
        rows = content.get("frames") if isinstance(content, dict) else None
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise BadInput("has no list of `frames`", where=path, remedy="Give a transforms.json or a cameras.json")
        if any("transform_matrix" in row for row in rows):
            found = _read_transforms(path, content)
        else:
            found = KnownCameras(read_reference(path), None, None, f"the cameras.json {path}")
    if not found.cameras:
        raise BadInput("holds no camera with a pose", where=path)
    return replace(found, cameras={name: checked_camera(name, c, path) for name, c in found.cameras.items()})


def checked_camera(name: str, camera: Camera, where: Path) -> Camera:
    """The camera with its rotation free of rounding errors. Raises `BadInput` where it cannot be a camera."""
    values = (camera.K, camera.distortion, camera.R, camera.t)
    if not all(np.isfinite(value).all() for value in values):
        raise BadInput(f"the camera of '{name}' has values that are not finite", where=where)
    if min(camera.width, camera.height) < 1 or min(camera.K[0, 0], camera.K[1, 1]) <= 0:
        size = f"{camera.width}x{camera.height}, focal lengths {camera.K[0, 0]:g} and {camera.K[1, 1]:g}"
        raise BadInput(f"the camera of '{name}' has no sensible size or focal length ({size})", where=where)
    U, stretch, Vt = np.linalg.svd(camera.R)
    if np.abs(stretch - 1).max() > MAX_DRIFT or np.linalg.det(camera.R) < 0:
        det = np.linalg.det(camera.R)
        remedy = "World-to-camera and camera-to-world matrices hold a pure rotation: no scale, no mirroring"
        raise BadInput(
            f"the camera of '{name}' has a matrix that is no rotation (det {det:.3g})", where=where, remedy=remedy
        )
    R = U @ Vt
    return replace(camera, R=R, t=-R @ np.linalg.solve(camera.R, -camera.t))


def _find(folder: Path) -> Path:
    """What a folder holds: itself where it is a COLMAP model, else one of the two files."""
    if any((folder / name).is_file() for name in ("images.bin", "images.txt")):
        return folder
    for name in ("transforms.json", "cameras.json"):
        if (folder / name).is_file():
            return folder / name
    remedy = "Name a transforms.json, a cameras.json, or the folder of a COLMAP model, such as sparse/0"
    raise BadInput(
        "holds no cameras: neither images.bin nor images.txt, transforms.json or cameras.json",
        where=folder,
        remedy=remedy,
    )


def _read_transforms(path: Path, content: dict[str, Any]) -> KnownCameras:
    cameras: dict[str, Camera] = {}
    size = _size_of_first(path, content)
    world = _applied(path, content)
    for number, row in enumerate(content["frames"]):
        name = row.get("file_path", f"frame {number}")
        try:
            camera = _transforms_camera({**size, **content, **row}, path, str(name))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            what = f"lacks {error}" if isinstance(error, KeyError) else f"is not a camera ({error})"
            raise BadInput(f"frame {number} ('{name}') {what}", where=path) from error
        R = checked_camera(str(name), camera, path).R  # before the world is turned
        name = str(row.get("source_name") or row["file_path"])  # ours says what the image was made of
        if name in cameras:
            raise BadInput(f"'{name}' is there twice", where=path)
        cameras[name] = replace(camera, R=R @ world[:, :3], t=R @ world[:, 3] + camera.t)
    xyz, rgb = _ply_points(path, content)
    if xyz is not None:
        xyz = (xyz - world[:, 3]) @ world[:, :3]
    return KnownCameras(cameras, xyz, rgb, f"the transforms.json {path}")


def _transforms_camera(values: dict[str, Any], path: Path, name: str) -> Camera:
    """One frame with the file's values as defaults. Raises KeyError, TypeError or ValueError for what is missing."""
    model = str(values.get("camera_model", "OPENCV")).upper()
    if model not in PERSPECTIVE or values.get("is_fisheye") or any(values.get(key) for key in ("k3", "k4")):
        kind = model if model not in PERSPECTIVE else "fisheye or with k3, k4"
        remedy = "Undistort the images (`colmap image_undistorter`) and give their cameras"
        raise BadInput(
            f"the camera of '{name}' is {kind}: only k1, k2, p1, p2 are supported", where=path, remedy=remedy
        )
    values["file_path"]
    width, height = round(float(values["w"])), round(float(values["h"]))
    if "fl_x" in values or "camera_angle_x" not in values:
        fx = float(values["fl_x"])
    else:
        fx = 0.5 * width / np.tan(0.5 * float(values["camera_angle_x"]))
    fy = fx
    if "fl_y" in values:
        fy = float(values["fl_y"])
    elif "camera_angle_y" in values and "fl_x" not in values:
        fy = 0.5 * height / np.tan(0.5 * float(values["camera_angle_y"]))
    cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    distortion = np.array([float(values.get(key, 0)) for key in ("k1", "k2", "p1", "p2")])
    matrix = np.array(values["transform_matrix"], dtype=np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"transform_matrix has shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise ValueError("transform_matrix has values that are not finite")
    R = (matrix[:3, :3] @ OPENGL).T
    if abs(np.linalg.det(R)) < 0.5:  # cannot be inverted, let alone be a rotation
        return Camera(width, height, K, distortion, R, matrix[:3, 3])
    return Camera(width, height, K, distortion, R, -np.linalg.inv(matrix[:3, :3] @ OPENGL) @ matrix[:3, 3])


def _applied(path: Path, content: dict[str, Any]) -> Floats:
    """The rotation and shift (3, 4) that took the world of the reconstruction to that of the file; scale stays in.

    Without them the cameras are those of the reconstruction that the file was made of.
    """
    try:
        matrix = np.atleast_1d(np.array(content.get("applied_transform", np.eye(4)[:3]), dtype=np.float64))[:3]
        if matrix.shape != (3, 4) or not np.isfinite(matrix).all():
            raise ValueError(f"shape {matrix.shape}")
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(f"applied_transform is no 3x4 matrix ({error})", where=path) from error
    U, stretch, Vt = np.linalg.svd(matrix[:, :3])
    if np.ptp(stretch) > MAX_DRIFT * stretch.max() or np.linalg.det(matrix[:, :3]) <= 0:
        raise BadInput("applied_transform mirrors or stretches the world", where=path, remedy="Remove it")
    return np.concatenate([U @ Vt, matrix[:, 3:]], axis=1)


def _size_of_first(path: Path, content: dict[str, Any]) -> dict[str, int]:
    """Width and height of the first image that is there, for files that do not give them (Blender's)."""
    rows = content["frames"]
    if "w" in content or all("w" in row for row in rows):
        return {}
    for row in rows:
        image = str(row.get("file_path"))
        for candidate in (path.parent / f"{image}{suffix}" for suffix in ("", ".png", ".jpg")):
            if _is_there(candidate):
                height, width = read_image(candidate).shape[:2]
                return {"w": width, "h": height}
    raise BadInput("gives no image size, and none of its images is there", where=path, remedy="Add `w` and `h`")


def _ply_points(path: Path, content: dict[str, Any]) -> tuple[Floats | None, NDArray[np.uint8] | None]:
    ply = path.parent / str(content.get("ply_file_path") or "")
    if not _is_there(ply):
        return None, None
    points = read_ply(ply)
    return points.xyz, points.rgb


def _is_there(path: Path) -> bool:
    """Is a file there, also by a name that no disk can have?"""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
