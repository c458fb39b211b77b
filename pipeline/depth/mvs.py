"""The depth stage: a z-depth map for every registered frame.

Dense depth on a CPU comes from rectified pairs (`stereo.py`), where a view's estimates from several neighbours must
agree and other views must confirm the result (`depth_filter.py`); with a CUDA device from COLMAP's PatchMatch
(`patchmatch.py`). Sparse depth is the reconstruction's points alone, where frames observe them.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common import settings
from dope.common.errors import BadInput
from pipeline.cameras.sparse_points import Tracks
from pipeline.depth.depth_filter import AgreementConfig, confirmations, drop_islands, fuse, sample_pixels
from pipeline.depth.import_scale import ImportConfig
from pipeline.depth.neighbours import NeighbourConfig, choose_neighbours, sees
from pipeline.depth.stereo import Depth, View, stereo_depth
from pipeline.geometry import Floats, nearest_point_to_axes
from pipeline.sequence import Frame, Sequence, read_image

Report = Callable[[str, int, int], None]  # what, done, of


@dataclass(frozen=True)
class DepthConfig:
    """How depth is computed."""

    mode: Literal["dense", "sparse"] = "dense"
    """dense: every pixel that can be matched; sparse: only the points of the reconstruction."""
    backend: Literal["auto", "sgbm", "patchmatch"] = "auto"
    """sgbm: rectified pairs on the CPU; patchmatch: COLMAP with CUDA; auto: patchmatch where a CUDA device is."""
    long_side: int = 640
    """Long side of the images that are matched, and of the depth maps; smaller images keep their size."""
    neighbours: NeighbourConfig = field(default_factory=NeighbourConfig)
    """Which views a view is matched with."""
    witnesses: NeighbourConfig = field(
        default_factory=lambda: NeighbourConfig(count=8, allowed_deg=(2.0, 40.0), min_baseline_deg=0.0)
    )
    """Which views may confirm its depth: more and farther ones than can be matched."""
    agreement: AgreementConfig = field(default_factory=AgreementConfig)
    """When a depth is believed."""
    min_track: int = 3
    """Frames that must observe a point before it says anything of the range of depths."""
    mask_margin: float = 0.015
    """Frames with a mask get depth inside it and this far around it (share of the long side)."""
    imported: ImportConfig = field(default_factory=ImportConfig)
    """How depth maps made by other tools are read (`--depths`)."""
    fused: bool = False
    """PatchMatch also writes fused.ply: coloured points with normals on which several views agree."""
    threads: int = settings.by_flag("--threads", 1)
    """Threads of OpenCV. The result is the same with any number."""

    def __post_init__(self) -> None:
        settings.require_at_least(self, long_side=32, min_track=1)


def compute_depth(sequence: Sequence, config: DepthConfig) -> dict[str, Any]:
    """Write depth maps for the registered frames of a sequence that has been reconstructed.

    Returns:
        Details of the stage: counts, coverage, agreement with the sparse points, CPU seconds a frame.

    Raises:
        BadInput: fewer than two registered frames, or PatchMatch was asked for without a CUDA device.
    """
    from pipeline.cameras import colmap

    tracks = colmap.read_points(sequence)
    if config.mode == "dense" and config.backend != "sgbm":
        if colmap.has_cuda_gpu():
            from pipeline.depth.patchmatch import patchmatch_depth

            return write_depths(sequence, tracks, config, patchmatch_depth)
        if config.backend == "patchmatch":
            raise BadInput(
                "PatchMatch needs a CUDA device and the pycolmap-cuda12 package",
                where=sequence.folder,
                remedy="Use `--set depth.backend=sgbm`",
            )
    return write_depths(sequence, tracks, config, sparse_depth if config.mode == "sparse" else sgbm_depth)


Method = Callable[[Sequence, list[Frame], list[View], Tracks, DepthConfig], list[Depth | None]]


def write_depths(sequence: Sequence, tracks: Tracks, config: DepthConfig, method: Method) -> dict[str, Any]:
    """Replace the sequence's depth maps by those of `method` and describe them; see `compute_depth`."""
    started = time.process_time()
    frames = sequence.read_frames()
    registered = [frame for frame in frames if frame.registered and frame.image]
    if len(registered) < 2:
        raise BadInput(
            f"{len(registered)} registered frames, depth needs two", where=sequence.folder, remedy="Run the sfm stage"
        )
    clear_depths(sequence, frames)
    with opencv_threads(config.threads):
        long_tracks = tracks.longer_than(config.min_track)
        masked = not sequence.read_info().masks_are_later
        views = [load_view(sequence, frame, long_tracks, config, masked=masked) for frame in registered]
        depths = method(sequence, registered, views, tracks, config)
    stored = store_depths(sequence, registered, views, depths)
    sequence.write_frames(frames)
    details = describe(registered, views, depths, stored, long_tracks)
    details["method"] = method.__name__
    details["cpu_seconds_per_frame"] = round((time.process_time() - started) / len(registered), 3)
    if not details["frames_with_depth"] and all(depth is None for depth in depths):
        details["empty"] = "no frame has a neighbour at a usable angle"
    return details


