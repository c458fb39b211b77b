"""Views: square, undistorted, antialiased crops around the object, with their exact cameras.

A view keeps the viewing rotation of its frame; the crop only shifts the principal point and changes the scale, so that
a view is a pinhole camera like any other.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dope.common import settings
from dope.common.errors import BadInput
from pipeline.correspond.depth_sampling import DepthSampler
from pipeline.geometry import Camera
from pipeline.sequence import Frame, Sequence, write_image

VIEW_SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),
        ("image", pa.string()),  # paths relative to the sequence
        ("mask", pa.string()),
        ("fx", pa.float64()),  # pinhole, pixels of the crop
        ("fy", pa.float64()),
        ("cx", pa.float64()),
        ("cy", pa.float64()),
        ("R", pa.list_(pa.float64())),  # row-major, world to camera
        ("t", pa.list_(pa.float64())),
        ("size", pa.int32()),  # side of the view in pixels
        ("mask_share", pa.float64()),  # of the view's pixels
        ("depth_share", pa.float64()),  # of the mask's pixels
        ("inside_share", pa.float64()),  # of the view's pixels that the stored image covers
        ("crop_x", pa.float64()),  # the square in the stored image before undistortion, approximate, for people
        ("crop_y", pa.float64()),
        ("crop_size", pa.float64()),
    ]
)


@dataclass(frozen=True)
class ViewsConfig:
    """Which frames become views, and how they are cut."""

    every: int = 3
    """Every how many of the kept frames one becomes a view (the paper: 3)."""
    min_views: int = 20
    """Take frames more densely where fewer than this many would be left of a short sequence."""
    size: int = 224
    """Side of the square views in pixels."""
    crop: Literal["auto", "object", "whole"] = "auto"
    """"object": the square around it; "whole": the largest square in the middle of the image; "auto": whole for
    renders, whose cameras were drawn so that the object fills more or less of the view, else object."""
    margin: float = 0.1
    """Room around the object's bounding box, as a share of its longer side, on each side; less at the image's edge."""
    min_object_px: int = 24
    """Frames whose object is smaller than this (longer side, in the stored image) are left out."""
    jpeg_quality: int = 95
    """Quality of the views' JPEG files."""
    depth_jump: float = 0.03
    """Relative difference from which neighbouring depths belong to different surfaces."""

    def __post_init__(self) -> None:
        settings.require_at_least(self, every=1, size=16, margin=0)


@dataclass(frozen=True)
class View:
    """One view of the object in memory.

    Attributes:
        frame: number of the frame it was cut from.
        image: (size, size, 3) uint8, BGR.
        mask: (size, size) bool, True = object.
        depth: (size, size) float32 z-depth at the pixel centres, 0 = unknown; None where the frame has none.
        camera: the pinhole camera of the crop.
        inside_share: share of the pixels that the stored image covers; the rest repeats its border.
        crop: x, y, size of the square in the stored image before undistortion, approximate.
    """

    frame: int
    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    depth: NDArray[np.float32] | None
    camera: Camera
    inside_share: float
    crop: tuple[float, float, float]


def sample_frames(frames: list[Frame], config: ViewsConfig) -> list[Frame]:
    """Every `every`-th of the kept frames, in order of their numbers; short sequences are sampled more densely."""
    kept = sorted((frame for frame in frames if frame.dropped is None), key=lambda frame: frame.frame)
    return kept[:: sampling_step(len(kept), config)]


def sampling_step(n_frames: int, config: ViewsConfig) -> int:
    """Every how many of `n_frames` kept frames one is taken."""
    step = max(1, config.every)
    while step > 1 and math.ceil(n_frames / step) < config.min_views:
        step -= 1
    return step


def build_views(sequence: Sequence, config: ViewsConfig, skipped: Counter[str] | None = None) -> Iterator[View]:
    """Cut the views of a sequence one after the other.

    Args:
        skipped: counts why sampled frames did not become views.

    Raises:
        BadInput: no frame has a camera, or none has a mask.
    """
    skipped = Counter() if skipped is None else skipped
    frames = sequence.read_frames()
    if not any(frame.registered for frame in frames):
        raise BadInput("no frame has a camera", where=sequence.folder, remedy="Run `dope prep colmap` first")
    if not any(frame.mask for frame in frames):
        raise BadInput("has no masks of the object", where=sequence.folder, remedy="Run `dope prep masks` first")
    if config.crop == "auto":
        config = replace(config, crop="whole" if sequence.read_info().kind == "render" else "object")
    for frame in sample_frames(frames, config):
        view = _view_of(sequence, frame, config) if frame.registered and frame.image else "not registered"
        if isinstance(view, View):
            yield view
        else:
            skipped[view] += 1


