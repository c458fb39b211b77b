"""The visual hull of a sequence's masks, and which masks disagree with it.

The hull is what lies inside the masks of all views (Laurentini, PAMI 1994). Here a voxel's views vote, so that single
bad masks do not carve the object away. A mask is then compared with the silhouette of the hull *of the other views*:
a mask that was moved, swapped, cut off or that shows something else stands out from the rest of its sequence.

All in the frame of a normalised sequence: the object lies around the origin, its radius is about 1.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Camera, Floats

Mask = NDArray[np.bool_]

WITNESSES = 12
"""About so many other views are asked whether a mask that lies below the rest is right all the same."""


@dataclass(frozen=True)
class HullConfig:
    """How masks are checked against the visual hull of the other views."""

    voxels: int = 96
    """Voxels along each side of the grid."""
    radius: float = 1.5
    """The object lies within this distance of the origin (1 = the radius that the cameras were normalised to)."""
    share: float = 0.9
    """A voxel is the object's if it lies in the masks of this share of the views that see it; one is forgiven."""
    first_share: float = 0.7
    """The same in the first round, in which bad masks still vote."""
    below: float = 0.15
    """A mask is flagged if its IoU lies at least this much below the sequence's median ..."""
    deviations: float = 5.0
    """... and this many standard deviations (from the median deviation, which single bad masks do not move) ..."""
    lost: float = 0.1
    """... unless it only sees more than the others: carved by it, the hull still covers all but this share of each of
    their masks, and it goes no more than this share beyond the hull itself."""
    min_median: float = 0.4
    """Where the median IoU is lower there is no common hull, and nothing is flagged."""
    min_views: int = 5
    """Fewer registered frames with masks cannot be checked."""
    min_angle_deg: float = 30.0
    """Views within a smaller angle show one side of the object: their hull says nothing."""


@dataclass(frozen=True)
class HullCheck:
    """What the other views say of each mask.

    Attributes:
        iou: IoU of each mask and the silhouette of the others' hull; NaN where neither covers anything.
        flags: why a mask is doubted, or None, for each mask.
        median: of the IoUs of the masks that are not flagged; NaN where nothing could be checked.
        note: why nothing could be checked or flagged, or None.
    """

    iou: Floats
    flags: list[str | None]
    median: float
    note: str | None = None


def check_masks(masks: list[Mask], cameras: list[Camera], config: HullConfig) -> HullCheck:
    """Compare each mask with the silhouette of the hull of all other views (leave one out).

    The votes of all views are counted once. A view's own votes are subtracted where its silhouette is needed, and only
    for the voxels that could be in a hull: about 0.05 CPU seconds a view. Two rounds: masks flagged in the first do
    not vote in the second.

    Args:
        masks: (height, width) each; any size of its camera's aspect ratio.
    """
    nothing = np.full(len(masks), np.nan)
    note = _why_not(masks, cameras, config)
    if note is not None:
        return HullCheck(nothing, [None] * len(masks), float("nan"), note)
    views = [_View.of(mask, camera, config) for mask, camera in zip(masks, cameras, strict=True)]
    empty = np.array([not view.mask.any() for view in views])
    votes = _Votes(config.voxels, config.radius)
    votes.add(view for view, without in zip(views, empty, strict=True) if not without)
    voting, iou = ~empty, nothing
    for share in (config.first_share, config.share):
        iou = _compare(views, votes, voting, share)
        outliers = _outliers(iou, voting, config)
        votes.add((views[i] for i in np.flatnonzero(voting & outliers)), sign=-1)
        votes.add(views[i] for i in np.flatnonzero(~voting & ~outliers & ~empty))
        voting = ~empty & ~outliers
    good = iou[voting & np.isfinite(iou)]
    median = float(np.median(good)) if len(good) else 0.0
    if median < config.min_median:
        note = f"the masks have no common visual hull (median IoU {median:.2f})"
        return HullCheck(iou, [None] * len(masks), median, note)
    doubted = _outliers(iou, voting, config) | (empty & np.isfinite(iou))
    bad = [i for i in np.flatnonzero(doubted) if empty[i] or not _only_sees_more(int(i), views, votes, voting, config)]
    flags: list[str | None] = [None] * len(masks)
    for i in bad:
        what = "empty, but the object is in view" if empty[i] else "disagrees with the other views' hull"
        flags[i] = f"{what} (IoU {iou[i]:.2f}, median {median:.2f})"
    return HullCheck(iou, flags, median)


