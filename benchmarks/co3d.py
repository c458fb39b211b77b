"""What it costs to read CO3D's annotations: a category of a million frames, its index, and a run with nothing to do.

    python -m benchmarks.co3d                      # 1,000,000 frames of 10,000 sequences, contiguous and shuffled
    python -m benchmarks.co3d --frames 100000

Prints JSON lines: CPU seconds (user and system) and peak resident memory of each part, each in a process of its own.
`plan` is what every run pays, whether anything is to be done or not: reading the index and looking at the sizes of the
files of all sequences (which do not exist here, so that this is the cost of asking).
"""

from __future__ import annotations

import argparse
import gzip
import json
import multiprocessing
import random
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

FRAMES_OF_A_SEQUENCE = 100


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--folder", type=Path, help="where to write (default: a temporary folder)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        for shuffled in (False, True):
            root, work = Path(name) / f"co3d-{shuffled}", Path(name) / f"work-{shuffled}"
            size = write_category(root / "apple", args.frames, shuffled=shuffled)
            about = {"frames": args.frames, "shuffled": shuffled, "megabytes_zipped": round(size / 1e6, 1)}
            for part in (index_category, plan_everything):
                print(json.dumps({"part": part.__name__, **about, **measured(part, root, work)}), flush=True)


def write_category(folder: Path, n_frames: int, *, shuffled: bool) -> int:
    """Write frame and sequence annotations as CO3D has them, with numbers of full length; returns the zipped bytes.

    Shuffled frames do not lie together by sequence, the worst order an index can be given; they keep their order
    within blocks, so that this program itself need not hold them all.
    """
    rng = random.Random(0)
    folder.mkdir(parents=True)
    n_sequences = max(1, n_frames // FRAMES_OF_A_SEQUENCE)
    names = [f"{rng.randrange(600)}_{rng.randrange(100_000)}_{i:06d}" for i in range(n_sequences)]
    with gzip.open(folder / "frame_annotations.jgz", "wt", encoding="utf8", compresslevel=1) as file:
        for i in range(n_frames):
            sequence, number = (i % n_sequences, i // n_sequences) if shuffled else divmod(i, FRAMES_OF_A_SEQUENCE)
            file.write(("[" if i == 0 else ", ") + json.dumps(frame_row(rng, names[sequence], number + 1)))
        file.write("]")
    with gzip.open(folder / "sequence_annotations.jgz", "wt", encoding="utf8", compresslevel=1) as file:
        rows = [{"sequence_name": name, "category": "apple", "viewpoint_quality_score": rng.random()} for name in names]
        json.dump(rows, file)
    return (folder / "frame_annotations.jgz").stat().st_size


def frame_row(rng: random.Random, name: str, number: int) -> dict[str, Any]:
    base = f"apple/{name}"
    return {
        "sequence_name": name,
        "frame_number": number,
        "frame_timestamp": number / 10,
        "image": {"path": f"{base}/images/frame{number:06d}.jpg", "size": [1896, 1066]},
        "depth": {
            "path": f"{base}/depths/frame{number:06d}.jpg.geometric.png",
            "scale_adjustment": rng.random(),
            "mask_path": f"{base}/depth_masks/frame{number:06d}.png",
        },
        "mask": {"path": f"{base}/masks/frame{number:06d}.png", "mass": rng.random() * 1e6},
        "viewpoint": {
            "R": [[rng.random() for _ in range(3)] for _ in range(3)],
            "T": [rng.random() for _ in range(3)],
            "focal_length": [rng.random(), rng.random()],
            "principal_point": [0.0, 0.0],
            "intrinsics_format": "ndc_norm_image_bounds",
        },
        "meta": {"frame_type": "train_known", "frame_splits": ["singlesequence_apple_test_0_known"]},
    }


def index_category(root: Path, work: Path) -> dict[str, Any]:
    from pipeline.co3d.index import open_index

    index = open_index(root / "apple", work)
    return {"megabytes_index": round(index.path.stat().st_size / 1e6, 1)}


def plan_everything(root: Path, work: Path) -> dict[str, Any]:
    from pipeline.co3d.prepare import Co3dConfig, prepare_co3d
    from pipeline.co3d.sources import Choice, find_co3d
    from pipeline.tasks import RunOptions

    sources, _, _ = find_co3d(root, work, Choice())
    rows = prepare_co3d(sources, work, Co3dConfig(), RunOptions())
    return {"sequences": len(sources), "rows": len(rows)}


def measured(part: Callable[[Path, Path], dict[str, Any]], root: Path, work: Path) -> dict[str, Any]:
    """Run one part in a fresh process: its own figures, CPU seconds, and peak memory of that process."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return pool.apply(_measure, (part, root, work))


def _measure(part: Callable[[Path, Path], dict[str, Any]], root: Path, work: Path) -> dict[str, Any]:
    start = time.perf_counter()
    found = part(root, work)
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return {
        **found,
        "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 2),
        "seconds": round(time.perf_counter() - start, 2),
        "peak_memory_mib": round(usage.ru_maxrss / 1024, 1),
    }


if __name__ == "__main__":
    main()
