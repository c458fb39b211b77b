"""100,000 prepared sequences through status, merge and the planning of shards, measured: one JSON line a figure.

    python -m benchmarks.scale_status --out /tmp/dope-scale --count 100000

Writes folders with the small JSON files of finished, failed and half-done sequences (kept for the next run), reads
their status, writes and merges ten Parquet files of it, filters the result, reads the markers once more and plans
shards. Each step runs in a process of its own, and `all` is status, merge and shards in one process, one figure.
Seconds are wall-clock and CPU (with child processes); `peak_memory_mib` is the peak of the largest process, and
`peak_memory_sum_mib` the sum of the peaks of all, parent and pool. Finished sequences share one folder of views and its
tables by links, or 100,000 would be millions of files.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.memory import PeakMemory

STAGES = ("frames", "sfm", "depth", "masks", "correspond")
CATEGORIES = ("apple", "bench", "cup", "hydrant", "teddybear")


def details_of(stage: str, rng: random.Random) -> dict[str, Any]:
    share = round(min(1.0, rng.gauss(0.95, 0.08)), 4)
    return {
        "frames": {"frames": 202, "kept": 100, "dropped": {"every 2nd": 102}, "ordered": True, "width": 640,
                   "height": 480, "warnings": []},
        "sfm": {"rung": "default", "mapper": "strict", "n_frames": 100, "n_registered": round(100 * share),
                "registered_share": share, "n_points": rng.randrange(500, 9000),
                "mean_error_px": round(rng.uniform(0.4, 1.4), 3), "median_angle_deg": 21.3, "n_attempts": 1,
                "object": {"centre": [0.1, 0.2, 0.3], "radius": 2.1, "n_points": 900, "method": "masks"},
                "warnings": [] if share > 0.9 else ["2 models were found: the largest has 80 frames"]},
        "depth": {"frames_with_depth": 100, "frames_without_depth": [], "coverage": round(rng.uniform(0.4, 0.9), 4),
                  "mask_coverage": 0.9, "sparse_points_compared": 9000, "sparse_median_error": 0.003,
                  "sparse_within_1_percent": 0.9, "sparse_within_2_percent": 0.95, "method": "sgbm_depth"},
        "masks": {"from": "GrabCut", "masks": 100, "missing": 0, "empty": 0, "mean_share": 0.3},
        "correspond": {"views": 34, "views_with_depth": 34, "frames_skipped": {}, "candidate_pairs": 300, "pairs": 64,
                       "pairs_dropped": {}, "median_correspondences": 512.0, "median_angle_deg": 40.0,
                       "median_overlap": 0.3},
    }[stage]  # fmt: skip


def make(work: Path, count: int) -> None:
    """Write the sequences that are not there yet: of each hundred, three failed in sfm and two wait for masks."""
    from benchmarks.scale import write_folders
    from pipeline.sequence import find_sequences
    from pipeline.stages import read_marker

    shared = work.parent / "shared"
    if not shared.is_dir():
        write_folders(shared, 1, views=34, pairs=64)
    (model,) = find_sequences(shared)
    marker_of_model = read_marker(model, "correspond")
    assert marker_of_model is not None
    for i in range(count):
        folder, rng = work / f"sequence_{i:06d}", random.Random(i)
        if (folder / "sequence.json").exists():
            continue
        (folder / "stages").mkdir(parents=True, exist_ok=True)
        done = 2 if i % 100 < 3 else 3 if i % 100 < 5 else 5
        for stage in STAGES[:done]:
            marker = {"sequence": folder.name, "stage": stage, "status": "ok", "reason": None, "seconds": 12.345,
                      "cpu_seconds": 11.234, "peak_memory_mib": 230.4, "details": details_of(stage, rng),
                      "fingerprint": "942281e0ecd03b5e", "trace": None, "versions": {"dope": "0.1.0"}}  # fmt: skip
            if stage == "correspond":
                marker["details"] |= marker_of_model.details
            if done == 2 and stage == "sfm":
                reason = f"{folder}: only {i % 7 + 3} of 100 frames register. Take more views"
                marker |= {"status": "failed", "reason": reason, "details": {}}
            (folder / "stages" / f"{stage}.json").write_text(json.dumps(marker, indent=1))
        info = {"id": folder.name, "source": f"videos/{i}.mp4", "kind": "video", "category": CATEGORIES[i % 5],
                "instance": folder.name, "licence": None, "unit": "object radius", "ordered": True, "n_frames": 100,
                "n_registered": 95, "registered_share": 0.95, "attempts": [details_of("sfm", rng)],
                "masks_from": "grabcut"}  # fmt: skip
        if done == 5:
            for name in ("views", "views.parquet", "correspondences.parquet"):
                (folder / name).unlink(missing_ok=True)
                (folder / name).symlink_to((model.folder / name).absolute())
        (folder / "sequence.json").write_text(json.dumps(info, indent=1))


def status(out: Path) -> dict[str, Any]:
    from pipeline.report.status_table import read_status, write_parquet

    table = read_status([out / "work"])
    for part in range(10):
        size = -(-len(table) // 10)
        write_parquet(table.slice(part * size, size), out / f"part{part}.parquet")
    return {"rows": len(table)}


def merge(out: Path) -> dict[str, Any]:
    from pipeline.report.filters import parse_condition, select
    from pipeline.report.status_table import read_status, write_parquet

    table = read_status([out / f"part{part}.parquet" for part in range(10)])
    write_parquet(table, out / "all.parquet")
    chosen = select(table, [parse_condition("category=apple"), parse_condition("registered_share<0.9")])
    return {"rows": len(table), "duplicates": sum(table["duplicate"].to_pylist()), "apples_under_0.9": len(chosen)}


def table(out: Path) -> dict[str, Any]:
    from pipeline.report.status_table import read_status
    from pipeline.report.status_text import lines_of

    return {"lines": sum(1 for _ in lines_of(read_status([out / "all.parquet"])))}


def shards(out: Path) -> dict[str, Any]:
    from dope.common.settings import config_hash
    from pipeline.sequence import find_sequences
    from pipeline.shards.catalogue import read_catalogue
    from pipeline.shards.plan import ShardsConfig, plan_tars

    catalogue, marks, left_out = read_catalogue(find_sequences(out / "work"))
    config_hash({"sequences": marks, "left_out": left_out})
    plan, _ = plan_tars(catalogue, ShardsConfig())
    return {"packed": len(catalogue), "left_out": len(left_out), "tars": len(plan)}


def everything(out: Path) -> dict[str, Any]:
    return {**status(out), **merge(out), **shards(out)}


STEPS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "status": status,
    "merge": merge,
    "table": table,
    "shards": shards,
    "all": everything,
}


def measure(step: str, out: Path) -> None:
    start, before = time.perf_counter(), time.process_time()
    with PeakMemory() as memory:
        result = STEPS[step](out)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    values = {
        "step": step,
        **result,
        "seconds": round(time.perf_counter() - start, 2),
        "cpu_seconds": round(time.process_time() - before + children.ru_utime + children.ru_stime, 2),
        "peak_memory_mib": memory.largest_mib,
        "peak_memory_sum_mib": memory.sum_mib,
        "processes": len(memory.peaks_kib),
    }
    print(json.dumps(values), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--step", choices=STEPS, help="only this step, in this process")
    given = parser.parse_args()
    if given.step:
        measure(given.step, given.out)
        return
    make(given.out / "work", given.count)
    for step in STEPS:
        command = [sys.executable, "-m", "benchmarks.scale_status", "--out", str(given.out), "--step", step]
        subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
