"""Cameras in files as other tools write them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from synthetic import orbit

from pipeline.cameras.colmap.base import pycolmap
from pipeline.geometry import Camera

CAMERAS = orbit(9, arc_deg=72, distortion=(0.05, -0.02, 0.001, -0.0005))
NAMES = [f"{i:04d}.jpg" for i in range(len(CAMERAS))]


def named(cameras: list[Camera] = CAMERAS) -> dict[str, Camera]:
    return dict(zip(NAMES, cameras, strict=True))


def quaternion(R: np.ndarray) -> list[float]:
    """w, x, y, z of a rotation by less than 180 degrees."""
    w = math.sqrt(max(0.0, 1 + np.trace(R))) / 2
    return [w, *((R[[2, 0, 1], [1, 2, 0]] - R[[1, 2, 0], [2, 0, 1]]) / (4 * w))]


def write_colmap_text(folder: Path, cameras: dict[str, Camera], model: str = "OPENCV") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    lenses, images = ["# a comment"], ["# another"]
    for number, (name, camera) in enumerate(cameras.items(), start=1):
        K, d = camera.K, camera.distortion
        parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d][: 8 if model.startswith("OPENCV") else 4]
        size = f"{camera.width} {camera.height}"
        lenses.append(f"{number} {model} {size} {' '.join(repr(float(p)) for p in parameters)}")
        pose = " ".join(repr(float(v)) for v in (*quaternion(camera.R), *camera.t))
        images += [f"{number} {pose} {number} {name}", ""]
    (folder / "cameras.txt").write_text("\n".join(lenses) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")
    (folder / "points3D.txt").write_text("")
    return folder


def write_colmap_binary(folder: Path, cameras: dict[str, Camera]) -> Path:
    text = write_colmap_text(folder.with_name("text"), cameras)
    folder.mkdir()
    pycolmap.Reconstruction(text).write_binary(folder)
    return folder


def transforms(cameras: dict[str, Camera], world: np.ndarray | None = None, **more: Any) -> dict[str, Any]:
    """nerfstudio's values; `world` (3, 4) turns and shifts the world as `ns-process-data` does."""
    frames = []
    for name, camera in cameras.items():
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.R.T @ np.diag([1, -1, -1]), camera.centre
        if world is not None:
            pose[:3, :] = world[:, :3] @ pose[:3, :] + np.pad(world[:, 3:], ((0, 0), (3, 0)))
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    first = next(iter(cameras.values()))
    values = {"camera_model": "OPENCV", "w": first.width, "h": first.height, "fl_x": first.K[0, 0]}
    values |= {"fl_y": first.K[1, 1], "cx": first.K[0, 2], "cy": first.K[1, 2]}
    values |= dict(zip(("k1", "k2", "p1", "p2"), first.distortion.tolist(), strict=True))
    if world is not None:
        values["applied_transform"] = world.tolist()
    return {**values, **more, "frames": frames}


def write_transforms(folder: Path, cameras: dict[str, Camera], **more: Any) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(transforms(cameras, **more)))
    return folder


def write_cameras_json(folder: Path, cameras: dict[str, Camera]) -> Path:
    rows = []
    for name, camera in cameras.items():
        K = camera.K
        row = {"name": Path(name).stem, "width": camera.width, "height": camera.height, "fx": K[0, 0], "fy": K[1, 1]}
        row |= {"cx": K[0, 2], "cy": K[1, 2], "dist": camera.distortion.tolist()}
        rows.append(row | {"w2c_R": camera.R.tolist(), "w2c_t": camera.t.tolist()})
    path = folder / "cameras.json"
    path.write_text(json.dumps({"frames": rows}))
    return path


NERFSTUDIO_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
SHIFTED_WORLD = np.concatenate([orbit(3)[1].R, [[0.3], [-2.0], [7.0]]], axis=1)
