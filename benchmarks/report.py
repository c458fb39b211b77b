"""The report over 1,000 sequences, measured: one JSON line a figure.

    python -m benchmarks.report --out /tmp/dope-report --count 1000

Makes sequences of procedural pictures at all stages, some failed (kept for the next run), writes the page, opens it in
a headless Chromium, and prints CPU seconds, peak memory, the page's size, and the milliseconds from the start of
navigation to the load event, by the browser's own clock (the median of three).
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import statistics
import struct
import subprocess
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from benchmarks.scale_status import STAGES, details_of
from pipeline.geometry import Camera
from pipeline.sequence import Frame, Sequence, SequenceInfo, write_image

KINDS, FRAMES, WIDTH, HEIGHT = 8, 30, 640, 480
NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome-headless-shell")


def noise(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """A picture with detail at every scale, which compresses like a photo."""
    image = np.zeros((height, width, 3), np.float32)
    for octave in range(2, 8):
        coarse = rng.normal(size=(2**octave, 2**octave, 3)).astype(np.float32)
        image += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC) * 0.72**octave
    return np.clip(128 + 90 * image, 0, 255).astype(np.uint8)


def make_kind(folder: Path, seed: int) -> Sequence:
    """One finished sequence: an orbit, its frames, masks, depth, points, views and pairs."""
    rng, sequence, frames = np.random.default_rng(seed), Sequence(folder), []
    base = noise(rng, WIDTH + 200, HEIGHT + 100)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    K = np.array([[600.0, 0, WIDTH / 2], [0, 600.0, HEIGHT / 2], [0, 0, 1]])
    for i in range(FRAMES):
        angle = 2 * np.pi * i / FRAMES
        centre = np.array([4 * np.cos(angle), 4 * np.sin(angle), 1.2 + 0.3 * np.sin(3 * angle)])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        frame = Frame(i, f"{i:04d}.jpg", WIDTH, HEIGHT, image=f"images/{i:06d}.jpg")
        frame.set_camera(Camera(WIDTH, HEIGHT, K, np.zeros(4), R, -R @ centre))
        radius = 120 + 30 * np.sin(angle + seed) + 18 * np.sin(7 * np.arctan2(v - 240, u - 320))
        mask = np.hypot(u - 320, v - 240) < radius
        x = 6 * i
        write_image(
            folder / str(frame.image),
            np.where(mask[..., None], base[50:530, x:][:, :WIDTH], 200 - base[:480, :640] // 4),
        )
        sequence.write_mask(frame, mask)
        sequence.write_depth(
            frame, np.where(rng.random((HEIGHT, WIDTH)) < 0.9, 3 + (u + v) / 900 - mask, 0).astype(np.float32)
        )
        frames.append(frame)
    sequence.write_frames(frames)
    write_points(sequence.sparse / "points3D.bin", rng)
    write_pairs(sequence, rng)
    return sequence


def write_points(path: Path, rng: np.random.Generator, count: int = 3000) -> None:
    path.parent.mkdir(parents=True)
    with path.open("wb") as file:
        file.write(struct.pack("<Q", count))
        for i, xyz in enumerate(rng.normal(size=(count, 3)) * 0.6):
            file.write(struct.pack("<Q3d3BdQ", i, *xyz, *rng.integers(0, 256, 3).tolist(), 0.5, 3) + bytes(24))


def write_pairs(sequence: Sequence, rng: np.random.Generator) -> None:
    for number in range(0, FRAMES, 3):
        write_image(sequence.views / f"{number:06d}.jpg", noise(rng, 224, 224))
    rows = [{"frame1": 3 * (i % 9), "frame2": 3 * (i % 9) + 3, "angle_deg": 10.0 + i, "overlap": 0.4,
             "n_correspondences": 512, "points": rng.uniform(10, 214, 2048).astype(np.float32)}
            for i in range(40)]  # fmt: skip
    pq.write_table(pa.Table.from_pylist(rows), sequence.correspondences)


def make(work: Path, kinds: Path, count: int) -> None:
    """`count` sequences whose pictures are hard links to one of a few kinds; of each 50 one failed, two half done."""
    import random

    for seed in range(KINDS):
        if not (kinds / str(seed) / "correspondences.parquet").exists():
            make_kind(kinds / str(seed), seed)
    for i in range(count):
        folder, rng = work / f"sequence_{i:04d}", random.Random(i)
        if (folder / "sequence.json").exists():
            continue
        shutil.copytree(kinds / str(i % KINDS), folder, copy_function=os.link, dirs_exist_ok=True)
        done = 1 if i % 50 == 7 else 3 if i % 50 in (20, 30) else 5
        (folder / "stages").mkdir(exist_ok=True)
        for stage in STAGES[: done + (done == 1)]:
            failed = done == 1 and stage == "sfm"
            marker = {"status": "failed" if failed else "ok", "seconds": 10.0, "cpu_seconds": rng.uniform(5, 40),
                      "reason": f"{folder}: only {i % 5 + 2} of 30 frames register" if failed else None,
                      "peak_memory_mib": 300.0, "details": {} if failed else details_of(stage, rng)}  # fmt: skip
            (folder / "stages" / f"{stage}.json").write_text(json.dumps(marker))
        info = SequenceInfo(folder.name, f"videos/{i}.mp4", "video", category=f"category {i % 12}", n_frames=30)
        info.attempts = [{"rung": "default", **details_of("sfm", rng), "verdict": "sensible"}]
        Sequence(folder).write_info(info)


def load_ms(browser: str, page: Path) -> int:
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1400,1000", "--dump-dom"]
    answer = subprocess.run([*command, page.resolve().as_uri()], capture_output=True, text=True, check=True)
    found = re.search(r'data-milliseconds="(\d+)"', answer.stdout)
    if found is None:
        raise SystemExit("the page's script did not run to its end")
    return int(found[1])


def say(figure: str, value: float, **more: Any) -> None:
    print(json.dumps({"figure": figure, "value": value, **more}), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--max-mb", type=float, default=None)
    given = parser.parse_args()
    from pipeline.engines import default_workers
    from pipeline.report.page import ReportConfig, write_report
    from pipeline.report.status_table import read_status

    make(given.out / "work", given.out / "kinds", given.count)
    config = ReportConfig(workers=default_workers(), **({"max_mb": given.max_mb} if given.max_mb else {}))
    start, cpu, page = time.perf_counter(), time.process_time(), given.out / "report.html"
    details = write_report(read_status([given.out / "work"]), page, config)
    say("report_cpu_seconds", round(time.process_time() - cpu, 1), sequences=given.count)
    say("report_seconds", round(time.perf_counter() - start, 1), workers=config.workers)
    say("report_peak_memory_mib", round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))
    say(
        "report_mb", round(details["bytes"] / 1e6, 1), limit=config.max_mb, without_pictures=details["without_pictures"]
    )
    browser = next((path for name in NAMES if (path := shutil.which(name))), None)
    if browser is not None:
        runs = [load_ms(browser, page) for _ in range(3)]
        say("page_load_ms", statistics.median(runs), runs=runs)


if __name__ == "__main__":
    main()
