"""Trees in exactly CO3D's layout, v1 and v2, of the synthetic scene filmed by known cameras."""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from pipeline.co3d.sources import Co3dSource
from pipeline.geometry import Camera
from tests.pipeline.synthetic import Scene, orbit

cv2.setNumThreads(1)

Intrinsics = Literal["ndc_norm_image_bounds", "ndc_isotropic"]
UNIT = 3.7
"""Length of the scene's unit in CO3D's arbitrary unit: what is read must be scaled, not taken as it is."""
SCALE_ADJUSTMENT = 0.25
VIEWPOINT = {"R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "T": [0, 0, 5], "focal_length": [2, 2], "principal_point": [0, 0]}


@dataclass
class Tree:
    """A download on its way: rows are changed by tests before `write`."""

    root: Path
    category: str = "apple"
    version: int = 1
    frames: list[dict[str, Any]] | None = None
    sequences: list[dict[str, Any]] | None = None
    sets: dict[str, list[list[Any]]] | None = None

    def __post_init__(self) -> None:
        self.frames, self.sequences, self.sets = self.frames or [], self.sequences or [], self.sets or {}

    @property
    def folder(self) -> Path:
        return self.root / self.category

    def write(self) -> Tree:
        """Write the annotations and set lists."""
        write_jgz(self.folder / "frame_annotations.jgz", self.frames)
        write_jgz(self.folder / "sequence_annotations.jgz", self.sequences)
        if self.version == 1:
            (self.folder / "set_lists.json").write_text(json.dumps(self.sets))
        else:
            (self.folder / "set_lists").mkdir(exist_ok=True)
            (self.folder / "set_lists/set_lists_fewview_dev.json").write_text(json.dumps(self.sets))
        return self


def row(sequence: str, number: int, **change: Any) -> dict[str, Any]:
    """A frame's row without files on disk."""
    image = {"path": f"apple/{sequence}/images/frame{number}.jpg", "size": [96, 128]}
    return {"sequence_name": sequence, "frame_number": number, "image": image, "viewpoint": VIEWPOINT, **change}


def tree_of(root: Path, frames: list[Any], sequences: list[Any] | None = None, **more: Any) -> Tree:
    """A download that is annotations only."""
    return Tree(root, frames=frames, sequences=sequences or [], **more).write()


def named(name: str, **scores: Any) -> dict[str, Any]:
    """A sequence's row."""
    return {"sequence_name": name, "category": "apple", **scores}


def numbers(source: Co3dSource, every: int = 1) -> list[int]:
    """Of the frames that are wanted of a sequence."""
    return [frame.number for frame in source.frames(every)]


def write_jgz(path: Path, value: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with gzip.open(path, "wt", encoding="utf8") as file:  # as CO3D's dump_dataclass_jgzip does
        json.dump(value, file)
    return path


def to_co3d(camera: Camera, kind: Intrinsics) -> dict[str, Any]:
    """An OpenCV camera as CO3D writes it, derived from PyTorch3D's documentation and not from the code under test.

    A point's NDC coordinate is +1 at the left and upper edge and -1 at the opposite one (along the shorter side, where
    it is isotropic); PyTorch3D projects a view-space point (x left, y up) to focal * x / z + principal_point.
    """
    axes = np.diag([-1.0, -1.0, 1.0])  # camera axes of OpenCV to those of PyTorch3D
    R = (axes @ camera.R).T  # row vectors: X_view = X_world R + T
    T = axes @ camera.t
    size = np.array([camera.width, camera.height], dtype=float)
    half = size / 2 if kind == "ndc_norm_image_bounds" else np.full(2, size.min() / 2)
    focal = camera.K[[0, 1], [0, 1]] / half
    # pixel u has NDC (W/2 - u) / half; a point on the optical axis is seen at the principal point
    principal = (size / 2 - camera.K[:2, 2]) / half
    return {
        "R": R.tolist(),
        "T": T.tolist(),
        "focal_length": focal.tolist(),
        "principal_point": principal.tolist(),
        "intrinsics_format": kind,
    }


def add_sequence(
    tree: Tree,
    name: str,
    cameras: list[Camera],
    *,
    scene: Scene | None = None,
    kind: Intrinsics = "ndc_norm_image_bounds",
    first_number: int = 1,
    quality: Any = 0.9,
    cloud: bool = False,
    set_name: str = "train_known",
) -> list[dict[str, Any]]:
    """Film the scene and add a sequence with images, masks, depths and depth masks; returns its frame rows."""
    scene = scene or Scene()
    rows = []
    place = tree.folder / name
    for folder in ("images", "masks", "depths", "depth_masks"):
        (place / folder).mkdir(parents=True, exist_ok=True)
    for i, camera in enumerate(cameras):
        number, stem = first_number + i, f"frame{first_number + i:06d}"
        image, depth, mask = scene.render(camera)
        base = f"{tree.category}/{name}"
        paths = {
            "image": f"{base}/images/{stem}.jpg",
            "mask": f"{base}/masks/{stem}.png",
            "depth": f"{base}/depths/{stem}.jpg.geometric.png",
            "depth_mask": f"{base}/depth_masks/{stem}.png",
        }
        cv2.imwrite(str(tree.root / paths["image"]), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        # a soft mask: 0.45 at the object's edge is still object, 0.35 is not
        grown = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        cv2.imwrite(str(tree.root / paths["mask"]), np.where(mask, 115, np.where(grown, 89, 0)).astype(np.uint8))
        valid = mask & (depth > 0)
        write_depth(tree.root / paths["depth"], np.where(valid, depth, np.nan) * UNIT / SCALE_ADJUSTMENT)
        cv2.imwrite(str(tree.root / paths["depth_mask"]), valid.astype(np.uint8) * 255)
        rows.append(
            {
                "sequence_name": name,
                "frame_number": number,
                "frame_timestamp": i / 10,
                "image": {"path": paths["image"], "size": [camera.height, camera.width]},
                "depth": {
                    "path": paths["depth"],
                    "scale_adjustment": SCALE_ADJUSTMENT,
                    "mask_path": paths["depth_mask"],
                },
                "mask": {"path": paths["mask"], "mass": float(mask.sum())},
                "viewpoint": to_co3d(replace(camera, t=camera.t * UNIT), kind),
                "meta": {"frame_type": set_name, "frame_splits": [], "eval_batch_maps": []},
            }
        )
        tree.sets.setdefault(set_name, []).append([name, number, paths["image"]])
    tree.frames += rows
    row = {"sequence_name": name, "category": tree.category, "video": None, "viewpoint_quality_score": quality}
    row["point_cloud"] = None
    if cloud:
        row["point_cloud"] = {"path": f"{base}/pointcloud.ply", "quality_score": quality, "n_points": 4000}
        write_ply(place / "pointcloud.ply", surface(scene) * UNIT)
    tree.sequences.append(row)
    return rows


def make_tree(root: Path, *, n: int = 8, version: int = 1, kind: Intrinsics = "ndc_norm_image_bounds") -> Tree:
    """A download with one category of one sequence of small frames, principal point off centre."""
    tree = Tree(root, version=version)
    add_sequence(tree, "110_13051_23361", views(n), kind=kind)
    return tree.write()


def views(n: int = 8, width: int = 128, height: int = 96, arc_deg: float = 80.0) -> list[Camera]:
    """Cameras on an arc, 10 degrees apart for n = 8, whose principal points differ and are off centre."""
    cameras = orbit(n, arc_deg=arc_deg, width=width, height=height, focal=1.2 * max(width, height))
    shifts = [np.array([[0, 0, 5.0 + i % 3], [0, 0, -4.0 - i % 2], [0, 0, 0]]) for i in range(n)]
    return [replace(camera, K=camera.K + shift) for camera, shift in zip(cameras, shifts, strict=True)]


def write_depth(path: Path, depth: np.ndarray) -> None:
    """A 16-bit PNG whose bits are half floats."""
    cv2.imwrite(str(path), depth.astype(np.float16).view(np.uint16))


def surface(scene: Scene, n: int = 4000) -> np.ndarray:
    """Points on the scene's sphere."""
    assert scene.shape == "sphere"
    points = np.random.default_rng(3).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def write_ply(path: Path, points: np.ndarray) -> None:
    """A binary PLY with float positions and uchar colours."""
    kind = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    table = np.zeros(len(points), dtype=kind)
    for i, axis in enumerate("xyz"):
        table[axis] = points[:, i]
    table["red"] = 200
    lines = [f"property {'float' if len(name) == 1 else 'uchar'} {name}" for name, _ in kind]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *lines, "end_header", ""]
    path.write_bytes("\n".join(header).encode() + table.tobytes())
