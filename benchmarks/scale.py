"""How planning shards scales: seconds, CPU and memory for many sequences.

    python -m benchmarks.scale --sequences 100000              # columns in memory, nothing on the disk
    python -m benchmarks.scale --folders 5000 --out /tmp/x     # real folders of markers and views, read from the disk

Each prints one JSON line. `planning` goes from the columns to the samples of every tar; `reading` from folders to the
columns and to the fingerprint of the dataset.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dope.common.settings import config_hash
from pipeline.correspond.match import PAIR_SCHEMA
from pipeline.correspond.outline import Outline, outline_details
from pipeline.correspond.views import VIEW_SCHEMA, views_table
from pipeline.engines import Share
from pipeline.sequence import Sequence, SequenceInfo, find_sequences
from pipeline.shards.catalogue import Catalogue, make_catalogue, read_catalogue
from pipeline.shards.plan import ShardsConfig, plan_tars
from pipeline.stages import StageResult, cpu_seconds, peak_memory_mib, write_marker

PARTS = 16  # of an array job


def synthetic_outline(rng: np.random.Generator, views: int, pairs: int) -> Outline:
    """Frames 0, 3, 6 ... and random pairs of them, each once."""
    frames = np.arange(views, dtype=np.int32) * 3
    one, two = np.triu_indices(views, 1)
    chosen = np.sort(rng.choice(len(one), min(pairs, len(one)), replace=False))
    return Outline(frames, np.stack([frames[one[chosen]], frames[two[chosen]]], axis=1))


def synthetic_catalogue(sequences: int, views: int, pairs: int) -> Catalogue:
    rng = np.random.default_rng(0)
    outlines = [synthetic_outline(rng, views, pairs) for _ in range(min(sequences, 1000))]
    return make_catalogue(
        (Sequence(Path(f"work/object{k:06d}")), f"object{k:06d}", f"category{k % 50}", outlines[k % len(outlines)])
        for k in range(sequences)
    )


def measure_planning(catalogue: Catalogue) -> dict[str, float]:
    start, cpu = time.perf_counter(), cpu_seconds()
    plan, details = plan_tars(catalogue, ShardsConfig())
    part = Share(0, PARTS).of(plan)
    return {
        "sequences": len(catalogue),
        "samples": sum(details["pairs"].values()) + sum(details["views"].values()),
        "tars": len(plan),
        "tars_of_one_part": len(part),
        "planning_seconds": round(time.perf_counter() - start, 2),
        "planning_cpu_seconds": round(cpu_seconds() - cpu, 2),
        "peak_memory_mib": round(peak_memory_mib(), 1),
    }


def write_folders(work: Path, sequences: int, views: int, pairs: int) -> None:
    """Folders as the correspond stage leaves them, with empty pictures and a few correspondences."""
    rng = np.random.default_rng(0)
    for k in range(sequences):
        sequence = Sequence(work / f"object{k:06d}")
        sequence.views.mkdir(parents=True)
        outline = synthetic_outline(rng, views, pairs)
        for frame in outline.frames.tolist():
            (sequence.views / f"{frame:06d}.jpg").touch()
            (sequence.views / f"{frame:06d}.png").touch()
        names = [{"frame": f, "image": f"views/{f:06d}.jpg", "mask": f"views/{f:06d}.png"} for f in outline.frames]
        view_rows = pa.Table.from_pylist(names, VIEW_SCHEMA)
        points = np.zeros(8, np.float32)
        pair_rows = [{"frame1": a, "frame2": b, "points": points} for a, b in outline.pairs.tolist()]
        pair_table = pa.Table.from_pylist(pair_rows, PAIR_SCHEMA)
        pq.write_table(view_rows, views_table(sequence))
        pq.write_table(pair_table, sequence.correspondences, row_group_size=8)
        sequence.write_info(SequenceInfo(sequence.id, "film.mp4", "video", f"category{k % 50}", sequence.id))
        details = {"content": f"{k:032x}", "outline": outline_details(sequence, view_rows, pair_table)}
        write_marker(sequence, StageResult(sequence.id, "correspond", "ok", details=details, fingerprint=f"{k:016x}"))


def measure_reading(work: Path) -> tuple[Catalogue, dict[str, float]]:
    start, cpu = time.perf_counter(), cpu_seconds()
    catalogue, marks, left_out = read_catalogue(find_sequences(work))
    config_hash({"sequences": marks, "left_out": left_out})
    return catalogue, {
        "reading_seconds": round(time.perf_counter() - start, 2),
        "reading_cpu_seconds": round(cpu_seconds() - cpu, 2),
        "reading_ms_a_sequence": round(1000 * (cpu_seconds() - cpu) / len(catalogue), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=100_000, help="sequences in memory")
    parser.add_argument("--folders", type=int, default=0, help="sequences on the disk instead")
    parser.add_argument("--views", type=int, default=20, help="views of a sequence")
    parser.add_argument("--pairs", type=int, default=64, help="pairs of a sequence")
    parser.add_argument("--out", type=Path, default=Path("scale"), help="where the folders go; removed at the end")
    options = parser.parse_args()
    if not options.folders:
        catalogue = synthetic_catalogue(options.sequences, options.views, options.pairs)
        print(json.dumps(measure_planning(catalogue)))
        return
    try:
        write_folders(options.out, options.folders, options.views, options.pairs)
        catalogue, facts = measure_reading(options.out)
        print(json.dumps({**measure_planning(catalogue), **facts}))
    finally:
        shutil.rmtree(options.out, ignore_errors=True)


if __name__ == "__main__":
    main()
