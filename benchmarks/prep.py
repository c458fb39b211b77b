"""Data preparation, measured: one JSON line a figure.

    python -m benchmarks.prep --captures ../shared/data/captures --out /tmp/dope-bench

Runs the `dope prep` commands on the five captures that come with reference cameras, on two workers, and prints
registered frames, rotation errors against the reference, CPU seconds a frame, the epipolar error of the
correspondences on mold_gold_cape against its reference cameras, the wall time from photos to shards, how long a second
run takes and whether it changed a file, and whether one worker and two give the same shards.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from dope.common import files
from pipeline.cameras.compare import compare_cameras, read_reference
from pipeline.correspond.views import read_views, view_to_source_pixels
from pipeline.geometry import Camera, epipolar_distance_px, fundamental, rotation_angle_deg
from pipeline.sequence import Sequence
from pipeline.stages import read_marker

PLAIN = ("fox", "mold_gold_cape", "skull", "plush_doll")
TURNTABLE = "ethiopian_head"
WIDE = "co3d_apple"


def say(figure: str, value: Any, **more: Any) -> None:
    print(json.dumps({"figure": figure, "value": value, **more}), flush=True)


def dope(*words: object) -> list[dict[str, Any]]:
    """Run a command with --json and return its rows."""
    command = [sys.executable, "-m", "cli", *map(str, words), "--json"]
    answer = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    return [json.loads(line) for line in answer.stdout.splitlines()]


def prepare(captures: Path, out: Path, workers: int) -> None:
    work, base = out / "work", ("--workers", workers)
    dope("prep", "colmap", *(captures / name for name in PLAIN), "--out", work, *base)
    dope("prep", "colmap", captures / TURNTABLE, "--masks", "{}/masks", "--mask-features", "--out", work, *base)
    given = out / "masks"  # the one capture with masks that does not need them for its cameras
    given.mkdir(parents=True, exist_ok=True)
    if not (given / "mold_gold_cape").exists():
        (given / "mold_gold_cape").symlink_to((captures / "mold_gold_cape" / "masks").resolve())
    dope("prep", "masks", work, "--from", given, *base)
    dope("prep", "correspond", work, *base)
    dope("prep", "shards", work, "--out", out / "shards")


def cameras(captures: Path, work: Path) -> None:
    for name in (*PLAIN, TURNTABLE):
        sequence = Sequence(work / name)
        errors = compare_cameras(sequence.read_frames(), read_reference(captures / name / "cameras.json"))
        n_source = sum(1 for path in (captures / name / "images").iterdir() if not path.name.startswith("."))
        say(
            "cameras",
            {"registered": errors.n_registered, "frames": n_source},
            capture=name,
            neighbour_rotation_median_deg=round(errors.relative_rotation_median_deg, 4),
            neighbour_rotation_max_deg=round(errors.relative_rotation_max_deg, 4),
            translation_median_percent=round(errors.translation_median_percent, 3),
        )


def wide_baseline(captures: Path, out: Path) -> None:
    """Twenty frames of a CO3D video, far apart, through the ordinary command; cameras against CO3D's."""
    work = out / "wide"
    dope("prep", "colmap", captures / WIDE, "--out", work, "--depth", "sparse")
    names = sorted(path.stem for path in (captures / WIDE / "images").iterdir() if not path.name.startswith("."))
    given = np.load(captures / WIDE / "gt_cameras.npz")
    flip = np.diag([-1.0, -1.0, 1.0])  # PyTorch3D: x left, y up, row vectors
    reference = {
        name: Camera(1, 1, np.eye(3), np.zeros(4), flip @ R.T, flip @ T)
        for name, R, T in zip(names, given["gtR"].astype(float), given["gtT"].astype(float), strict=True)
    }
    frames = Sequence(work / WIDE).read_frames()
    errors = compare_cameras(frames, reference)
    found = np.array([f.camera.R for f in frames if f.registered])
    wanted = np.array([reference[Path(f.source_name).stem].R for f in frames if f.registered])
    u, _, v = np.linalg.svd((wanted.transpose(0, 2, 1) @ found).sum(axis=0))  # the rotation that fits the worlds best
    apart = rotation_angle_deg(found @ (wanted @ u @ v).transpose(0, 2, 1))
    say(
        "cameras",
        {"registered": errors.n_registered, "frames": len(names)},
        capture=WIDE,
        neighbour_rotation_median_deg=round(errors.relative_rotation_median_deg, 4),
        rotation_median_deg=round(float(np.median(apart)), 4),
        translation_median_percent=round(errors.translation_median_percent, 3),
    )


