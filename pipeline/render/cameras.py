"""Cameras of the paper's renders: pairs of views of an object on the upper half of a shell around it (supplement)."""

from __future__ import annotations

import math

import numpy as np

from dope.common import seeds
from pipeline.geometry import Camera, Floats
from pipeline.render.config import ViewpointsConfig


def paired_cameras(config: ViewpointsConfig, *seed: int | str) -> list[Camera]:
    """Cameras of views 0, 1, 2, ...; views 2k and 2k + 1 are a pair.

    The azimuth of a pair's first view is U(0, 360) degrees, that of its second lies U(-a, a) beside it, a =
    `second_azimuth_deg`. For each view by itself: the angle from the zenith, the distance from the origin, and the
    place that it looks at, U(-jitter, jitter) along each axis. z is up, and up in the image.

    Args:
        seed: what the draws are a function of.
    """
    rng = seeds.generator("viewpoints", *seed)
    cameras = []
    for _ in range(config.pairs):
        first = rng.uniform(0, 360)
        for azimuth in (first, first + rng.uniform(-config.second_azimuth_deg, config.second_azimuth_deg)):
            a, z = math.radians(azimuth), math.radians(rng.uniform(*config.zenith_deg))
            direction = np.array([math.sin(z) * math.cos(a), math.sin(z) * math.sin(a), math.cos(z)])
            eye = rng.uniform(*config.distance) * direction
            cameras.append(looking_at(eye, rng.uniform(-config.jitter, config.jitter, 3), config))
    return cameras


def looking_at(eye: Floats, target: Floats, config: ViewpointsConfig) -> Camera:
    """The square pinhole camera at `eye` (3,) with `target` (3,) in its middle; f = lens / sensor * size pixels.

    R's rows are right, down and forward: forward = (target - eye) / |target - eye|, right = forward x z.
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    focal, middle = config.lens_mm / config.sensor_mm * config.size, config.size / 2
    K = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
    return Camera(config.size, config.size, K, np.zeros(4), R, -R @ eye)
