"""Pixel correspondences between two views of an object, from depth and cameras.

A pixel of view 1 is lifted by its depth, projected into view 2, must lie on the object there and at the depth that view
2 has of that place (else it is occluded), and, lifted back from view 2's depth, must return to where it came from.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dope.common import files, seeds, settings
from pipeline.correspond.depth_sampling import DepthSampler
from pipeline.correspond.farthest_points import farthest_points
from pipeline.correspond.outline import outline_details
from pipeline.correspond.pairs import PairsConfig, candidate_pairs, made_pairs, select_pairs, view_angles_deg
from pipeline.correspond.views import VIEW_SCHEMA, View, ViewsConfig, build_views, views_table, write_view
from pipeline.geometry import Camera, relative_pose
from pipeline.sequence import Sequence

PAIR_SCHEMA = pa.schema(
    [
        ("frame1", pa.int32()),
        ("frame2", pa.int32()),
        ("angle_deg", pa.float64()),  # at the object
        ("overlap", pa.float64()),  # share of view 1's mask that has a match
        ("n_correspondences", pa.int32()),
        ("points", pa.list_(pa.float32())),  # x1 y1 x2 y2 of each, farthest-point ordered on view 1
        ("cycle_px", pa.float64()),  # median distance by which the way there and back misses, pixels of view 1
    ]
)
ROW_GROUP = 8  # rows that a reader who wants one pair has to decode


@dataclass(frozen=True)
class CorrespondenceConfig:
    """When two pixels show the same point."""

    max_points: int = 512
    """Most correspondences kept of a pair, farthest-point ordered (training draws 32 of them)."""
    depth_tolerance: float = 0.02
    """Largest relative difference between the point's depth in view 2 and view 2's depth map."""
    edge_px: int = 1
    """Pixels of the mask this close to its edge are not matched: their depth is a mixture, or the background's."""
    cycle_px: float = 1.0
    """Largest distance by which the way to view 2 and back may miss, in pixels of the views."""
    seed: int = 0
    """Draws the first point of the farthest-point order."""

    def __post_init__(self) -> None:
        settings.require_at_least(self, max_points=1, edge_px=0)


@dataclass(frozen=True)
class CorrespondConfig:
    """Settings of the correspond stage."""

    views: ViewsConfig = field(default_factory=ViewsConfig)
    """The square views."""
    pairs: PairsConfig = field(default_factory=PairsConfig)
    """Which views are paired."""
    match: CorrespondenceConfig = field(default_factory=CorrespondenceConfig)
    """Which pixels correspond."""