def store_depths(
    sequence: Sequence, frames: list[Frame], views: list[View], depths: list[Depth | None]
) -> list[Depth | None]:
    """Write depth maps (the caller writes the frames) and return them as they are read back.

    None where a frame has none, or a map without any depth that can be kept: no file is written of those.
    """
    targets = looked_at(views, object_centre(sequence, views))
    stored: list[Depth | None] = []
    for frame, view, target, depth in zip(frames, views, targets, depths, strict=True):
        if depth is None or not depth.any():
            stored.append(None)
            continue
        z = float(view.camera.R[2] @ target + view.camera.t[2])  # NaN where it is not known what the view looks at
        kept = sequence.write_depth(frame, depth, subject=z if z > 0 else None)
        if not kept.any():
            (sequence.folder / str(frame.depth)).unlink()
            frame.depth = frame.depth_scale = None
        stored.append(kept if kept.any() else None)
    return stored


@contextmanager
def opencv_threads(threads: int) -> Iterator[None]:
    """OpenCV works with this many threads inside the block."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def clear_depths(sequence: Sequence, frames: list[Frame]) -> None:
    """Forget old depth: first the rows that name the files, then the files."""
    for frame in frames:
        frame.depth = frame.depth_scale = None
    sequence.write_frames(frames)
    shutil.rmtree(sequence.depths, ignore_errors=True)


def working_size(frame: Frame, long_side: int) -> tuple[int, int]:
    """Width and height of a frame's image with its long side at most `long_side`."""
    scale = min(1.0, long_side / max(frame.width, frame.height))
    return max(1, round(frame.width * scale)), max(1, round(frame.height * scale))


