"""Which views help a view: near enough to match, far enough apart to measure depth, and from different sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry import Camera, Floats


@dataclass(frozen=True)
class NeighbourConfig:
    """How the neighbours of a view are chosen. Angles are seen from what the view looks at."""

    count: int = 4
    """Neighbours a view, fewer where fewer qualify."""
    preferred_deg: tuple[float, float] = (6.0, 12.0)
    """Angles that match well and still measure depth well; chosen first."""
    allowed_deg: tuple[float, float] = (2.0, 32.0)
    """Angles that are used where nothing better exists."""
    min_baseline_deg: float = 53.0
    """Skip a neighbour whose baseline lies nearer than this to the viewing direction (it moved forwards)."""


def choose_neighbours(cameras: list[Camera], targets: Floats, config: NeighbourConfig) -> list[list[int]]:
    """The neighbours of every view, best first.

    Args:
        cameras: F cameras.
        targets: (F, 3) what each view looks at, e.g. the median of the points that it sees.

    Returns:
        For each view up to `config.count` indices. A neighbour sees the view's target, at an allowed angle. Angles
        outside the preferred range count against it, and so does being close to a neighbour already taken: two
        neighbours on either side see around different edges.
    """
    centres = np.array([camera.centre for camera in cameras])
    return [_neighbours_of(i, cameras, centres, np.asarray(targets[i]), config) for i in range(len(cameras))]


def sees(camera: Camera, point: Floats) -> bool:
    """Whether a point (3,) of the world falls inside the image, in front of the camera."""
    pixels, depth = camera.project(point[None])
    x, y = pixels[0]
    return bool(depth[0] > 0 and 0 <= x < camera.width and 0 <= y < camera.height)


def _neighbours_of(
    index: int, cameras: list[Camera], centres: Floats, target: Floats, config: NeighbourConfig
) -> list[int]:
    if not np.all(np.isfinite(target)):
        return []
    rays = _unit(centres - target)
    angles = _angles_deg(rays, rays[index])
    baselines = _unit(centres - centres[index])
    # |cos|: moving forwards and backwards are equally bad, for either camera
    forwards = np.maximum(np.abs(baselines @ rays[index]), np.abs((baselines * rays).sum(1)))
    usable = (angles >= config.allowed_deg[0]) & (angles <= config.allowed_deg[1])
    usable &= forwards <= np.cos(np.radians(config.min_baseline_deg))
    usable[index] = False
    candidates = [int(j) for j in np.flatnonzero(usable) if sees(cameras[j], target)]

    low, high = config.preferred_deg
    penalty = 2 * np.abs(np.log(np.maximum(angles, 1e-6) / np.clip(angles, low, high)))
    chosen: list[int] = []
    while candidates and len(chosen) < config.count:
        taken = rays[chosen]
        best = min(candidates, key=lambda j: penalty[j] - _novelty(rays[j], taken, low))
        chosen.append(best)
        candidates.remove(best)
    return chosen


def _novelty(ray: Floats, taken: Floats, full_deg: float) -> float:
    """0 for a view beside one already taken, 1 for one that is `full_deg` or more away from all."""
    if not len(taken):
        return 1.0
    return float(min(_angles_deg(taken, ray).min() / full_deg, 1.0))


def _unit(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _angles_deg(directions: Floats, reference: Floats) -> Floats:
    """Angles (N,) between unit vectors (N, 3) and one (3,), accurate for small angles."""
    cross = np.linalg.norm(np.cross(directions, reference), axis=-1)
    return np.degrees(np.arctan2(cross, directions @ reference))
