"""Cameras that are given: read from COLMAP's models, made into a model, entered into a database, triangulated."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.cameras.colmap.base import ColmapError, explained, opened, pycolmap
from pipeline.cameras.colmap.damage import damaged_file
from pipeline.cameras.colmap.model import Model, _frame_number, _opencv_intrinsics
from pipeline.geometry import Camera, Floats


@dataclass(frozen=True)
class NamedModel:
    """A model of any images: cameras by the images' names as written in it, points (N, 3) and their colours (N, 3)."""

    cameras: dict[str, Camera]
    xyz: Floats
    rgb: NDArray[np.uint8]


def read_named_model(folder: Path) -> NamedModel:
    """Read a model whose images have names of their own, text or binary, with or without rigs.

    Raises:
        BadInput: a file is damaged or missing, a camera is not of OpenCV's four-parameter family.
    """
    what, remedy = "holds a COLMAP model that cannot be read", "Export it again from COLMAP"
    damaged = damaged_file(folder)
    if damaged is not None:
        raise BadInput(f"{what} ({damaged.name} is damaged or cut off)", where=folder, remedy=remedy)
    try:
        found = pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, IndexError) as error:
        raise BadInput(f"{what} ({error})", where=folder, remedy=remedy) from error
    cameras = {}
    for _, image in sorted(found.images.items()):
        if not image.has_pose:
            continue
        lens = found.cameras[image.camera_id]
        try:
            K, distortion = _opencv_intrinsics(lens)
        except ColmapError as error:
            remedy = "Undistort the images with `colmap image_undistorter`, and give those with their model"
            raise BadInput(error.what, where=folder, remedy=remedy) from error
        pose = image.cam_from_world()
        R, t = pose.rotation.matrix(), np.array(pose.translation)
        cameras[str(image.name)] = Camera(int(lens.width), int(lens.height), K, distortion, R, t)
    points = [point for _, point in sorted(found.points3D.items())]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    return NamedModel(cameras, xyz, np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3))


def model_of_cameras(cameras: dict[int, Camera], frames: Sequence[int]) -> Model:
    """A model of posed views without points.

    Args:
        cameras: by frame number. Equal intrinsics are one camera of the model.
        frames: numbers of all frames that have an image; an image's id is its place in this list, from 1.
    """
    model = pycolmap.Reconstruction()
    lenses: dict[tuple[float, ...], int] = {}
    place = {number: i for i, number in enumerate(frames, start=1)}
    for number, camera in sorted(cameras.items()):
        lens = _lens(camera)
        key = (lens.width, lens.height, *lens.params)
        if key not in lenses:
            lens.camera_id = lenses[key] = len(lenses) + 1
            model.add_camera_with_trivial_rig(lens)
        image = pycolmap.Image(name=f"{number:06d}.jpg", camera_id=lenses[key], image_id=place[number])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.asarray(camera.R, float)), np.asarray(camera.t, float))
        model.add_image_with_trivial_frame(image, pose)
    return Model(model)


def _lens(camera: Camera) -> pycolmap.Camera:
    kind = "OPENCV" if camera.is_distorted else "PINHOLE"
    lens = pycolmap.Camera.create_from_model_name(1, kind, 1.0, camera.width, camera.height)
    K = camera.K
    lens.params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *(camera.distortion if camera.is_distorted else ())]
    lens.has_prior_focal_length = True
    return lens


def enter_model(database: Path, model: Model, frames: Sequence[int]) -> None:
    """Enter a model's cameras and images into a new database under their ids.

    Frames of `frames` that the model does not hold are entered too, with the first camera.
    """
    found = model._reconstruction
    camera_of = {_frame_number(image.name): image.camera_id for image in found.images.values()}
    first = min(found.cameras)
    _enter(database, found.cameras.values(), [(number, camera_of.get(number, first)) for number in frames])


def enter_images(database: Path, sizes: dict[int, tuple[int, int]]) -> None:
    """Enter images whose cameras are unknown into a new database: COLMAP's own first guess, one camera a size.

    Args:
        sizes: width and height by frame number; ids follow the order.
    """
    lenses: dict[tuple[int, int], pycolmap.Camera] = {}
    for width, height in sizes.values():
        if (width, height) not in lenses:
            camera_id, focal = len(lenses) + 1, 1.2 * max(width, height)
            lens = pycolmap.Camera.create_from_model_name(camera_id, "SIMPLE_RADIAL", focal, width, height)
            lenses[width, height] = lens
    _enter(database, lenses.values(), [(number, lenses[size].camera_id) for number, size in sizes.items()])


def _enter(database: Path, cameras: Iterable[pycolmap.Camera], images: list[tuple[int, int]]) -> None:
    """Cameras under their ids, a rig for each; images (frame number, camera id), a frame for each, ids from 1."""
    with opened(database) as db:
        for camera in sorted(cameras, key=lambda camera: camera.camera_id):
            db.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera.camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            db.write_rig(rig, use_rig_id=True)
        for place, (number, camera_id) in enumerate(images, start=1):
            image = pycolmap.Image(name=f"{number:06d}.jpg", camera_id=camera_id, image_id=place)
            db.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=place, rig_id=camera_id)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)


def triangulate(database: Path, images: Path, model: Model, scratch: Path, *, seed: int, threads: int) -> Model:
    """The same cameras with points triangulated from the database's matches; the cameras stay as they are."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=seed)
    options.mapper.num_threads, options.mapper.random_seed = threads, seed
    scratch.mkdir(parents=True, exist_ok=True)
    with explained("points could not be triangulated", images):
        return Model(pycolmap.triangulate_points(model._reconstruction, database, images, scratch, options=options))


def add_points(
    model: Model, xyz: Floats, rgb: NDArray[np.uint8], seen: Iterable[tuple[int, NDArray[np.integer], Floats]]
) -> Model:
    """Put points into a model without any.

    Args:
        xyz, rgb: (N, 3) positions and colours.
        seen: for each frame its number, the indices (M,) of the points it sees, and their pixels (M, 2).
    """
    found = model._reconstruction
    id_of = {_frame_number(image.name): image.image_id for image in found.images.values()}
    tracks = [pycolmap.Track() for _ in xyz]
    for number, indices, pixels in seen:
        image = found.image(id_of[number])
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        for place, index in enumerate(indices):
            tracks[int(index)].add_element(image.image_id, place)
    for point, colour, track in zip(xyz, rgb, tracks, strict=True):
        if track.length() >= 2:
            found.add_point3D(point, track, colour)
    return model


def read_verified_matches(database: Path) -> Iterator[tuple[int, int, NDArray[np.float32], NDArray[np.float32]]]:
    """The verified matches of each pair of frames: the two frame numbers, and pixels (N, 2) in the two images."""
    with opened(database) as db:
        images = {image.image_id: image for image in db.read_all_images()}
        pixels = {number: db.read_keypoints(number)[:, :2] for number in images}
        for pair_id, count in zip(*db.read_two_view_geometry_num_inliers(), strict=True):
            if not count:
                continue
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            rows = np.asarray(db.read_two_view_geometry(a, b).inlier_matches, dtype=np.int64).reshape(-1, 2)
            yield (
                _frame_number(images[a].name),
                _frame_number(images[b].name),
                pixels[a][rows[:, 0]],
                pixels[b][rows[:, 1]],
            )
