"""The one door to COLMAP: nothing else imports pycolmap, whose API drifts from release to release.

Everything here runs on the CPU with the given seed and number of threads. With one thread the same input gives the
same bytes. Errors of COLMAP's C++ checks come out as `ColmapError`; it can also abort the process or eat memory, so
callers run a reconstruction in a child process with limits.
"""

from __future__ import annotations

import ctypes
import re
import signal
import threading

# zlib comes before pycolmap: the wheel exports deflate symbols of its own, and if they are bound first, a later
# zlib.compress, gzip write, np.savez_compressed or PNG encode aborts the process ("free(): invalid pointer").
import zlib  # noqa: F401
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from dope.common.errors import BadInput, DopeError
from pipeline import sequence as prepared
from pipeline.geometry import Camera, Similarity
from pipeline.sparse_points import SparsePoints

CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]
IMAGE_NAME = re.compile(r"(\d+)\.jpg$")

pycolmap.logging.logtostderr = True  # else glog leaves files in the temporary folder
pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)  # whatever matters is checked in the results
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is not None:
    # importing pycolmap installs a C++ handler of SIGTERM; Python still knows the one that was there
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


class ColmapError(DopeError):
    """COLMAP refused its input or failed inside."""


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
        with _explained("model could not be written", folder):
            self._reconstruction.write_binary(folder)

    def _registered(self) -> list[pycolmap.Image]:
        return [image for image in self._reconstruction.images.values() if image.has_pose]


def read_model(folder: Path) -> Model:
    """Read a sparse model that `Model.write` or COLMAP wrote. Raises `BadInput` where there is none."""
    if not any((folder / f"points3D.{suffix}").is_file() for suffix in ("bin", "txt")):
        raise BadInput("holds no COLMAP model", where=folder, remedy="Run `dope prep colmap` first")
    with _explained("model cannot be read", folder):
        return Model(pycolmap.Reconstruction(folder))


def read_points(sequence: prepared.Sequence) -> SparsePoints:
    """The sparse points of a reconstructed sequence, in its frame and unit. Raises `BadInput` where there are none."""
    return read_model(sequence.sparse).points()


# ---------------------------------------------------------------------------------------------- features and matches


@dataclass(frozen=True)
class Intrinsics:
    """How cameras are shared between images and what is known of them.

    Attributes:
        model: COLMAP's name of the camera model.
        shared: one camera for all images of a size; else one an image.
        focal_factor: known focal length as a multiple of the longer image side, or None.
    """

    model: CameraModel = "SIMPLE_RADIAL"
    shared: bool = True
    focal_factor: float | None = None


def import_images(database: Path, images: Path, names_by_size: dict[tuple[int, int], list[str]], k: Intrinsics) -> None:
    """Enter images into a new database, all those of one (width, height) with one camera, ids in the given order."""
    with _open(database):
        pass  # creates the tables
    mode = pycolmap.CameraMode.SINGLE if k.shared else pycolmap.CameraMode.PER_IMAGE
    with _explained("images could not be entered", images):
        for (width, height), names in names_by_size.items():
            options = pycolmap.ImageReaderOptions(camera_model=k.model)
            if k.focal_factor is not None:
                camera = pycolmap.Camera.create_from_model_name(
                    1, k.model, k.focal_factor * max(width, height), width, height
                )
                options.camera_params = camera.params_to_string()
            pycolmap.import_images(database, images, mode, names, options)


def extract_features(
    database: Path,
    images: Path,
    names: Sequence[str],
    *,
    masks: Path | None,
    max_image_size: int,
    first_octave: int,
    max_features: int,
    threads: int,
) -> None:
    """SIFT features of images entered before. `masks` holds `a.jpg.png` for `a.jpg`; black is ignored."""
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    extraction = pycolmap.FeatureExtractionOptions(
        use_gpu=False,
        num_threads=threads,
        max_image_size=max_image_size,
        sift=pycolmap.SiftExtractionOptions(first_octave=first_octave, max_num_features=max_features),
    )
    with _explained("features could not be extracted", images):
        pycolmap.extract_features(
            database, images, list(names), reader_options=reader, extraction_options=extraction, device=_CPU
        )


def read_features(database: Path) -> dict[str, tuple[NDArray[np.float32], NDArray[np.uint8]]]:
    """Name -> scales (N,) and SIFT descriptors (N, 128) of each image's features."""
    result = {}
    with _open(database) as db:
        for image in db.read_all_images():
            keypoints = db.read_keypoints(image.image_id)
            if not len(keypoints):
                result[image.name] = (np.zeros(0, np.float32), np.zeros((0, 128), np.uint8))
                continue
            a11, a12, a21, a22 = keypoints[:, 2:6].T  # x and y come first, then the affine shape
            descriptors = np.asarray(db.read_descriptors(image.image_id).data, dtype=np.uint8)
            result[image.name] = (np.sqrt(np.abs(a11 * a22 - a12 * a21)), descriptors)
    return result


def match_pairs(database: Path, pairs: Sequence[tuple[str, str]], *, guided: bool, seed: int, threads: int) -> None:
    """Match and geometrically verify exactly these pairs of images.

    Args:
        guided: match the pairs that pass once more, along their epipolar lines, which finds more matches. Only those:
            guided matching costs several times as much, and finds nothing where nothing passed.
    """
    _match(database, pairs, guided=False, seed=seed, threads=threads)
    if not guided:
        return
    passed = [(a, b) for a, b, _ in read_verified_pairs(database)]
    with _open(database) as db:
        number = {image.name: image.image_id for image in db.read_all_images()}
        for a, b in passed:
            db.delete_matches(number[a], number[b])
            db.delete_two_view_geometry(number[a], number[b])
    _match(database, passed, guided=True, seed=seed, threads=threads)