def _view_of(sequence: Sequence, frame: Frame, config: ViewsConfig) -> View | str:
    """The view of a frame, or why there is none."""
    mask = sequence.read_mask(frame)
    if mask is None:
        return "no mask"
    image, camera = sequence.read_image(frame), frame.camera
    if image.shape[:2] != mask.shape or image.shape[:2] != (camera.height, camera.width):
        where = sequence.folder / str(frame.mask)
        expected = f"{camera.width} x {camera.height}"
        raise BadInput(f"image and mask must both be {expected} pixels", where=where, remedy="Run `dope prep masks`")
    extent = object_extent(mask)
    if extent is None:
        return "empty mask"
    small = max(np.ptp(extent[:, 0]), np.ptp(extent[:, 1])) + 1 < config.min_object_px
    if small and config.crop != "whole":
        return f"object smaller than {config.min_object_px} px"
    return cut_view(frame.frame, camera, image, mask, sequence.read_depth(frame), extent, config)


def object_extent(mask: NDArray[np.bool_]) -> NDArray[np.floating] | None:
    """Centres (N, 2) of the outline's pixels of the object's parts; parts under 1% of it are specks and ignored."""
    n, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if n < 2:
        return None
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0  # the background
    solid = (areas >= 0.01 * areas.sum())[labels].astype(np.uint8)
    inner = cv2.erode(solid, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    rows, columns = np.nonzero(solid & (1 - inner))
    return np.stack([columns, rows], axis=1) + 0.5


def crop_camera(camera: Camera, extent: NDArray[np.floating], size: int, margin: float) -> Camera:
    """The pinhole camera of the square around the object: same centre, rotation and aspect as `camera`.

    The square has the object in its middle, or is shifted to stay within the image where it can.

    Args:
        extent: (N, 2) pixels of the object's outline in the stored image.
    """
    outline = camera.to_normalised(extent) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]  # undistorted pixels
    low, high = outline.min(axis=0) - 0.5, outline.max(axis=0) + 0.5
    image = np.array([camera.width, camera.height], dtype=np.float64)
    object_side = float((high - low).max())
    # the margin gives way where the image ends: what lies beyond would only be a repeated border
    side = max(object_side, min(object_side * (1 + 2 * margin), float(image.min())))
    centred = (low + high - side) / 2
    shifted = np.clip(np.clip(centred, 0, np.maximum(0, image - side)), high - side, low)
    corner = np.where(side <= image, shifted, centred)
    K = np.diag([size / side, size / side, 1.0]) @ np.array([[1, 0, -corner[0]], [0, 1, -corner[1]], [0, 0, 1.0]])
    return Camera(size, size, K @ camera.K, np.zeros(4), camera.R, camera.t)


def middle_camera(camera: Camera, size: int) -> Camera:
    """The pinhole camera of the largest square in the middle of an image, `size` pixels wide."""
    side = min(camera.width, camera.height)
    shift = np.array([[1, 0, -(camera.width - side) / 2], [0, 1, -(camera.height - side) / 2], [0, 0, 1.0]])
    K = np.diag([size / side, size / side, 1.0]) @ shift @ camera.K
    return Camera(size, size, K, np.zeros(4), camera.R, camera.t)