def cost(work: Path) -> None:
    for name in (*PLAIN, TURNTABLE):
        sequence = Sequence(work / name)
        n = len([frame for frame in sequence.read_frames() if frame.image])
        seconds = {}
        for stage in ("frames", "sfm", "depth", "masks", "correspond"):
            marker = read_marker(sequence, stage)
            seconds[stage] = round(marker.cpu_seconds / n, 3) if marker else None
        photo_to_depth = sum(seconds[stage] or 0.0 for stage in ("frames", "sfm", "depth"))
        attempts = len(sequence.read_info().attempts)
        say("cpu_seconds_a_frame", round(photo_to_depth, 3), capture=name, attempts=attempts, **seconds)


def correspondences(captures: Path, work: Path, name: str = "mold_gold_cape") -> None:
    """Symmetric epipolar distance of our correspondences under the reference cameras, in pixels of 640 px images."""
    sequence = Sequence(work / name)
    reference = read_reference(captures / name / "cameras.json")
    frames = {frame.frame: frame for frame in sequence.read_frames()}
    views = {row["frame"]: row for row in read_views(sequence)}
    distances, enough, total = [], 0, 0
    for row in pq.read_table(sequence.correspondences).to_pylist():
        matches = np.array(row["points"], dtype=np.float64).reshape(-1, 4)
        one, two = frames[row["frame1"]], frames[row["frame2"]]
        cameras = [reference[Path(frame.source_name).stem] for frame in (one, two)]
        total += 1
        enough += row["n_correspondences"] >= 32
        normal = []
        for frame, camera, points in ((one, cameras[0], matches[:, :2]), (two, cameras[1], matches[:, 2:])):
            pixels = view_to_source_pixels(views[frame.frame], frame, points)
            pixels = pixels * [camera.width / frame.width, camera.height / frame.height]
            normal.append(camera.to_normalised(pixels) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2])
        distance = epipolar_distance_px(fundamental(*cameras), *normal)
        distances.append(distance * 640 / max(cameras[0].width, cameras[0].height))
    everything = np.concatenate(distances)
    say(
        "correspondences_epipolar_px_at_640",
        round(float(np.median(everything)), 3),
        capture=name,
        p95=round(float(np.quantile(everything, 0.95)), 3),
        pairs=total,
    )
    marker = read_marker(sequence, "correspond")
    assert marker is not None
    say("pairs_with_32_correspondences", round(enough / total, 3), capture=name, details=marker.details)


def snapshot(folder: Path) -> dict[str, tuple[int, int]]:
    return {
        str(p.relative_to(folder)): (p.stat().st_mtime_ns, p.stat().st_size)
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name != ".lock"
    }


def hashes(folder: Path) -> dict[str, str]:
    return {path.name: files.sha256_of(path) for path in sorted(folder.iterdir()) if path.is_file()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=Path, default=Path("../shared/data/captures"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--one-worker", action="store_true", help="prepare again with one worker and compare shards")
    given = parser.parse_args()

    start = time.perf_counter()
    prepare(given.captures, given.out, workers=2)
    say("photos_to_shards_seconds", round(time.perf_counter() - start, 1), workers=2, captures=5)
    work = given.out / "work"
    cameras(given.captures, work)
    wide_baseline(given.captures, given.out)
    cost(work)
    correspondences(given.captures, work)

    before = snapshot(given.out)
    start = time.perf_counter()
    dope("prep", "colmap", *(given.captures / name for name in PLAIN), "--out", work)
    seconds = time.perf_counter() - start
    prepare(given.captures, given.out, workers=2)
    say("second_run_of_prep_colmap_seconds", round(seconds, 2), files_changed=snapshot(given.out) != before)
    if given.one_worker:
        other = given.out / "one-worker"
        shutil.rmtree(other, ignore_errors=True)
        prepare(given.captures, other, workers=1)
        say("same_shards_with_one_worker", hashes(given.out / "shards") == hashes(other / "shards"))


if __name__ == "__main__":
    main()