def hull_silhouettes(masks: list[Mask], cameras: list[Camera], config: HullConfig) -> list[Mask]:
    """For each view the silhouette of the hull of all *other* views, of the size of its camera.

    The first round's `first_share` is asked for: some of the masks may be wrong.
    """
    views = [_View.of(mask, camera, config) for mask, camera in zip(masks, cameras, strict=True)]
    votes = _Votes(config.voxels, config.radius)
    votes.add(views)
    outlines = _silhouettes(views, votes, np.ones(len(views), bool), config.first_share)
    sizes = ((camera.width, camera.height) for camera in cameras)
    resized = (
        cv2.resize(o.astype(np.uint8), s, interpolation=cv2.INTER_LINEAR) for o, s in zip(outlines, sizes, strict=True)
    )
    return [np.asarray(outline > 0) for outline in resized]


def visual_hull(masks: list[Mask], cameras: list[Camera], *, radius: float, share: float, voxels: int = 64) -> Floats:
    """Centres (M, 3) of the voxels that lie in the masks of at least `share` of the views that see them.

    Voxels outside the ball of `radius`, or seen by less than 30% of the views, are not part of it.

    Args:
        masks: (height, width) each, of the size of its camera.
    """
    votes = _Votes(voxels, radius)
    votes.add(_View(mask, camera, 1) for mask, camera in zip(masks, cameras, strict=True))
    kept = (votes.inside >= share * votes.seen) & (votes.seen >= 0.3 * len(masks)) & (votes.seen > 0)
    return votes.grid[kept]


def silhouette(points: Floats, camera: Camera, gap_px: int) -> Mask:
    """The pixels (height, width) that points (N, 3) fall on, gaps between them up to twice `gap_px` closed."""
    filled = np.zeros((camera.height, camera.width), np.uint8)
    if len(points):
        _, pixels = _pixels(points, camera)
        filled.ravel()[pixels] = 1
    return close_gaps(filled, gap_px) > 0


def close_gaps(mask: NDArray[np.uint8], radius: int) -> NDArray[np.uint8]:
    """Morphological closing that does not know the image's border."""
    padded = np.pad(mask, 2 * radius)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    closed = np.asarray(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc), dtype=np.uint8)
    return closed[2 * radius : -2 * radius, 2 * radius : -2 * radius]


@dataclass(frozen=True)
class _View:
    """A mask at the size at which it is compared."""

    mask: Mask
    camera: Camera
    gap_px: int
    """Voxels of the grid lie at most twice this far apart in the image."""

    @classmethod
    def of(cls, mask: Mask, camera: Camera, config: HullConfig) -> _View:
        """The mask at a size at which a voxel is about a pixel: finer would be noise of the grid."""
        voxel_px = float(camera.K[0, 0]) / max(float(np.linalg.norm(camera.centre)), 1e-6) * 2 * config.radius
        voxel_px /= config.voxels
        long_side = max(camera.width, camera.height)
        scale = min(1.0, float(np.clip(1 / max(voxel_px, 1e-6), 128 / long_side, 512 / long_side)))
        size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        small = cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) > 127
        return cls(np.asarray(small), _in_float32(camera.resized(*size)), max(1, round(voxel_px * scale)))


def _in_float32(camera: Camera) -> Camera:
    """Half the time, and a thousandth of a pixel."""
    parts = {name: getattr(camera, name).astype(np.float32) for name in ("K", "distortion", "R", "t")}
    return replace(camera, **parts)


@dataclass
class _Votes:
    """How many views see each voxel, and how many of them have it inside their mask."""

    voxels: int
    radius: float
    grid: NDArray[np.float32] = field(init=False)
    """Centres (N, 3) of the voxels of a cube around the origin that lie within `radius`."""
    places: NDArray[np.int64] = field(init=False)
    """Their indices in that cube with a margin of one voxel."""
    inside: NDArray[np.int32] = field(init=False)
    seen: NDArray[np.int32] = field(init=False)

    def __post_init__(self) -> None:
        axis = ((np.arange(-1, self.voxels + 1) + 0.5) / self.voxels * 2 - 1).astype(np.float32) * self.radius
        cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        self.places = np.flatnonzero((cube * cube).sum(axis=1) < self.radius**2)
        self.grid = cube[self.places]
        self.inside, self.seen = np.zeros(len(self.grid), np.int32), np.zeros(len(self.grid), np.int32)

    def add(self, views: Iterable[_View], sign: int = 1) -> None:
        for view in views:
            visible, pixels = _pixels(self.grid, view.camera)
            self.seen[visible] += sign
            self.inside[visible] += sign * view.mask.ravel()[pixels]

    def surface(self, share: float) -> NDArray[np.int64]:
        """The voxels that lie on the surface of the hull, whichever single view is left out.

        A solid has the silhouette of its surface: what is surrounded by voxels that no single view can remove is left
        out, most of the hull.
        """
        likely = self.inside + 1 >= _needed(self.seen + 1, share)
        sure = self.inside - 1 >= _needed(self.seen, share)
        solid = np.zeros((self.voxels + 2,) * 3, bool)
        solid.ravel()[self.places] = sure
        inner = solid.copy()
        for axis in range(3):
            inner &= np.roll(solid, 1, axis) & np.roll(solid, -1, axis)
        return np.flatnonzero(likely & ~inner.ravel()[self.places])


