"""Sparse models: cameras by frame number, and points."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline import sequence as prepared
from pipeline.cameras.colmap.base import ColmapError, explained, pycolmap
from pipeline.cameras.sparse_points import SparsePoints
from pipeline.geometry import Camera, Similarity

IMAGE_NAME = re.compile(r"(\d+)\.jpg$")


class Model:
    """A sparse reconstruction: cameras by frame number, and points."""

    def __init__(self, reconstruction: pycolmap.Reconstruction) -> None:
        self._reconstruction = reconstruction

    @property
    def frames(self) -> list[int]:
        """Numbers of the registered frames, sorted."""
        return sorted(_frame_number(image.name) for image in self._registered())

    @property
    def n_points(self) -> int:
        return self._reconstruction.num_points3D()

    @property
    def mean_error_px(self) -> float:
        """Mean reprojection error over the observations, pixels of the stored images."""
        return self._reconstruction.compute_mean_reprojection_error() if self.n_points else 0.0

    def cameras(self) -> dict[int, Camera]:
        """The registered frames' cameras, in pixels of the stored images, sorted by frame."""
        cameras = {}
        for image in sorted(self._registered(), key=lambda image: image.name):
            pose = image.cam_from_world()
            K, distortion = _opencv_intrinsics(self._reconstruction.cameras[image.camera_id])
            size = self._reconstruction.cameras[image.camera_id]
            cameras[_frame_number(image.name)] = Camera(
                int(size.width), int(size.height), K, distortion, pose.rotation.matrix(), np.array(pose.translation)
            )
        return cameras

    def points(self) -> SparsePoints:
        """All points, in the order of their ids."""
        frame_of = {image.image_id: _frame_number(image.name) for image in self._registered()}
        points = [point for _, point in sorted(self._reconstruction.points3D.items())]
        tracks = [sorted({frame_of[element.image_id] for element in point.track.elements}) for point in points]
        lengths = np.array([len(track) for track in tracks], dtype=np.int64)
        return SparsePoints(
            xyz=np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
            rgb=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
            error=np.array([point.error for point in points], dtype=np.float64),
            point_index=np.repeat(np.arange(len(points), dtype=np.int64), lengths),
            frame=np.array([frame for track in tracks for frame in track], dtype=np.int64),
        )

    def transform(self, similarity: Similarity) -> None:
        """Move the world: X' = s A X + b, points and cameras alike."""
        rotation = pycolmap.Rotation3d(np.asarray(similarity.A, dtype=np.float64))
        self._reconstruction.transform(pycolmap.Sim3d(similarity.s, rotation, np.asarray(similarity.b, dtype=float)))

    def write(self, folder: Path) -> None:
        """Write COLMAP's binary files into an existing folder."""
        with explained("model could not be written", folder):
            self._reconstruction.write_binary(folder)

    def write_text(self, folder: Path) -> None:
        """Write COLMAP's text files into an existing folder."""
        with explained("model could not be written", folder):
            self._reconstruction.write_text(folder)

    def write_ply(self, path: Path) -> None:
        """Write the points and their colours as a PLY file."""
        with explained("points could not be written", path):
            self._reconstruction.export_PLY(path)

    def _registered(self) -> list[pycolmap.Image]:
        return [image for image in self._reconstruction.images.values() if image.has_pose]


def read_model(folder: Path) -> Model:
    """Read a sparse model that `Model.write` or COLMAP wrote. Raises `BadInput` where there is none."""
    if not any((folder / f"points3D.{suffix}").is_file() for suffix in ("bin", "txt")):
        raise BadInput("holds no COLMAP model", where=folder, remedy="Run `dope prep colmap` first")
    with explained("model cannot be read", folder):
        return Model(pycolmap.Reconstruction(folder))


def read_points(sequence: prepared.Sequence) -> SparsePoints:
    """The sparse points of a reconstructed sequence, in its frame and unit. Raises `BadInput` where there are none."""
    return read_model(sequence.sparse).points()


def _frame_number(name: str) -> int:
    match = IMAGE_NAME.search(name)
    if match is None:
        raise ColmapError(f"image '{name}' of the model is not named after a frame, as in 000012.jpg")
    return int(match[1])


def _opencv_intrinsics(camera: pycolmap.Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """K (3, 3) and k1, k2, p1, p2. COLMAP's radial models are OpenCV's with the other terms zero."""
    K = np.array(camera.calibration_matrix(), dtype=np.float64)
    focals = 1 if camera.model_name in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") else 2
    distortion = np.zeros(4)
    if camera.model_name not in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"):
        raise ColmapError(f"camera model {camera.model_name} is not one of OpenCV's four-parameter family")
    extra = camera.params[focals + 2 :]
    distortion[: len(extra)] = extra
    return K, distortion
