"""Ours against COLMAP's stock settings, on the same photos in one run: CPU seconds, registered frames, rotations.

    python -m benchmarks.stock --captures ../shared/data/captures --out /tmp/stock

Stock is what COLMAP does without a word said to it: `pycolmap.extract_features`, `match_exhaustive` or
`match_sequential`, and `incremental_mapping`, all with their default options (8,192 SIFT features from an octave below
the photo's own size, at its own size; overlap 10 with powers of two), one camera for all photos (`CameraMode.SINGLE`),
on the CPU. Ours is `dope prep colmap` with its default settings, stages `frames` and `sfm`.

Both run in child processes on one thread, and CPU seconds are user and system time: of the whole child for stock, of
the two stages as their markers tell for ours, and, as `with_start`, of the whole command with the start of its
interpreters and a depth stage that computes nothing (`--depth sparse`). Rotations are compared between neighbouring
photos with the reference cameras of each capture, over the photos that ours and stock both registered.

Prints one JSON line a capture and way of matching. `value` is stock's CPU seconds over those of our two stages, and
favours ours a little: stock's child starts an interpreter and imports pycolmap within its seconds, our stages do not.
`with_start` is like for like, and the smaller figure: whole commands on both sides, ours with the
start of the command and of its child and a sparse depth stage, where stock starts once.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path, PurePath

from pipeline.cameras.compare import compare_cameras, read_reference
from pipeline.inputs.photos import list_photos
from pipeline.sequence import Frame, Sequence
from pipeline.stages import read_marker

CAPTURES = ("fox", "plush_doll")
MATCHERS = ("exhaustive", "sequential")


def reconstruct_stock(images: Path, out: Path, matcher: str) -> None:
    """The largest model of COLMAP's stock settings on a folder of photos, into `out`; runs in a process of its own."""
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    database, names = out / "database.db", [path.name for path in list_photos(images)]
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    mapping = pycolmap.IncrementalPipelineOptions()
    extraction.num_threads = matching.num_threads = mapping.num_threads = 1
    match = pycolmap.match_exhaustive if matcher == "exhaustive" else pycolmap.match_sequential
    # entered first, so that ids follow the names, which sequential matching goes by
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, images, pycolmap.CameraMode.SINGLE, names)
    pycolmap.extract_features(database, images, names, extraction_options=extraction, device=pycolmap.Device.cpu)
    match(database, matching_options=matching, device=pycolmap.Device.cpu)
    models = pycolmap.incremental_mapping(database, images, out, mapping)
    best = max(models.values(), key=lambda model: model.num_reg_images())
    (out / "best").mkdir()
    best.write_binary(out / "best")


def stock_frames(model: Path, names: list[str]) -> list[Frame]:
    """The rows of the photos with the cameras of a COLMAP model."""
    import numpy as np
    import pycolmap

    from pipeline.geometry import Camera

    reconstruction = pycolmap.Reconstruction(model)
    frames = {name: Frame(i, name, 1, 1) for i, name in enumerate(names)}
    for image in reconstruction.images.values():
        if image.has_pose:
            camera, pose = reconstruction.cameras[image.camera_id], image.cam_from_world()
            R, t = pose.rotation.matrix(), np.array(pose.translation)
            frames[image.name].set_camera(
                Camera(camera.width, camera.height, np.array(camera.calibration_matrix()), np.zeros(4), R, t)
            )
    return list(frames.values())


def cpu_seconds_of(command: list[str]) -> float:
    """User and system time of a command and of all its children. Raises RuntimeError where it fails."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=environment)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(command)} ended with {child.returncode}")
    return usage.ru_utime + usage.ru_stime


def fresh(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def measure(capture: Path, out: Path, matchers: list[str]) -> None:
    names = [path.name for path in list_photos(capture / "images")]
    reference = read_reference(capture / "cameras.json")
    work = fresh(out / capture.name / "ours")
    words = ["prep", "colmap", capture, "--out", work, "--depth", "sparse", "--workers", "1", "--json"]
    with_start = cpu_seconds_of([sys.executable, "-m", "cli", *map(str, words)])
    sequence = Sequence(work / capture.name)
    markers = [read_marker(sequence, stage) for stage in ("frames", "sfm")]
    ours = sum(marker.cpu_seconds for marker in markers if marker is not None)
    our_frames = sequence.read_frames()
    for matcher in matchers:
        folder = fresh(out / capture.name / matcher)
        stock_words = [sys.executable, "-m", "benchmarks.stock", "--stock", matcher]
        stock = cpu_seconds_of([*stock_words, "--captures", str(capture / "images"), "--out", str(folder)])
        frames = stock_frames(folder / "best", names)
        both = {f.source_name for f in our_frames if f.registered} & {f.source_name for f in frames if f.registered}
        shared = {name: camera for name, camera in reference.items() if name in {PurePath(n).stem for n in both}}
        error, stock_error = (compare_cameras(rows, shared) for rows in (our_frames, frames))
        rotation, stock_rotation = (e.relative_rotation_median_deg for e in (error, stock_error))
        print(
            json.dumps(
                {
                    "figure": "stock_over_ours_cpu_seconds",
                    "value": round(stock / ours, 2),
                    "capture": capture.name,
                    "stock_matching": matcher,
                    "with_start": round(stock / with_start, 2),
                    "cpu_seconds": {"stock": round(stock, 1), "ours": round(ours, 1)},
                    "photos": len(names),
                    "registered": {
                        "stock": sum(frame.registered for frame in frames),
                        "ours": sum(frame.registered for frame in our_frames),
                    },
                    "rotation_median_deg": {"stock": round(stock_rotation, 4), "ours": round(rotation, 4)},
                    "rotation_ratio": round(rotation / stock_rotation, 3),
                }
            ),
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=Path, default=Path("../shared/data/captures"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", default=list(CAPTURES), help="captures to measure")
    parser.add_argument("--matchers", nargs="+", choices=MATCHERS, default=list(MATCHERS))
    parser.add_argument("--stock", choices=MATCHERS, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.stock is not None:
        reconstruct_stock(given.captures, given.out, given.stock)
        return
    for name in given.only:
        measure(given.captures / name, given.out, given.matchers)


if __name__ == "__main__":
    main()