def _pixels(points: Floats, camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the points (N, 3) that lie in the image, and of the pixels (row by row) that they lie in."""
    pixels, depth = camera.project(points)
    x, y = pixels.T
    visible = np.flatnonzero((depth > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height))
    return visible, y[visible].astype(np.int64) * camera.width + x[visible].astype(np.int64)


def _why_not(masks: list[Mask], cameras: list[Camera], config: HullConfig) -> str | None:
    shown = [camera for mask, camera in zip(masks, cameras, strict=True) if mask.any()]
    if len(shown) < config.min_views:
        return f"masks not checked: {len(shown)} registered frames have one, {config.min_views} are needed"
    if _widest_angle(shown) < config.min_angle_deg:
        return f"masks not checked: all views lie within {config.min_angle_deg:.0f} degrees"
    return None


def _widest_angle(cameras: list[Camera]) -> float:
    """The largest angle at the origin between two cameras, degrees."""
    rays = np.stack([camera.centre for camera in cameras])
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    return float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))


def _silhouettes(views: list[_View], votes: _Votes, voting: Mask, share: float) -> Iterator[Mask]:
    """The silhouette in each view of the hull of the other voting views."""
    likely = votes.surface(share)
    grid, inside, seen = votes.grid[likely], votes.inside[likely], votes.seen[likely]
    for i, view in enumerate(views):
        visible, pixels = _pixels(grid, view.camera)
        others_inside, others_seen = inside[visible], seen[visible]
        if voting[i]:
            others_inside, others_seen = others_inside - view.mask.ravel()[pixels], others_seen - 1
        n_others = int(voting.sum()) - int(voting[i])
        kept = (others_inside >= _needed(others_seen, share)) & (others_seen >= max(2.0, 0.3 * n_others))
        filled = np.zeros(view.mask.shape, np.uint8)
        filled.ravel()[pixels[kept]] = 1
        yield close_gaps(filled, view.gap_px) > 0


def _compare(views: list[_View], votes: _Votes, voting: Mask, share: float) -> Floats:
    """IoU of each mask with the silhouette of the hull of the other voting views; NaN where neither covers anything."""
    iou = np.full(len(views), np.nan)
    for i, outline in enumerate(_silhouettes(views, votes, voting, share)):
        union = int((outline | views[i].mask).sum())
        if union:
            iou[i] = (outline & views[i].mask).sum() / union
    return iou


def _only_sees_more(i: int, views: list[_View], votes: _Votes, voting: Mask, config: HullConfig) -> bool:
    """Is a mask smaller than the others' hull because it sees what they cannot, such as the hole of a ring?

    A hull knows only what some view has seen past. The mask is right if it leaves the others right: carved by it, the
    hull still covers their masks. A mask from which a part is missing fails that, and so does one that goes beyond
    the hull.
    """
    view = views[i]
    visible, pixels = _pixels(votes.grid, view.camera)
    own = np.ones(len(votes.grid), bool)
    own[visible] = view.mask.ravel()[pixels]
    inside, seen = votes.inside, votes.seen
    if voting[i]:
        inside, seen = inside.copy(), seen.copy()
        inside[visible] -= own[visible]
        seen[visible] -= 1
    hull = (inside >= _needed(seen, config.share)) & (seen >= max(2.0, 0.3 * int(voting.sum())))
    whole, carved = votes.grid[hull], votes.grid[hull & own]
    beyond = view.mask & ~silhouette(whole, view.camera, view.gap_px)
    if beyond.sum() > config.lost * view.mask.sum():
        return False
    others = [j for j in np.flatnonzero(voting) if j != i]
    for other in (views[j] for j in others[:: max(1, len(others) // WITNESSES)]):
        covered = other.mask & silhouette(whole, other.camera, other.gap_px)
        lost = covered & ~silhouette(carved, other.camera, other.gap_px)
        if lost.sum() > config.lost * max(1, int(covered.sum())):
            return False
    return True


def _needed(seen: NDArray[np.int32], share: float) -> Floats:
    """How many of the views that see a voxel must have it inside; of four or more, one may always dissent."""
    return np.where(seen >= 4, np.minimum(share * seen, seen - 1), seen)


def _outliers(iou: Floats, voting: Mask, config: HullConfig) -> Mask:
    """Which IoUs lie far below the median of the voting ones."""
    known = iou[voting & np.isfinite(iou)]
    if not len(known):
        return np.zeros(len(iou), bool)
    median = np.median(known)
    deviation = 1.4826 * np.median(np.abs(known - median))
    with np.errstate(invalid="ignore"):
        return np.asarray(iou < median - max(config.below, config.deviations * float(deviation)))
