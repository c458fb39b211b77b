"""The object cut out of every frame without any masks given: GrabCut, told where the object is by the reconstruction.

The sparse points say it twice. Points within the object's ball and above the table project into its silhouette in
every view; points elsewhere that a view sees are background there. GrabCut (Rother et al., SIGGRAPH 2004) finds the
border by colour. What the views agree on is their visual hull; a second round starts from it, which mends the views in
which colour alone went wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from dope.common.seeds import derive_seed
from pipeline.geometry import Camera, Floats
from pipeline.inputs.frame_quality import shrink
from pipeline.masks.mask_io import write_masks
from pipeline.masks.object_region import ball_silhouette, pixels_of, points_on_object, support_plane
from pipeline.masks.visual_hull import close_gaps, silhouette, visual_hull
from pipeline.sequence import Frame, Sequence

if TYPE_CHECKING:
    from pipeline.cameras.sparse_points import Tracks
    from pipeline.masks.imported import MasksConfig


@dataclass(frozen=True)
class GrabCutConfig:
    """How the object is cut out."""

    long_side: int = 320
    """Frames are cut at this size; masks are enlarged to the stored size."""
    radius: float = 1.2
    """The object lies within this distance of the origin (1 = the radius that the reconstruction estimated)."""
    iterations: int = 3
    """Rounds of colour modelling and cutting in the first pass; the second takes one less."""
    hull_share: float = 0.85
    """A place belongs to the object if it lies in the masks of this share of the views that see it."""
    slack_px: int = 8
    """How far beyond the hull's silhouette the second pass may go, at `long_side`."""


@dataclass
class View:
    """A frame at the size at which it is cut, with what the sparse points say of it."""

    frame: Frame
    image: NDArray[np.uint8]
    camera: Camera
    density: NDArray[np.float32]
    """Object points a pixel (height, width)."""
    background: NDArray[np.bool_]
    """Pixels where the view sees a point that is not on the object."""


def grabcut_masks(sequence: Sequence, points: Tracks, config: MasksConfig) -> dict[str, Any]:
    """Write masks/ for the registered frames of a normalised sequence and note them in frames.parquet.

    Args:
        points: `xyz` (N, 3) in the sequence's frame (object at the origin, radius about 1), and its observations:
            frame number `frame[k]` sees point `point_index[k]`.

    Returns:
        `write_masks`' details and {"object_points", "support_plane", "agreement"}: the median IoU of the masks and
        the silhouettes of their common hull, the one sign of quality there is without a reference (above 0.9: good).

    Raises:
        BadInput: no registered frames, no points on the object, or no view in which anything could be cut out.
    """
    frames = sequence.read_frames()
    registered = [frame for frame in frames if frame.registered and frame.image is not None]
    if not registered:
        raise BadInput("has no registered frames", where=sequence.folder, remedy="Run `dope prep colmap` first")
    cameras = [frame.camera for frame in registered]
    plane = support_plane(points.xyz, cameras)
    on_object = points_on_object(points.xyz, plane, radius=config.grabcut.radius)
    remedy = "Give masks of another tool: `dope prep masks --from FOLDER`"
    if not on_object.any():
        raise BadInput("no reconstructed point lies on the object", where=sequence.folder, remedy=remedy)
    views = []
    for frame in registered:
        seen = points.point_index[points.frame == frame.frame]
        elsewhere = points.xyz[seen[~on_object[seen]]]
        views.append(_view(sequence, frame, points.xyz[on_object], elsewhere, config.grabcut))
    masks, agreement = cut_out(views, config.grabcut)

    enlarged = ((view.frame, _enlarge(mask, view.frame)) for view, mask in zip(views, masks, strict=True))
    nothing = BadInput("the object could not be cut out of any frame", where=sequence.folder, remedy=remedy)
    details = write_masks(sequence, frames, enlarged, min_share=config.min_share, nothing=nothing)
    details |= {"object_points": int(on_object.sum()), "support_plane": plane is not None, "agreement": agreement}
    return details


