"""An analytic scene and the prepared sequence of it: everything is known exactly, so errors can be measured.

A textured sphere or box stands on a chequered floor under a patterned sky; cameras orbit it and look at it. Every
pixel is a ray through its centre (of the distorted image, if the camera distorts), so depth, mask and the true
correspondence of any pixel are exact up to floating point.
"""

from __future__ import annotations

from collections.abc import Sequence as Sequence_
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Camera
from pipeline.sequence import Frame, Sequence, SequenceInfo, write_image

FLOOR, OBJECT, SKY = 0, 1, 2


@dataclass(frozen=True)
class Scene:
    """A sphere of radius 1 or a box with half sides `box`, centred at the origin, z up, on a floor."""

    shape: Literal["sphere", "box"] = "sphere"
    box: tuple[float, float, float] = (0.9, 0.65, 0.75)
    seed: int = 0
    """Changes the texture."""

    @property
    def floor_z(self) -> float:
        return -1.0 if self.shape == "sphere" else -self.box[2]

    def trace(self, camera: Camera, pixels: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """First hit of the rays through pixels (N, 2): world points (N, 3), z-depths (N,) and what was hit (N,)."""
        local = np.concatenate([camera.to_normalised(pixels), np.ones((len(pixels), 1))], axis=1)
        rays = local @ camera.R  # z-depth is the ray's parameter, since local z is 1
        origin = camera.centre
        depth = self._sphere(origin, rays) if self.shape == "sphere" else self._box(origin, rays)
        what = np.where(np.isfinite(depth), OBJECT, SKY)
        with np.errstate(divide="ignore", invalid="ignore"):
            floor = (self.floor_z - origin[2]) / rays[:, 2]
        nearer = (floor > 0) & (floor < np.minimum(depth, 60.0))
        depth, what = np.where(nearer, floor, depth), np.where(nearer, FLOOR, what)
        depth = np.where(what == SKY, 1e3, depth)
        return origin + rays * depth[:, None], depth, what

    def colour(self, points: NDArray, what: NDArray) -> NDArray:
        """BGR in [0, 255] (N, 3): solid noise on the object, chequers on the floor, bands on the sky."""
        rng = np.random.default_rng(self.seed)
        waves = rng.normal(size=(24, 3)) * rng.uniform(4, 22, size=(24, 1))
        phases, weights = rng.uniform(0, 6.28, 24), rng.normal(size=(24, 3))
        texture = 128 + 26 * np.sin(points @ waves.T + phases) @ weights
        chequer = 90 + 80 * ((np.floor(points[:, 0] * 2) + np.floor(points[:, 1] * 2)) % 2)
        sky = 150 + 60 * np.sin(points[:, 2] / 90 + points[:, 0] / 140)
        plain = np.where(what == FLOOR, chequer, sky)[:, None] * np.array([1.0, 0.9, 0.8])
        return np.clip(np.where((what == OBJECT)[:, None], texture, plain), 0, 255)

    def render(self, camera: Camera, *, supersample: int = 1) -> tuple[NDArray, NDArray, NDArray]:
        """Image (h, w, 3) uint8 BGR, z-depth (h, w) float32 and mask (h, w) of a camera (0 = sky, unknown)."""
        k, (h, w) = supersample, (camera.height, camera.width)
        fine = (pixel_centres(w * k, h * k)) / k
        points, _, what = self.trace(camera, fine)
        image = self.colour(points, what).reshape(h, k, w, k, 3).mean(axis=(1, 3))
        _, depth, what = self.trace(camera, pixel_centres(w, h))
        depth = np.where(what == SKY, 0, depth).reshape(h, w).astype(np.float32)
        return np.rint(image).astype(np.uint8), depth, (what == OBJECT).reshape(h, w)

    def transfer(self, first: Camera, pixels: NDArray, second: Camera) -> tuple[NDArray, NDArray]:
        """Where pixels (N, 2) of one camera's object lie in another: pixels (N, 2), and is it seen there (N,)."""
        points, _, what = self.trace(first, pixels)
        moved, depth = second.project(points)
        _, seen, _ = self.trace(second, moved)
        return moved, (what == OBJECT) & (np.abs(depth - seen) < 1e-4 * depth)

    def _sphere(self, origin: NDArray, rays: NDArray) -> NDArray:
        a, b, c = (rays * rays).sum(1), rays @ origin, origin @ origin - 1.0
        root = b * b - a * c
        depth = (-b - np.sqrt(np.maximum(root, 0))) / a
        return np.where((root > 0) & (depth > 0), depth, np.inf)

    def _box(self, origin: NDArray, rays: NDArray) -> NDArray:
        half = np.array(self.box)
        with np.errstate(divide="ignore", invalid="ignore"):
            one, two = (-half - origin) / rays, (half - origin) / rays
        near, far = np.minimum(one, two).max(1), np.maximum(one, two).min(1)
        return np.where((near <= far) & (near > 0), near, np.inf)


def pixel_centres(width: int, height: int) -> NDArray:
    """Centres of all pixels, row by row, (height * width, 2)."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([u.ravel(), v.ravel()], axis=1)


def look_at(centre: NDArray, target: NDArray, *, roll_deg: float = 0.0) -> tuple[NDArray, NDArray]:
    """R, t of a camera at `centre` that looks at `target`, z up in the world."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ R
    return R, -R @ centre


def orbit(
    n: int,
    *,
    arc_deg: float = 360.0,
    elevation_deg: float = 25.0,
    distance: float = 5.0,
    width: int = 320,
    height: int = 240,
    focal: float = 380.0,
    distortion: Sequence_[float] = (0.0, 0.0, 0.0, 0.0),
    wobble: float = 0.15,
) -> list[Camera]:
    """n cameras on an arc round the origin, with a little change of distance, aim, height and roll."""
    cameras = []
    K = np.array([[focal, 0, width / 2 + 3.3], [0, focal * 1.01, height / 2 - 2.7], [0, 0, 1]])
    for i in range(n):
        azimuth = np.radians(arc_deg * i / n)
        elevation = np.radians(elevation_deg + 40 * wobble * np.sin(2.1 * i))
        ray = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        aim = wobble * np.array([np.sin(1.3 * i), np.cos(0.7 * i), np.sin(0.4 * i)])
        R, t = look_at(ray * distance * (1 + wobble * np.sin(i)), aim, roll_deg=40 * wobble * np.cos(i))
        cameras.append(Camera(width, height, K, np.array(distortion, dtype=np.float64), R, t))
    return cameras


def write_sequence(
    folder: Path,
    cameras: list[Camera],
    scene: Scene | None = None,
    *,
    masks: bool = True,
    depths: bool = True,
    depth_size: tuple[int, int] | None = None,
    category: str | None = "thing",
    instance: str | None = None,
    supersample: int = 1,
) -> Sequence:
    """Render the scene and write it as `prep` would have: images, frames.parquet, masks and depths if wanted.

    Args:
        depth_size: (width, height) of the depth maps where they are to be smaller than the images.
    """
    scene = scene or Scene()
    sequence, frames = Sequence(folder), []
    for i, camera in enumerate(cameras):
        image, depth, mask = scene.render(camera, supersample=supersample)
        frame = Frame(i, f"{i:04d}.jpg", camera.width, camera.height, time_s=i / 10, image=f"images/{i:06d}.jpg")
        frame.source_width, frame.source_height, frame.sharpness = camera.width, camera.height, 100.0
        frame.set_camera(camera)
        write_image(folder / f"images/{i:06d}.jpg", image)
        if masks:
            sequence.write_mask(frame, mask)
        if depths:
            if depth_size is not None:
                depth = scene.render(camera.resized(*depth_size))[1]
            sequence.write_depth(frame, np.where(depth < 60, depth, 0))
        frames.append(frame)
    sequence.write_frames(frames)
    sequence.write_info(
        SequenceInfo(
            sequence.id,
            source=f"synthetic {scene.shape}",
            kind="photos",
            category=category,
            instance=instance or sequence.id,
            unit="object radius",
            ordered=True,
            n_frames=len(frames),
            n_registered=len(frames),
            registered_share=1.0,
        )
    )
    return sequence
