"""Points for cameras that are given, and whether the images agree with those cameras."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from dope.common.seeds import derive_seed
from pipeline.cameras import colmap
from pipeline.cameras.matching import Pair
from pipeline.cameras.sfm import SfmConfig
from pipeline.cameras.store import mask_folder
from pipeline.geometry import Camera, Floats, epipolar_distance_px, fundamental
from pipeline.sequence import Frame, Sequence

MIN_MATCHES = 100  # fewer verified matches are no evidence against cameras
MAX_TURN_DEG = 75.0  # SIFT does not match views that are further apart
MAX_GIVEN = 5000  # points: more say nothing new of depth ranges, and make files large
CELLS = 48  # of the longer image side, in each of which the nearest point hides those behind it


@dataclass(frozen=True)
class Fit:
    """How well verified matches agree with the cameras.

    Attributes:
        n_matches: number of matches that two images agree upon, whatever their cameras.
        median_px: their median distance from the epipolar lines of the cameras, px of the stored image; 0 without.
        limit_px: distance up to which matches and cameras are said to agree.
    """

    n_matches: int
    median_px: float
    limit_px: float

    @property
    def refuted(self) -> bool:
        """True where the images contradict the cameras."""
        return self.n_matches >= MIN_MATCHES and self.median_px > 3 * self.limit_px

    @property
    def warning(self) -> str | None:
        if self.n_matches < MIN_MATCHES:
            return f"{self.n_matches} matches between the images: too few to say whether the cameras fit them"
        if self.median_px > 0.35 * self.limit_px:
            return (
                f"matches lie {self.median_px:.1f} px (median) from the lines on which the cameras place them: focal "
                "length, distortion or poses are inexact"
            )
        return None


def posed_pairs(cameras: list[Camera], gaps: tuple[int, ...]) -> list[Pair]:
    """Pairs of views to match: each with its nearest ones, then with ever fewer of those that are further away.

    Views are near where they look in about the same direction from about the same place. On an orbit, the ranks
    2 gap - 1 and 2 gap are the neighbours `gap` steps away on either side. Neighbours in the given order are added:
    they match whatever the cameras say.
    """
    centres = np.stack([camera.centre for camera in cameras])
    directions = np.stack([camera.direction for camera in cameras])
    turn = np.arccos(np.clip(directions @ directions.T, -1, 1))
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    distance = turn + apart / max(float(np.linalg.norm(np.ptp(centres, axis=0))), 1e-12)
    distance[turn > np.radians(MAX_TURN_DEG)] = np.inf
    np.fill_diagonal(distance, np.inf)
    ranks = sorted({rank for gap in gaps for rank in (2 * gap - 2, 2 * gap - 1) if rank < len(cameras) - 1})
    pairs = {(i, i + 1) for i in range(len(cameras) - 1)}
    for i, row in enumerate(distance):
        for j in np.argsort(row, kind="stable")[ranks]:
            if np.isfinite(row[j]):
                pairs.add((min(i, int(j)), max(i, int(j))))
    return sorted(pairs)


def triangulated(
    sequence: Sequence,
    used: list[Frame],
    cameras: dict[int, Camera],
    config: SfmConfig,
    database: Path,
    *,
    masked: bool,
) -> tuple[colmap.Model, Fit, dict[str, Any]]:
    """The cameras as a model with points from matches, how well they fit, and what was done.

    Args:
        used: the frames with an image.
        cameras: by frame number.
        database: where it is to be made; other files go beside it.
        masked: use only features inside the masks.
    """
    numbers = [frame.frame for frame in used]
    model = colmap.model_of_cameras(cameras, numbers)
    scratch = database.parent
    colmap.enter_model(database, model, numbers)
    names = [f"{number:06d}.jpg" for number in cameras]
    settings: dict[str, Any] = {
        "max_image_size": config.max_image_size,
        "first_octave": config.first_octave,
        "max_features": config.max_features,
    }
    masks = mask_folder(sequence, used, scratch) if masked else None
    colmap.extract_features(database, sequence.images, names, masks=masks, threads=config.threads, **settings)
    pairs = posed_pairs(list(cameras.values()), config.gaps)
    seed = derive_seed(config.seed, "known cameras") % 2**31
    named = [(names[a], names[b]) for a, b in pairs]
    colmap.match_pairs(database, named, guided=False, seed=seed, threads=config.threads)
    fit = measure_fit(database, cameras, config)
    model = colmap.triangulate(database, sequence.images, model, scratch / "model", seed=seed, threads=config.threads)
    return model, fit, {**settings, "masked": masked, "matching": "poses", "n_pairs": len(pairs)}


def measure_fit(database: Path, cameras: dict[int, Camera], config: SfmConfig) -> Fit:
    """Distances of all verified matches from their epipolar lines, in the images without their distortion."""
    distances: list[Floats] = [np.zeros(0)]
    for first, second, first_px, second_px in colmap.read_verified_matches(database):
        a, b = cameras[first], cameras[second]
        if np.linalg.norm(a.centre - b.centre) > 0:  # else there are no epipolar lines
            distances.append(epipolar_distance_px(fundamental(a, b), _straight(a, first_px), _straight(b, second_px)))
    every = np.nan_to_num(np.concatenate(distances), nan=np.inf)  # no pixel has such a distortion
    largest = max(max(camera.width, camera.height) for camera in cameras.values())
    limit = config.checks.max_error_px * max(1.0, largest / config.max_image_size)
    return Fit(len(every), float(np.median(every)) if len(every) else 0.0, limit)


def _straight(camera: Camera, pixels: Floats) -> Floats:
    """Where a camera without distortion would see the same points."""
    return camera.to_normalised(pixels) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]


def refusal(fit: Fit, where: str, *, masks: bool) -> BadInput:
    """The error for cameras that the images contradict."""
    remedy = (
        "Are these the cameras of these images, world to camera, with OpenCV's axes (transforms.json: camera to world, "
        "OpenGL's)? "
    )
    if not masks:
        remedy += "If the object turns before a still background, give masks. "
    return BadInput(
        f"the images contradict the cameras: {fit.n_matches} matches lie {fit.median_px:.0f} px (median) from the "
        "lines on which the cameras place them",
        where=where,
        remedy=remedy + "To believe the cameras all the same, --set sfm.known_points=none",
    )


def with_given_points(
    model: colmap.Model, cameras: dict[int, Camera], xyz: Floats, rgb: NDArray[np.uint8]
) -> colmap.Model:
    """The model with points that came with the cameras, at most `MAX_GIVEN`, evenly taken.

    Which view sees which point is not known: a point counts as seen where it projects into the image and no other
    point lies clearly nearer in the same cell of a coarse grid.
    """
    finite = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    chosen = finite[:: max(1, -(-len(finite) // MAX_GIVEN))]
    xyz, rgb = xyz[chosen], rgb[chosen]

    def seen() -> Iterator[tuple[int, NDArray[np.intp], Floats]]:
        for number, camera in cameras.items():
            pixels, depth = camera.project(xyz)
            inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
            indices = np.flatnonzero(inside)
            cell = max(camera.width, camera.height) / CELLS
            column, row = (pixels[indices] // cell).astype(np.int64).T
            nearest = np.full((CELLS + 1) * (CELLS + 1), np.inf)
            np.minimum.at(nearest, row * (CELLS + 1) + column, depth[indices])
            front = depth[indices] < 1.05 * nearest[row * (CELLS + 1) + column]
            yield number, indices[front], pixels[indices[front]]

    return colmap.add_points(model, xyz, rgb, seen())
