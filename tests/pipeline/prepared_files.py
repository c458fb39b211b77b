"""Prepared sequences as files alone, at any stage and in any state, for the tests of status and report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

STAGES = ("frames", "sfm", "depth", "masks", "correspond")
DETAILS: dict[str, dict[str, Any]] = {
    "frames": {"frames": 60, "kept": 50, "warnings": []},
    "sfm": {"rung": "default", "n_frames": 50, "n_registered": 48, "registered_share": 0.96, "n_points": 2983,
            "mean_error_px": 0.81, "median_angle_deg": 20.4, "n_attempts": 1, "warnings": ["2 models were found"]},
    "depth": {"frames_with_depth": 48, "coverage": 0.7, "sparse_median_error": 0.003, "sparse_within_2_percent": 0.95},
    "masks": {"from": "GrabCut", "masks": 47, "missing": 1, "empty": 2, "mean_share": 0.3},
    "correspond": {"views": 17, "pairs": 64, "median_correspondences": 512.0, "median_angle_deg": 40.0,
                   "median_overlap": 0.3},
}  # fmt: skip


def write_marker(folder: Path, stage: str, status: str = "ok", reason: str | None = None, **details: Any) -> None:
    values = {"sequence": folder.name, "stage": stage, "status": status, "reason": reason, "seconds": 2.0,
              "cpu_seconds": 1.5, "peak_memory_mib": 100.0 + len(stage), "details": DETAILS[stage] | details,
              "fingerprint": "0", "trace": None, "versions": {}}  # fmt: skip
    (folder / "stages").mkdir(parents=True, exist_ok=True)
    (folder / "stages" / f"{stage}.json").write_text(json.dumps(values))


def write_files(folder: Path, done: int = 5, failed: str | None = None, **info: Any) -> Path:
    """sequence.json and the markers of the first `done` stages; `failed` is why the next one failed."""
    values = {"id": folder.name, "source": f"videos/{folder.name}.mp4", "kind": "video", "category": "cup",
              "instance": folder.name, "n_frames": 60, "n_registered": 48, "registered_share": 0.96,
              "attempts": [{"rung": "default", "verdict": "sensible", "n_registered": 48, "n_frames": 50}],
              "masks_from": "grabcut", **info}  # fmt: skip
    folder.mkdir(parents=True)
    (folder / "sequence.json").write_text(json.dumps(values))
    for stage in STAGES[:done]:
        write_marker(folder, stage)
    if failed is not None:
        write_marker(folder, STAGES[done], "failed", failed)
    return folder
