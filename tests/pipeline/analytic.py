"""Pictures of a sphere on a plane by ray casting: what a renderer must give, to the last bit of its formulas."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.geometry import Camera, Floats
from pipeline.render.scene import Picture, Scene

RADIUS = 0.5


def rays(camera: Camera) -> Floats:
    """(H, W, 3) directions in the world through the pixel centres, with z-depth 1."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack(
        [(x - camera.K[0, 2]) / camera.K[0, 0], (y - camera.K[1, 2]) / camera.K[1, 1], np.ones_like(x)], -1
    )
    return local @ camera.R


def sphere_depth(camera: Camera, radius: float = RADIUS) -> Floats:
    """z-depth of a sphere at the origin, inf beside it: z with |c + z d| = r for centre c and rays d of z-depth 1."""
    d, c = rays(camera), camera.centre
    a, b = (d * d).sum(-1), d @ c
    root = b * b - a * (c @ c - radius**2)
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def plane_depth(camera: Camera, height: float) -> Floats:
    """z-depth of the plane z = height, inf where a ray does not meet it."""
    with np.errstate(divide="ignore"):
        z = (height - camera.centre[2]) / rays(camera)[..., 2]
    return np.where(z > 0, z, np.inf)


def picture_of(camera: Camera, radius: float = RADIUS, ground: float | None = None) -> Picture:
    """The sphere, coloured by place, on a grey plane."""
    ball = sphere_depth(camera, radius)
    plane = np.full_like(ball, np.inf) if ground is None else plane_depth(camera, ground)
    depth = np.minimum(ball, plane)
    mask = ball < plane
    points = camera.centre + rays(camera) * np.where(np.isfinite(ball), ball, 0)[..., None]
    image = np.where(mask[..., None], np.clip(127 + 250 * points, 0, 255), 90).astype(np.uint8)
    return Picture(image, mask, np.where(np.isfinite(depth), depth, 0).astype(np.float32))


class SphereRenderer:
    """Whatever the scene's model is, a sphere on the scene's ground."""

    version = "sphere 1"

    def __init__(self, radius: float = RADIUS) -> None:
        self.radius = radius

    def render(self, scene: Scene) -> Iterator[Picture]:
        for shot in scene.shots:
            yield picture_of(shot.camera, self.radius, scene.ground.height if scene.ground else None)

    def close(self) -> None:
        pass
