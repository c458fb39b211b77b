"""How many pairs a second are chosen, matched and farthest-point ordered, on one core from depth at hand.

    python -m benchmarks.correspond                    # a synthetic scene: a bumpy ball, 24 views of 224 px
    python -m benchmarks.correspond --work WORK        # prepared sequences, with the views that the stage would cut

Prints a JSON line: pairs a CPU second over at least `--pairs` pairs (depth of the views made ready for sampling,
selection, overlap, matching, order; the median of `--repeat` rounds), the same without making the views ready, and CPU
milliseconds a view for cutting views out of stored frames, which is in neither.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.correspond.match import CorrespondConfig, Surface, match_pairs
from pipeline.correspond.views import View, build_views
from pipeline.geometry import Camera
from pipeline.sequence import find_sequences

SIZE = 224


def synthetic_views(n: int) -> list[View]:
    """n views of a ball that fills two thirds of the view, on a circle round it, 12 degrees apart."""
    K = np.array([[420.0, 0, SIZE / 2], [0, 420.0, SIZE / 2], [0, 0, 1]])
    views = []
    for i in range(n):
        angle = np.radians(12.0 * i)
        back = np.array([np.cos(angle), np.sin(angle), 0.4])
        back /= np.linalg.norm(back)
        right = np.cross(-back, [0.0, 0, 1])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(-back, right), -back])
        camera = Camera(SIZE, SIZE, K, np.zeros(4), R, -R @ (5.0 * back))
        depth, mask = ball(camera)
        image = np.zeros((SIZE, SIZE, 3), np.uint8)
        views.append(View(i, image, mask, depth, camera, 1.0, (0.0, 0.0, float(SIZE))))
    return views


def ball(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """z-depth and mask (h, w) of the unit ball round the origin."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1], np.ones_like(u)], -1)
    centre = camera.t
    a, b, c = (rays * rays).sum(-1), rays @ centre, centre @ centre - 1.0
    root = b * b - a * c
    hit = root > 0
    depth = np.where(hit, (b - np.sqrt(np.maximum(root, 0))) / a, 0)
    return depth.astype(np.float32), hit


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, help="folder of prepared sequences with masks and depth")
    parser.add_argument("--pairs", type=int, default=300)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    config = CorrespondConfig()
    config = replace(config, views=replace(config.views, size=SIZE, every=1))

    start = time.process_time()
    sequences = (
        [list(build_views(sequence, config.views)) for sequence in find_sequences(options.work)]
        if (options.work)
        else [synthetic_views(24)]
    )
    cutting = time.process_time() - start
    n_views = sum(map(len, sequences))

    rates, matching_rates = [], []
    for _ in range(options.repeat):
        pairs, points, preparing, matching = 0, 0, 0.0, 0.0
        while pairs < options.pairs:
            for views in sequences:
                start = time.process_time()
                seen = [view for view in views if view.depth is not None]
                surfaces = [Surface(view, config.match.edge_px, config.views.depth_jump) for view in seen]
                preparing += time.process_time() - start
                start = time.process_time()
                rows, _ = match_pairs(surfaces, config)
                matching += time.process_time() - start
                pairs += len(rows)
                points += sum(row["n_correspondences"] for row in rows)
        rates.append(pairs / (preparing + matching))
        matching_rates.append(pairs / matching)
    facts = {
        "pairs": pairs,
        "points_a_pair": round(points / pairs),
        "pairs_per_cpu_second": round(statistics.median(rates), 1),
        "without_preparing_views": round(statistics.median(matching_rates), 1),
    }
    if options.work:
        facts["cutting_cpu_ms_a_view"] = round(1000 * cutting / n_views, 1)
    print(json.dumps({"source": str(options.work or "synthetic"), "views": n_views, **facts}))


if __name__ == "__main__":
    main()
