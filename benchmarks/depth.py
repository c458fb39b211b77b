"""Depth on a CPU against true depth: rendered objects, one JSON line each and one for their mean.

    python -m benchmarks.depth --out /tmp/dope-depth --pictures

Films textured objects in cluttered rooms (`pipeline/demo`: exact z-depth at every pixel centre, antialiasing, sensor
noise, JPEG), runs the depth stage with the true cameras and true sparse points, and compares each pixel of the object.

`coverage` is the share of the object's pixels with depth, `median_error` and `under_*_percent` are of the relative
errors there. With --reconstruct, `dope prep colmap` also makes its own cameras of the photos, and its depth is compared
after the similarity that brings its cameras to the true ones.
"""

from __future__ import annotations

import argparse
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.prep import dope, say
from dope.common import seeds
from pipeline.cameras.sparse_points import Tracks
from pipeline.demo.film import FilmConfig, camera_path
from pipeline.demo.scene import build_scene, render_view
from pipeline.depth.depth_filter import sample_pixels
from pipeline.depth.mvs import DepthConfig, sgbm_depth, write_depths
from pipeline.geometry import Camera, similarity_between
from pipeline.sequence import Frame, Sequence, SequenceInfo, find_sequences, write_image

OBJECTS = ("mug", "bottle", "vase", "pot", "pawn", "lamp", "chair", "table", "car", "plane")
FILM = FilmConfig(frames=36, arc_deg=(350.0, 350.0))


@dataclass(frozen=True)
class Truth:
    """What a rendered view really shows: z-depth (h, w) and the object's mask (h, w)."""

    camera: Camera
    depth: NDArray[np.float32]
    mask: NDArray[np.bool_]


def render_object(folder: Path, family: str, seed: int, film: FilmConfig) -> tuple[Sequence, list[Truth]]:
    """Film an object and write it as a prepared sequence with true cameras, without masks and depth."""
    scene = build_scene(family, seed, film.detail)
    rng = seeds.generator(seed, "sensor")
    sequence, frames, truths = Sequence(folder), [], []
    for i, camera in enumerate(camera_path(film, scene.height, seed)):
        rgb, mask, depth = render_view(scene, camera, film.samples)
        noise = film.noise * rng.standard_normal(rgb.shape, dtype=np.float32)
        frame = Frame(i, f"{i:06d}.jpg", camera.width, camera.height, image=f"images/{i:06d}.jpg")
        frame.source_width, frame.source_height = camera.width, camera.height
        frame.set_camera(camera)
        noisy = np.clip(np.rint(rgb + noise), 0, 255).astype(np.uint8)
        write_image(folder / f"images/{i:06d}.jpg", np.ascontiguousarray(noisy[..., ::-1]))
        frames.append(frame)
        truths.append(Truth(camera, depth.astype(np.float32), mask > 0))
    sequence.write_frames(frames)
    sequence.write_info(SequenceInfo(folder.name, str(folder), "render", n_frames=len(frames)))
    return sequence, truths


def true_points(sequence: Sequence, truths: list[Truth], every: int = 3, count: int = 400) -> Tracks:
    """Corners of every third image where they truly are, and the frames that see them."""
    points = []
    for frame, truth in list(zip(sequence.read_frames(), truths, strict=True))[::every]:
        gray = cv2.cvtColor(sequence.read_image(frame), cv2.COLOR_BGR2GRAY)
        corners = cv2.goodFeaturesToTrack(gray, count, 0.01, 5).reshape(-1, 2).astype(np.float64) + 0.5
        # a corner between two surfaces is no point
        near, far = (f(truth.depth, np.ones((3, 3))) for f in (cv2.erode, cv2.dilate))
        smooth = sample_pixels(np.asarray(far / near, np.float32), corners) < 1.02
        points.append(truth.camera.unproject(corners[smooth], sample_pixels(truth.depth, corners[smooth])))
    xyz = np.concatenate(points)
    index, seen = [], []
    for number, truth in enumerate(truths):
        pixels, z = truth.camera.project(xyz)
        visible = np.flatnonzero((z > 0) & (np.abs(sample_pixels(truth.depth, pixels) - z) < 0.01 * z))
        index.append(visible)
        seen.append(np.full(len(visible), number))
    order = np.argsort(np.concatenate(index), kind="stable")
    return Tracks(xyz, np.concatenate(index)[order], np.concatenate(seen)[order])