class Surface:
    """The part of the object that a view sees, prepared for matching with many other views.

    Args:
        view: a view with depth.
        edge_px: width of the rim of the mask that is left out.
        depth_jump: relative difference from which neighbouring depths belong to different surfaces.
    """

    def __init__(self, view: View, edge_px: int = 1, depth_jump: float = 0.03) -> None:
        if view.depth is None:
            raise ValueError(f"view {view.frame} has no depth")
        self.frame = view.frame
        self.camera: Camera = view.camera
        kernel = np.ones((2 * edge_px + 1, 2 * edge_px + 1), np.uint8)
        self.mask = cv2.erode(view.mask.astype(np.uint8), kernel) > 0
        self.n_mask = int(view.mask.sum())
        self.sampler = DepthSampler(view.depth, depth_jump)
        rows, columns = np.nonzero(self.mask & (view.depth > 0))
        self.pixels = np.stack([columns, rows], axis=1).astype(np.int32)
        self.xy = self.pixels.T.astype(np.float32) + np.float32(0.5)  # (2, M) centres
        z = view.depth[rows, columns]
        self.scaled = np.concatenate([self.xy * z, z[None]])  # (3, M) homogeneous pixels times depth

    def middle(self, samples: int = 1000) -> NDArray[np.floating]:
        """The middle (3,) of the visible object in the world: the median of about so many of its points."""
        some = slice(None, None, max(1, len(self.pixels) // samples))
        xy, z = self.xy[:, some].T.astype(np.float64), self.scaled[2, some].astype(np.float64)
        return np.median(self.camera.unproject(xy, z), axis=0)


@dataclass(frozen=True)
class _Consistent:
    """Pixels that pass all checks: index into view 1's pixels, place in view 2 (2, N), the cycle's miss in pixels."""

    index: NDArray[np.intp]
    xy2: NDArray[np.float32]
    miss_px: NDArray[np.float32]


def _consistent(one: Surface, two: Surface, config: CorrespondenceConfig, step: int = 1) -> _Consistent:
    there, there_shift = _transfer(one.camera, two.camera)
    p = there @ one.scaled[:, ::step] + there_shift
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y, z = p[0] / p[2], p[1] / p[2], p[2]
        height, width = two.mask.shape
        index = np.flatnonzero((z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
    x, y, z = x[index], y[index], z[index]
    on_object = two.mask.ravel()[y.astype(np.int32) * width + x.astype(np.int32)]
    on_object = np.flatnonzero(on_object)
    index, x, y, z = index[on_object], x[on_object], y[on_object], z[on_object]
    seen = two.sampler(x, y)
    # nowhere true where view 2's depth is unknown (0)
    visible = np.flatnonzero(np.abs(z - seen) < config.depth_tolerance * seen)
    index, x, y, seen = index[visible], x[visible], y[visible], seen[visible]
    back, back_shift = _transfer(two.camera, one.camera)
    q = back @ np.stack([x * seen, y * seen, seen]) + back_shift
    origin = one.xy[:, ::step][:, index]
    dx, dy = q[0] / q[2] - origin[0], q[1] / q[2] - origin[1]
    miss = dx * dx + dy * dy
    closed = np.flatnonzero(miss <= config.cycle_px**2)
    return _Consistent(index[closed] * step, np.stack([x, y])[:, closed], np.sqrt(miss[closed]))


def _transfer(first: Camera, second: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """H (3, 3), b (3, 1) with z2 [x2 y2 1] = H z1 [x1 y1 1] + b for pixels of two pinhole views."""
    R, t = relative_pose(first, second)
    H = second.K @ R @ np.linalg.inv(first.K)
    return H.astype(np.float32), (second.K @ t).astype(np.float32)[:, None]


def estimate_overlap(one: Surface, two: Surface, config: CorrespondenceConfig, samples: int = 400) -> float:
    """Share of view 1's mask with a match in view 2, estimated on about `samples` of its pixels."""
    step = max(1, len(one.pixels) // samples)
    matched = len(_consistent(one, two, config, step).index) * step
    return min(1.0, matched / max(1, one.n_mask))


@dataclass(frozen=True)
class Match:
    """The correspondences of one pair of views.

    Attributes:
        points: (N, 4) float32: x1, y1, x2, y2 in pixels of the views, centres at +0.5; farthest-point ordered.
        overlap: share of view 1's mask that has a match (of all matches, not only the N kept).
        cycle_px: median miss of the cycle of the N kept, in pixels; nan without matches.
    """

    points: NDArray[np.float32]
    overlap: float
    cycle_px: float


def match(one: Surface, two: Surface, config: CorrespondenceConfig) -> Match:
    """Match two views: all consistent pixels, then the first `max_points` of their farthest-point order on view 1."""
    found = _consistent(one, two, config)
    n = len(found.index)
    if n == 0:
        return Match(np.zeros((0, 4), np.float32), 0.0, float("nan"))
    start = seeds.derive_seed("correspondences", config.seed, one.frame, two.frame) % n
    order = farthest_points(one.pixels[found.index], config.max_points, start)
    points = np.concatenate([one.xy[:, found.index[order]], found.xy2[:, order]]).T
    return Match(np.ascontiguousarray(points), n / one.n_mask, float(np.median(found.miss_px[order])))


def match_views(view1: Surface, view2: Surface, config: CorrespondenceConfig) -> NDArray[np.float32]:
    """Correspondences (N, 4), N <= max_points: x1, y1, x2, y2 in pixels of the two views (DOPE, section 3.2)."""
    return match(view1, view2, config).points


def correspond(sequence: Sequence, config: CorrespondConfig) -> dict[str, Any]:
    """The correspond stage: views/, views.parquet and correspondences.parquet of one sequence.

    Returns:
        Details for the marker; with "empty" and a reason where no pair remains.

    Raises:
        BadInput: no cameras or no masks.
        DiskFull: no space left.
    """
    skipped: Counter[str] = Counter()
    rows, surfaces = [], []
    with files.atomic_folder(sequence.views) as folder:
        for view in build_views(sequence, config.views, skipped):
            rows.append(write_view(folder, view, config.views))
            if view.depth is not None:
                surface = Surface(view, config.match.edge_px, config.views.depth_jump)
                if len(surface.pixels):
                    surfaces.append(surface)
    views_rows = pa.Table.from_pylist(rows, VIEW_SCHEMA)
    with files.atomic_path(views_table(sequence)) as partial:
        pq.write_table(views_rows, partial)
    details: dict[str, Any] = {"views": len(rows), "views_with_depth": len(surfaces), "frames_skipped": dict(skipped)}
    in_pairs = config.pairs.choose == "made" or (config.pairs.choose == "auto" and sequence.read_info().paired)
    table, pair_details = match_pairs(surfaces, config, made=in_pairs)
    with files.atomic_path(sequence.correspondences) as partial:
        rows_table = pa.Table.from_pylist(table, PAIR_SCHEMA)
        pq.write_table(rows_table, partial, row_group_size=ROW_GROUP, use_dictionary=False)  # coordinates do not repeat
    details |= pair_details
    details["content"] = _content_of(sequence)
    details["outline"] = outline_details(sequence, views_rows, rows_table)
    if not table:
        details["empty"] = _why_empty(details)
    return details


def _content_of(sequence: Sequence) -> str:
    """Identifies what was written, for the stage that packs it: names and bytes of the tables and views."""
    digest = hashlib.sha256()
    for path in (views_table(sequence), sequence.correspondences, *sorted(sequence.views.iterdir())):
        digest.update(f"{path.name}\0{files.sha256_of(path)}\0".encode())
    return digest.hexdigest()[:32]


def match_pairs(
    surfaces: list[Surface], config: CorrespondConfig, *, made: bool = False
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Choose and match the pairs: rows of correspondences.parquet in order of frames, and what to say of them.

    Args:
        made: the views were made in pairs, and are paired so.
    """
    if len(surfaces) < 2:
        return [], {"candidate_pairs": 0, "pairs": 0, "pairs_dropped": {}}
    cameras = [surface.camera for surface in surfaces]
    target = np.median(np.stack([surface.middle() for surface in surfaces]), axis=0)
    angles = view_angles_deg(cameras, target)
    dropped: Counter[str] = Counter()

    def overlap(i: int, j: int) -> float:
        share = estimate_overlap(surfaces[i], surfaces[j], config.match)
        dropped["overlap too small"] += share < config.pairs.min_overlap
        return share

    if made:
        chosen = made_pairs([surface.frame for surface in surfaces], overlap, config.pairs)
    else:
        chosen = select_pairs(cameras, target, overlap, config.pairs)
    rows = []
    for i, j in chosen:
        found = match(surfaces[i], surfaces[j], config.match)
        if len(found.points) < config.pairs.min_correspondences:
            dropped["too few correspondences"] += 1
            continue
        rows.append(
            {
                "frame1": surfaces[i].frame,
                "frame2": surfaces[j].frame,
                "angle_deg": float(angles[i, j]),
                "overlap": found.overlap,
                "n_correspondences": len(found.points),
                "points": found.points.ravel(),
                "cycle_px": found.cycle_px,
            }
        )
    rows.sort(key=lambda row: (row["frame1"], row["frame2"]))
    details: dict[str, Any] = {
        "candidate_pairs": len(surfaces) // 2 if made else len(candidate_pairs(angles, config.pairs)),
        "pairs": len(rows),
        "pairs_dropped": {reason: n for reason, n in dropped.items() if n},
        "share_of_chosen_with_enough_points": round(len(rows) / len(chosen), 4) if len(chosen) else 0.0,
    }
    for name, key in (("correspondences", "n_correspondences"), ("angle_deg", "angle_deg"), ("overlap", "overlap")):
        details[f"median_{name}"] = round(float(np.median([row[key] for row in rows])), 4) if rows else None
    return rows, details


def _why_empty(details: dict[str, Any]) -> str:
    if details["views"] < 2:
        reasons = ", ".join(f"{n} {reason}" for reason, n in details["frames_skipped"].items())
        return f"only {details['views']} of the sampled frames became a view ({reasons or 'too few frames'})"
    if details["views_with_depth"] < 2:
        return f"only {details['views_with_depth']} of {details['views']} views have depth on the object"
    if details["candidate_pairs"] == 0:
        return "no two views are apart by an angle in the wanted range"
    reasons = ", ".join(f"{n} {reason}" for reason, n in details["pairs_dropped"].items())
    return f"none of {details['candidate_pairs']} candidate pairs remains ({reasons})"