def cut_out(views: list[View], config: GrabCutConfig) -> tuple[list[NDArray[np.bool_]], float]:
    """Masks (height, width) of the views in two passes, and the median IoU with their hull's silhouettes."""
    first = [_grabcut(view, _labels_by_points(view, config), config.iterations) for view in views]
    cameras = [view.camera for view in views]
    hull = visual_hull(first, cameras, radius=config.radius, share=config.hull_share)
    masks, agreements = [], []
    for view, mask in zip(views, first, strict=True):
        outline = silhouette(hull, view.camera, gap_px=4)
        if outline.any():
            mask = _grabcut(view, _labels_by_hull(view, outline, config), max(1, config.iterations - 1))
            agreements.append(float((mask & outline).sum() / (mask | outline).sum()))
        masks.append(mask)
    return masks, round(float(np.median(agreements)), 4) if agreements else 0.0


def _view(sequence: Sequence, frame: Frame, on_object: Floats, elsewhere: Floats, config: GrabCutConfig) -> View:
    image = shrink(sequence.read_image(frame), config.long_side)
    height, width = image.shape[:2]
    camera = frame.camera.resized(width, height)
    density = np.zeros((height, width), np.float32)
    rows, columns = pixels_of(on_object, camera).T
    np.add.at(density, (rows, columns), 1)
    background = np.zeros((height, width), np.uint8)
    rows, columns = pixels_of(elsewhere, camera).T
    background[rows, columns] = 1
    return View(frame, image, camera, density, cv2.dilate(background, np.ones((3, 3), np.uint8)) > 0)


def _labels_by_points(view: View, config: GrabCutConfig) -> NDArray[np.uint8]:
    """Outside the ball: background. Around object points, gaps closed: probably object. Between: probably not."""
    ball = ball_silhouette(view.camera, config.radius)
    labels = np.where(ball, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    reach = max(1, config.long_side // 80)
    near = np.asarray(cv2.dilate((view.density > 0).astype(np.uint8), _disc(reach)), dtype=np.uint8)
    labels[(close_gaps(near, 4 * reach) > 0) & ball] = cv2.GC_PR_FGD
    labels[view.background] = cv2.GC_BGD
    return labels


def _labels_by_hull(view: View, silhouette: NDArray[np.bool_], config: GrabCutConfig) -> NDArray[np.uint8]:
    """In the hull's silhouette: probably object. A little beyond: probably not. Farther: background."""
    reach = cv2.dilate(silhouette.astype(np.uint8), _disc(config.slack_px)) > 0
    labels = np.where(reach, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    labels[silhouette] = cv2.GC_PR_FGD
    labels[view.background] = cv2.GC_BGD
    return labels


def _grabcut(view: View, labels: NDArray[np.uint8], iterations: int) -> NDArray[np.bool_]:
    guess = labels == cv2.GC_PR_FGD
    if not guess.any() or guess.all():  # two colour models need pixels of both kinds
        return np.asarray(guess)
    cv2.setRNGSeed(derive_seed("grabcut", view.frame.frame) % 2**31)  # the colour models start from k-means
    models = np.zeros((2, 1, 65))
    cv2.grabCut(view.image, labels, None, models[0], models[1], iterations, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    return _tidied(np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)), view.density)


def _tidied(mask: NDArray[np.bool_], density: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Threads cut off, parts without object points removed, small holes filled."""
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, parts, stats, _ = cv2.connectedComponentsWithStats(opened)
    support = np.bincount(parts.ravel(), weights=density.ravel(), minlength=count)
    support[0] = 0
    kept = support >= max(1.0, 0.05 * support.sum())
    tidy = np.asarray(kept[parts])
    count, holes, stats, _ = cv2.connectedComponentsWithStats((~tidy).astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] < 0.02 * tidy.sum()
    small[0] = False  # label 0 is the object itself here
    return np.asarray(tidy | small[holes])


def _disc(radius: int) -> NDArray[np.uint8]:
    size = 2 * radius + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)


def _enlarge(mask: NDArray[np.bool_], frame: Frame) -> NDArray[np.bool_]:
    soft = cv2.resize(mask.astype(np.float32), (frame.width, frame.height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(soft > 0.5)
