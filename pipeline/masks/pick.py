"""The rule that picks one object per frame out of the instances that a segmentation tool found there.

- `score`: the highest score.
- `area`: the most pixels.
- `centre`: the highest score x centrality; centrality = exp(-(d / 0.5)^2), where d is the distance of the mask's
  centroid from where the object is expected, in half diagonals of the image: where the cameras see the origin of the
  object's frame, or in the middle of the image while there are no cameras.
- `consistent`: the highest score x agreement with the other frames. At first the agreement is the IoU with the
  silhouette of the object's ball; then, up to four times, the IoU with the silhouette of the visual hull of what was
  picked in the other frames. Frames without a camera, and all frames while there are fewer than five cameras, go by
  `centre`.

Ties go to the larger mask, then to the one that comes first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Camera, Floats
from pipeline.masks.object_region import ball_silhouette
from pipeline.masks.visual_hull import HullConfig, hull_silhouettes

Pick = Literal["consistent", "centre", "score", "area"]
Mask = NDArray[np.bool_]

ROUNDS = 4
SMALL = 192
"""Long side at which instances are compared, pixels."""


@dataclass
class Candidates:
    """The instances of one frame, at the size at which they are compared.

    Attributes:
        masks: (N, height, width).
        scores: (N,).
        camera: of that size, or None where the frame has none.
    """

    masks: Mask
    scores: Floats
    camera: Camera | None


def small(mask: Mask) -> Mask:
    """A mask at the size at which instances are compared."""
    height, width = mask.shape
    scale = min(1.0, SMALL / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) > 127)


def pick(frames: list[Candidates], rule: Pick, hull: HullConfig) -> tuple[list[int], str]:
    """The index of the instance picked in each frame, and the rule that was used.

    Args:
        frames: each with at least one instance.
        hull: how the visual hull of `consistent` is made.
    """
    if rule == "consistent":
        posed = [i for i, frame in enumerate(frames) if frame.camera is not None]
        if len(posed) < hull.min_views:
            rule = "centre"
        else:
            picked = [_best(frame, frame.scores * _centrality(frame)) for frame in frames]
            for i, choice in zip(posed, _consistent([frames[i] for i in posed], hull), strict=True):
                picked[i] = choice
            return picked, rule
    weights = {"score": lambda frame: frame.scores, "area": lambda frame: frame.masks.sum(axis=(1, 2)).astype(float)}
    weights["centre"] = lambda frame: frame.scores * _centrality(frame)
    return [_best(frame, weights[rule](frame)) for frame in frames], rule


def _best(frame: Candidates, weight: Floats) -> int:
    area = frame.masks.sum(axis=(1, 2))
    return int(np.lexsort((-np.arange(len(weight)), area, weight))[-1])


def _centrality(frame: Candidates) -> Floats:
    height, width = frame.masks.shape[1:]
    middle = np.array([width / 2, height / 2])
    if frame.camera is not None:
        pixels, depth = frame.camera.project(np.zeros((1, 3)))
        middle = pixels[0] if depth[0] > 0 else middle
    area = np.maximum(frame.masks.sum(axis=(1, 2)), 1)
    x = (frame.masks.sum(axis=1) @ (np.arange(width) + 0.5)) / area
    y = (frame.masks.sum(axis=2) @ (np.arange(height) + 0.5)) / area
    distance = np.hypot(x - middle[0], y - middle[1]) / (np.hypot(width, height) / 2)
    return np.exp(-((distance / 0.5) ** 2))


def _consistent(frames: list[Candidates], hull: HullConfig) -> list[int]:
    cameras = [frame.camera for frame in frames if frame.camera is not None]
    outlines = [ball_silhouette(camera, 1.0) for camera in cameras]
    picked: list[int] = []
    for _ in range(ROUNDS + 1):
        before, picked = (
            picked,
            [
                _best(frame, frame.scores * _overlap(frame.masks, outline))
                for frame, outline in zip(frames, outlines, strict=True)
            ],
        )
        if picked == before:
            break
        chosen = [frame.masks[choice] for frame, choice in zip(frames, picked, strict=True)]
        carved = hull_silhouettes(chosen, cameras, hull)
        # where most picks were wrong there may be no hull: the ball goes on speaking for that frame
        outlines = [new if new.any() else old for new, old in zip(carved, outlines, strict=True)]
    return picked


def _overlap(masks: Mask, outline: Mask) -> Floats:
    """IoU of masks (N, height, width) with an outline (height, width)."""
    union = (masks | outline).sum(axis=(1, 2))
    return np.asarray((masks & outline).sum(axis=(1, 2)) / np.maximum(union, 1))