def errors_of(depth: NDArray[np.float32] | None, truth: Truth) -> NDArray[np.float32]:
    """Relative errors (n,) of the object's pixels, at the depth map's own size; NaN where depth is unknown."""
    if depth is None:
        return np.full(int(truth.mask.sum()), np.nan, np.float32)
    on_object = cv2.resize(truth.mask.astype(np.uint8), depth.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    true = np.asarray(cv2.resize(truth.depth, depth.shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)
    return np.where(depth[on_object] > 0, depth[on_object] / true[on_object] - 1, np.float32(np.nan))


def summarise(errors: NDArray[np.floating]) -> dict[str, float]:
    """Coverage, median relative error and shares of small errors; of all pixels of all views."""
    found = np.abs(errors[np.isfinite(errors)])
    return {
        "coverage": round(len(found) / max(1, len(errors)), 4),
        "median_error_percent": round(100 * float(np.median(found)), 4) if len(found) else np.nan,
        "under_1_percent": round(float((found < 0.01).mean()), 4) if len(found) else np.nan,
        "under_2_percent": round(float((found < 0.02).mean()), 4) if len(found) else np.nan,
    }


def measure(sequence: Sequence, truths: list[Truth], config: DepthConfig) -> dict[str, Any]:
    """Compute depth with the true cameras and points, and compare."""
    tracks = true_points(sequence, truths)
    before = os.times()
    write_depths(sequence, tracks, config, sgbm_depth)
    after = os.times()
    depths = [sequence.read_depth(frame) for frame in sequence.read_frames()]
    errors = np.concatenate([errors_of(d, t) for d, t in zip(depths, truths, strict=True)])
    seconds = after.user + after.system - before.user - before.system
    return {**summarise(errors), "cpu_seconds_a_frame": round(seconds / len(truths), 3)}


def reconstruct(photos: Path, work: Path, truths: list[Truth]) -> dict[str, Any]:
    """The same photos with cameras of our own: depth after bringing them to the true cameras."""
    dope("prep", "colmap", photos, "--out", work)
    (sequence,) = find_sequences(work)
    frames = sequence.registered_frames()
    given = [truths[int(Path(frame.source_name).stem)] for frame in frames]
    ours, true = np.array([f.camera.centre for f in frames]), np.array([t.camera.centre for t in given])
    scale = np.float32(similarity_between(ours, true).s)
    depths = [None if (depth := sequence.read_depth(frame)) is None else depth * scale for frame in frames]
    errors = np.concatenate([errors_of(d, t) for d, t in zip(depths, given, strict=True)])
    return {**summarise(errors), "registered": len(frames), "frames": len(truths)}


def draw(folder: Path, sequence: Sequence, truths: list[Truth], every: int = 9) -> None:
    """Photo, depth and error (red: missing; white: 2% and more) of some views, beside each other."""
    for frame, truth in list(zip(sequence.read_frames(), truths, strict=True))[::every]:
        depth = sequence.read_depth(frame)
        if depth is None:
            continue
        low, high = np.quantile(truth.depth[truth.mask], [0.0, 1.0])
        shown = np.clip(255 * (high + 0.2 - depth) / (high - low + 0.4), 0, 255) * (depth > 0)
        error = np.clip(np.abs(depth / truth.depth - 1) / 0.02, 0, 1) * 255
        picture = cv2.cvtColor(error.astype(np.uint8), cv2.COLOR_GRAY2BGR)
        picture[depth == 0] = (0, 0, 160)
        picture[~truth.mask] //= 3
        colours = cv2.applyColorMap(shown.astype(np.uint8), cv2.COLORMAP_TURBO)
        panels = [sequence.read_image(frame), colours, picture]
        write_image(folder / f"{sequence.id}_{frame.frame:03d}.png", np.hstack(panels))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pictures", action="store_true", help="draw depth and errors into OUT/pictures")
    parser.add_argument("--reconstruct", action="store_true", help="also with cameras that COLMAP finds")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    rows = []
    for family in given.objects:
        folder = given.out / family
        shutil.rmtree(folder, ignore_errors=True)
        sequence, truths = render_object(folder, family, seeds.derive_seed(given.seed, "benchmark", family), FILM)
        rows.append(measure(sequence, truths, DepthConfig()))
        say("rendered_depth", rows[-1], object=family)
        if given.pictures:
            draw(given.out / "pictures", sequence, truths)
        if given.reconstruct:
            shutil.rmtree(folder / "work", ignore_errors=True)
            say("rendered_depth_own_cameras", reconstruct(sequence.images, folder / "work", truths), object=family)
    mean = {name: round(float(np.mean([row[name] for row in rows])), 4) for name in rows[0]}
    say("rendered_depth_mean", mean, objects=len(rows))


if __name__ == "__main__":
    main()