def load_view(
    sequence: Sequence,
    frame: Frame,
    tracks: Tracks,
    config: DepthConfig,
    *,
    masked: bool = True,
    size: tuple[int, int] | None = None,
) -> View:
    """A registered frame at working resolution, with the points that it sees (on the object, where a mask says so).

    Args:
        size: (width, height) in the place of the working resolution.
    """
    size = size or working_size(frame, config.long_side)
    assert frame.image is not None  # registered frames have one
    gray = read_image(sequence.folder / frame.image, cv2.IMREAD_GRAYSCALE)
    if gray.shape != size[::-1]:
        gray = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)
    camera = frame.camera.resized(*size)
    points = tracks.seen_by(frame.frame)
    mask = sequence.read_mask(frame) if masked else None
    if mask is None:
        return View(camera, gray, points)
    margin = max(1, round(config.mask_margin * max(size)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    small = cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) > 127
    region = cv2.dilate(small.astype(np.uint8), kernel) > 0
    pixels, z = camera.project(points)
    on_object = sample_pixels(region, pixels) & (z > 0)
    return View(camera, gray, points[on_object] if on_object.sum() >= 10 else points, region)


def sgbm_depth(
    sequence: Sequence, frames: list[Frame], views: list[View], tracks: Tracks, config: DepthConfig
) -> list[Depth | None]:
    """Depth from rectified pairs, fused within each view and confirmed by others; None = no usable neighbour."""
    cameras, targets = [view.camera for view in views], looked_at(views, object_centre(sequence, views))
    neighbours = choose_neighbours(cameras, targets, config.neighbours)
    witnesses_of = choose_neighbours(cameras, targets, config.witnesses)
    agreement = config.agreement
    estimates = [view_depth(views[i], [views[j] for j in near], agreement) for i, near in enumerate(neighbours)]
    witnesses = [
        np.zeros(view.gray.shape, np.float32)
        if estimate is None
        else np.where(estimate.count >= agreement.min_estimates, estimate.depth, np.float32(0))
        for view, estimate in zip(views, estimates, strict=True)
    ]
    depths: list[Depth | None] = []
    for view, estimate, nearby in zip(views, estimates, witnesses_of, strict=True):
        if estimate is None:
            depths.append(None)
            continue
        others = [(views[j].camera, witnesses[j]) for j in nearby]
        confirming = confirmations(view.camera, estimate.depth, others, agreement.tolerance)
        believed = (confirming > 0) & (estimate.count + confirming >= agreement.min_support)
        depths.append(drop_islands(np.where(believed, estimate.depth, np.float32(0)), agreement.min_island_px))
    return depths


def object_centre(sequence: Sequence, views: list[View]) -> Floats:
    """The middle (3,) of what was filmed: the origin of a normalised sequence, else where the optical axes meet."""
    if sequence.read_info().unit == "object radius":
        return np.zeros(3)
    return nearest_point_to_axes([view.camera for view in views])


def looked_at(views: list[View], centre: Floats) -> Floats:
    """What each view looks at (F, 3): the object's centre where the view sees it, else the median of its points.

    The median alone may lie on the background, from where the cameras seem closer together than they are.
    """
    targets = np.full((len(views), 3), np.nan)
    for i, view in enumerate(views):
        if sees(view.camera, centre):
            targets[i] = centre
        elif len(view.points):
            targets[i] = np.median(view.points, axis=0)
    return targets


@dataclass(frozen=True)
class Estimate:
    """A view's own depth (h, w) before other views confirm it, and how many of its neighbours agree on each pixel."""

    depth: Depth
    count: NDArray[np.uint8]


def view_depth(view: View, neighbours: list[View], agreement: AgreementConfig) -> Estimate | None:
    """The depth of one view from its neighbours, before other views confirm it; None without neighbours."""
    box = view.box
    x0, y0, x1, y1 = box
    if x0 == x1 or len(view.points) < 2:
        return None
    pairs = [pair for other in neighbours if (pair := stereo_depth(view, other, box)) is not None]
    if not pairs:
        return None
    estimates = np.stack([depth for depth, _ in pairs])
    if view.region is not None:
        estimates *= view.region[y0:y1, x0:x1]
    depth, count = np.zeros(view.gray.shape, np.float32), np.zeros(view.gray.shape, np.uint8)
    depth[y0:y1, x0:x1], count[y0:y1, x0:x1] = fuse(estimates, [weight for _, weight in pairs], agreement.tolerance)
    return Estimate(depth, count)


def sparse_depth(
    sequence: Sequence, frames: list[Frame], views: list[View], tracks: Tracks, config: DepthConfig
) -> list[Depth | None]:
    """Depth only at the pixels where a frame observes a point of the reconstruction; the nearest point wins."""
    depths: list[Depth | None] = []
    for frame, view in zip(frames, views, strict=True):
        pixels, z = view.camera.project(tracks.seen_by(frame.frame))
        x, y = np.floor(pixels).astype(np.intp).T
        inside = (z > 0) & (x >= 0) & (y >= 0) & (x < view.camera.width) & (y < view.camera.height)
        x, y, z = x[inside], y[inside], z[inside]
        farthest_first = np.argsort(-z, kind="stable")
        depth = np.zeros(view.gray.shape, np.float32)
        depth[y[farthest_first], x[farthest_first]] = z[farthest_first]
        depths.append(depth)
    return depths


def describe(
    frames: list[Frame], views: list[View], given: list[Depth | None], stored: list[Depth | None], tracks: Tracks
) -> dict[str, Any]:
    """Coverage of the stored depth maps and their agreement with the sparse points, as JSON values.

    `coverage` is the share of all pixels with depth, `mask_coverage` that of the pixels in (slightly grown) masks;
    `too_far_share` is the share of the given depth that was too far to be stored, where there is any. Where no frame
    has depth, `empty` says so.
    """
    coverage: list[float] = []
    mask_coverage: list[float] = []
    errors: list[Floats] = [np.zeros(0)]
    for frame, view, depth in zip(frames, views, stored, strict=True):
        inside = view.region is not None and view.region.any()
        if depth is None:
            coverage.append(0.0)
            mask_coverage += [0.0] if inside else []
            continue
        coverage.append(float((depth > 0).mean()))
        mask_coverage += [float((depth[view.region] > 0).mean())] if inside else []
        pixels, z = view.camera.project(tracks.seen_by(frame.frame))
        seen = sample_pixels(depth, pixels)
        both = (seen > 0) & (z > 0)
        errors.append(np.abs(seen[both] / z[both] - 1))
    error = np.concatenate(errors)
    without = [f.frame for f, depth in zip(frames, stored, strict=True) if depth is None]
    details: dict[str, Any] = {
        "frames_with_depth": len(frames) - len(without),
        "frames_without_depth": without,
        "coverage": round(float(np.mean(coverage)), 4),
        "mask_coverage": round(float(np.mean(mask_coverage)), 4) if mask_coverage else None,
        "sparse_points_compared": len(error),
    }
    there, kept = (sum(np.count_nonzero(d > 0) for d in maps if d is not None) for maps in (given, stored))
    if kept < there:
        details["too_far_share"] = round(float(1 - kept / there), 6)
    if len(without) == len(frames):
        details["empty"] = "no pixel of any frame has a depth that is believed"
    if len(error):
        details["sparse_median_error"] = round(float(np.median(error)), 5)
        details["sparse_within_1_percent"] = round(float((error < 0.01).mean()), 4)
        details["sparse_within_2_percent"] = round(float((error < 0.02).mean()), 4)
    return details