def _match(database: Path, pairs: Sequence[tuple[str, str]], *, guided: bool, seed: int, threads: int) -> None:
    if not pairs:
        return
    pycolmap.set_random_seed(seed)
    listing = database.with_suffix(".pairs.txt")
    listing.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=threads, guided_matching=guided)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listing)
    with _explained("images could not be matched", database):
        pycolmap.match_image_pairs(database, matching, pairing, verification, device=_CPU)


def read_verified_pairs(database: Path) -> list[tuple[str, str, int]]:
    """Pairs of image names with their number of verified matches, those without any left out."""
    with _open(database) as db:
        name = {image.image_id: image.name for image in db.read_all_images()}
        pair_ids, counts = db.read_two_view_geometry_num_inliers()
    pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids]
    return sorted((name[a], name[b], int(n)) for (a, b), n in zip(pairs, counts, strict=True) if n)


@dataclass(frozen=True)
class MatchedPair:
    """All matches of two images that share a two-view geometry.

    Attributes:
        first_px, second_px: (N, 2) positions in the two images.
        verified: (N,) bool, True where the match agrees with the geometry.
    """

    first_px: NDArray[np.float32]
    second_px: NDArray[np.float32]
    verified: NDArray[np.bool_]


def read_matched_pairs(database: Path) -> Iterator[MatchedPair]:
    """The matches of all verified pairs, in the order of the images' ids."""
    with _open(database) as db:
        pixels = {image.image_id: db.read_keypoints(image.image_id)[:, :2] for image in db.read_all_images()}
        for pair_id, number in zip(*db.read_two_view_geometry_num_inliers(), strict=True):
            if not number:
                continue
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            matches = np.asarray(db.read_matches(a, b), dtype=np.int64).reshape(-1, 2)
            inliers = np.asarray(db.read_two_view_geometry(a, b).inlier_matches, dtype=np.int64).reshape(-1, 2)
            width = len(pixels[b]) + 1
            verified = np.isin(matches @ [width, 1], inliers @ [width, 1])
            yield MatchedPair(pixels[a][matches[:, 0]], pixels[b][matches[:, 1]], verified)


def map_incrementally(
    database: Path,
    images: Path,
    output: Path,
    *,
    relaxed: bool,
    min_model_size: int,
    refine_focal: bool,
    seed: int,
    threads: int,
) -> list[Model]:
    """Incremental structure from motion; the models it finds, largest first (none: an empty list).

    Args:
        relaxed: accept frames and a first pair with fewer inliers.
        min_model_size: smaller models are not kept, unless it is the only one.
    """
    pycolmap.set_random_seed(seed)
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=threads,
        random_seed=seed,
        min_model_size=min_model_size,
        max_num_models=8,
        ba_refine_focal_length=refine_focal,
    )
    options.mapper.num_threads, options.mapper.random_seed = threads, seed
    if relaxed:
        options.mapper.init_min_num_inliers = 50
        options.mapper.abs_pose_min_num_inliers = 15
        options.mapper.abs_pose_min_inlier_ratio = 0.15
    output.mkdir(parents=True, exist_ok=True)
    with _explained("mapper failed", images):
        found = pycolmap.incremental_mapping(database, images, output, options)
    models = [Model(reconstruction) for _, reconstruction in sorted(found.items())]
    return sorted(models, key=lambda model: (-len(model.frames), -model.n_points))


# --------------------------------------------------------------------------------------------------- dense, on a GPU


def has_cuda_gpu() -> bool:
    """True where dense stereo can run: pycolmap built with CUDA and a GPU that its driver can start."""
    if not pycolmap.has_cuda:
        return False
    try:  # the CUDA wheel says has_cuda without a GPU, and then aborts the process
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int(0)
    return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0


def undistort(sparse: Path, images: Path, workspace: Path, *, max_image_size: int = -1, n_sources: int = 20) -> None:
    """Write COLMAP's dense workspace: undistorted images, their model, and each view's source views."""
    with _explained("images could not be undistorted", images):
        pycolmap.undistort_images(
            workspace,
            sparse,
            images,
            num_patch_match_src_images=n_sources,
            undistort_options=pycolmap.UndistortCameraOptions(max_image_size=max_image_size),
        )


def patch_match(workspace: Path, *, gpu: int = 0, max_image_size: int = -1, geometric: bool = True) -> None:
    """CUDA PatchMatch stereo over a dense workspace; writes `stereo/depth_maps/*.geometric.bin` (or photometric)."""
    if not has_cuda_gpu():
        raise ColmapError(
            "PatchMatch stereo needs a CUDA GPU and the pycolmap-cuda12 wheel",
            where=workspace,
            remedy="Use the CPU's dense stereo instead",
        )
    options = pycolmap.PatchMatchOptions(gpu_index=str(gpu), max_image_size=max_image_size, geom_consistency=geometric)
    with _explained("PatchMatch stereo failed", workspace):
        pycolmap.patch_match_stereo(workspace, options=options)


_CPU = pycolmap.Device.cpu


@contextmanager
def _explained(what: str, where: Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, RuntimeError, IndexError) as error:  # what pycolmap makes of C++ checks and exceptions
        raise ColmapError(f"{what} ({error})", where=where) from error


@contextmanager
def _open(database: Path) -> Iterator[pycolmap.Database]:
    with _explained("database cannot be read", database):
        db = pycolmap.Database.open(database)
        try:
            yield db
        finally:
            db.close()


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