def cut_view(
    number: int,
    camera: Camera,
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    depth: NDArray[np.float32] | None,
    extent: NDArray[np.floating],
    config: ViewsConfig,
) -> View:
    """Resample image, mask and depth of one frame into the square around the object.

    Args:
        number: of the frame.
        camera: of the stored image.
        image, mask: (height, width, 3) and (height, width), of the size of `camera`.
        depth: (h, w) z-depth of the same view, maybe smaller, 0 = unknown, or None.
        extent: (N, 2) outline of the object, see `object_extent`.
    """
    size = config.size
    if config.crop == "whole":
        crop = middle_camera(camera, size)
        same = (camera.width, camera.height) == (size, size) and not camera.is_distorted
        if same and (depth is None or depth.shape == mask.shape):  # nothing is to be resampled
            return View(number, image, mask, depth, crop, 1.0, (0.0, 0.0, float(size)))
    else:
        crop = crop_camera(camera, extent, size, config.margin)
    scale = camera.K[0, 0] / crop.K[0, 0]  # stored pixels a pixel of the view
    # at least as many samples as there are stored pixels, then a box filter: no aliasing, and no shift of half a pixel
    finer = max(1, math.ceil(scale - 1e-6))
    x, y = _source_map(camera, crop, finer)
    fine: NDArray[Any] = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    fine_mask: NDArray[Any] = cv2.remap(
        mask.astype(np.uint8) * 255, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    if finer > 1:
        fine = cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA)
        fine_mask = cv2.resize(fine_mask, (size, size), interpolation=cv2.INTER_AREA)
        x, y = _source_map(camera, crop, 1)
    x, y = x + np.float32(0.5), y + np.float32(0.5)
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    z = None
    if depth is not None:
        z = np.zeros((size, size), np.float32)
        h, w = depth.shape
        sampler = DepthSampler(depth, config.depth_jump)
        z[inside] = sampler(x[inside] * np.float32(w / camera.width), y[inside] * np.float32(h / camera.height))
    side = float(size * scale)
    left, top = camera.to_pixels(crop.to_normalised(np.array([[size / 2, size / 2]])))[0] - side / 2
    square = (float(left), float(top), side)
    return View(number, fine, (fine_mask > 127) & inside, z, crop, float(inside.mean()), square)


def _source_map(camera: Camera, crop: Camera, finer: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """OpenCV's remap tables: for each pixel of the crop, `finer` times larger, where it lies in the stored image."""
    large = crop.resized(crop.width * finer, crop.height * finer)
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV's pixel centres are whole numbers
    size = (large.width, large.height)
    x, y = cv2.initUndistortRectifyMap(camera.K - half, camera.distortion, None, large.K - half, size, cv2.CV_32FC1)
    return x, y


def write_view(folder: Path, view: View, config: ViewsConfig) -> dict[str, Any]:
    """Write a view's image and mask into `folder` (the sequence's views/ in the making) and return its row."""
    write_image(folder / f"{view.frame:06d}.jpg", view.image, jpeg_quality=config.jpeg_quality)
    write_image(folder / f"{view.frame:06d}.png", view.mask.astype(np.uint8) * 255)
    n_mask = max(1, int(view.mask.sum()))
    K = view.camera.K
    return {
        "frame": view.frame,
        "image": f"views/{view.frame:06d}.jpg",
        "mask": f"views/{view.frame:06d}.png",
        "fx": float(K[0, 0]),
        "fy": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "R": view.camera.R.ravel().tolist(),
        "t": view.camera.t.tolist(),
        "size": view.camera.width,
        "mask_share": float(view.mask.mean()),
        "depth_share": 0.0 if view.depth is None else float((view.depth[view.mask] > 0).sum() / n_mask),
        "inside_share": view.inside_share,
        **dict(zip(("crop_x", "crop_y", "crop_size"), view.crop, strict=True)),
    }


def views_table(sequence: Sequence) -> Path:
    """Where the rows of a sequence's views are kept."""
    return sequence.folder / "views.parquet"


def read_views(sequence: Sequence) -> list[dict[str, Any]]:
    """The rows of views.parquet, in order of frames. Raises `BadInput` where it is absent or damaged."""
    path = views_table(sequence)
    try:
        return pq.read_table(path).to_pylist()
    except (OSError, pa.ArrowInvalid) as error:
        raise BadInput(f"cannot be read ({error})", where=path, remedy="Run `dope prep correspond` again") from error


def view_camera(row: Mapping[str, Any]) -> Camera:
    """The pinhole camera of a row of views.parquet."""
    K = np.array([[row["fx"], 0, row["cx"]], [0, row["fy"], row["cy"]], [0, 0, 1.0]])
    size = int(row["size"])
    return Camera(size, size, K, np.zeros(4), np.array(row["R"]).reshape(3, 3), np.array(row["t"]))


def view_to_source_pixels(row: Mapping[str, Any], frame: Frame, points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Pixels (N, 2) of a view to pixels (N, 2) of the stored, distorted image it was cut from.

    Args:
        row: of views.parquet.
        frame: the frame of the same number.
    """
    return frame.camera.to_pixels(view_camera(row).to_normalised(np.asarray(points, dtype=np.float64)))


def source_to_view_pixels(row: Mapping[str, Any], frame: Frame, points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Pixels (N, 2) of the stored, distorted image to pixels (N, 2) of the view cut from it."""
    camera = view_camera(row)
    return camera.to_pixels(frame.camera.to_normalised(np.asarray(points, dtype=np.float64)))
