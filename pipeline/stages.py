"""One stage over one sequence: skip what is done, run what is not, and always leave a marker.

The marker WORK/<id>/stages/<stage>.json is written last. It holds the status (ok, empty or failed), the reason, a
fingerprint of the stage's version, settings and inputs, seconds, peak memory and versions. A stage whose marker has the
same fingerprint is not run again; the fingerprint of a stage is an input of the next: a change travels down the line.
"""

from __future__ import annotations

import resource
import shutil
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import dope
from dope.common import files, settings
from dope.common.errors import BadInput, DiskFull, DopeError
from pipeline.children import is_lack_of_memory
from pipeline.sequence import Sequence

LATER_STAGES = {
    "frames": ("sfm", "depth", "masks", "correspond"),
    "sfm": ("depth", "masks", "correspond"),
    "depth": ("correspond",),
    "masks": ("correspond",),
    "correspond": (),
}
"""What must be done again after a stage was run: their markers are removed before it starts."""

STAGE_VERSIONS = {"frames": 3, "sfm": 2, "depth": 2, "masks": 2, "correspond": 2}
"""Part of each fingerprint. Raise a stage's number by hand in the change that makes it write something else from the
same input and settings: what an older version wrote is then made again, with all stages after it."""

FULL_BYTES = 8 << 20
"""A disk with less room than this is full: a failure on it is the disk's."""

Status = Literal["ok", "empty", "failed"]


@dataclass
class StageResult:
    """One row of the table that a stage command prints."""

    sequence: str
    stage: str
    status: Status
    reason: str | None = None
    skipped: bool = False
    """True where the marker was already there and nothing was run."""
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """User and system time of this process and its children."""
    peak_memory_mib: float = 0.0
    details: dict[str, Any] = field(default_factory=dict)
    """What the stage has to say of its output: counts, shares, errors. JSON values only."""
    fingerprint: str = ""
    trace: str | None = None
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        return self.status == "ok"


def marker_path(sequence: Sequence, stage: str) -> Path:
    return sequence.stages / f"{stage}.json"


def read_marker(sequence: Sequence, stage: str) -> StageResult | None:
    """The result of the last run of a stage, or None. A damaged marker counts as none."""
    path = marker_path(sequence, stage)
    if not path.exists():
        return None
    try:
        values = files.read_json(path)
        marker = StageResult(**{k: v for k, v in values.items() if k in StageResult.__dataclass_fields__})
    except (BadInput, TypeError, AttributeError):
        return None
    return marker if isinstance(marker.details, dict) else None


def require(sequence: Sequence, stage: str, command: str) -> StageResult:
    """The marker of an earlier stage that must have gone well. Raises `BadInput` naming the command to run."""
    marker = read_marker(sequence, stage)
    if marker is None:
        raise BadInput(f"stage '{stage}' has not been run", where=sequence.folder, remedy=f"Run `{command}` first")
    if not marker.ok:
        raise BadInput(f"stage '{stage}' {marker.status}: {marker.reason}", where=sequence.folder)
    return marker


def fingerprint(stage: str, config: Any, inputs: Any) -> str:
    """Identifies what a stage would do: its version, its settings and the fingerprints of what it reads."""
    config_values = settings.to_dict(config) if hasattr(config, "__dataclass_fields__") else config
    version = STAGE_VERSIONS.get(stage, 1)
    return settings.config_hash({"stage": stage, "version": version, "config": config_values, "inputs": inputs})


def run_stage(
    sequence: Sequence,
    stage: str,
    config: Any,
    inputs: Any,
    work: Callable[[], dict[str, Any]],
    *,
    overwrite: bool = False,
    retry_failed: bool = False,
) -> StageResult:
    """Run `work` unless its marker says it is done; failures become a row, never an exception.

    Args:
        config: frozen dataclass of settings (hashed).
        inputs: JSON value that identifies the inputs, e.g. fingerprints of earlier stages (hashed).
        work: does the stage and returns its details; raises `BadInput` for input that cannot be used. A detail
            `{"empty": reason}` marks the stage as empty.
        overwrite: run even where the marker is right.
        retry_failed: run again where the marker says failed or empty.

    Returns:
        The row, which is also in the marker.

    Raises:
        DiskFull: it concerns every item. The stage has no marker then, and is run again.
        MemoryError: or what C++ calls so; whoever set the limit says what it was.
    """
    mark = fingerprint(stage, config, inputs)
    done = read_marker(sequence, stage)
    if done and done.fingerprint == mark and not overwrite and (done.ok or not retry_failed):
        done.skipped = True
        return done
    for name in (*reversed(LATER_STAGES[stage]), stage):
        marker_path(sequence, name).unlink(missing_ok=True)
    start, cpu = time.perf_counter(), cpu_seconds()
    result = StageResult(sequence.id, stage, "ok", fingerprint=mark, versions={"dope": dope.__version__})
    try:
        result.details = work()
        if isinstance(result.details.get("empty"), str):  # a number is a count of empty things
            result.status, result.reason = "empty", result.details.pop("empty")
    except DiskFull:
        raise
    except DopeError as error:
        result.status, result.reason = "failed", str(error)
    except Exception as error:  # one bad item never stops the rest: it becomes a row with its traceback
        if is_lack_of_memory(error):
            raise
        result.status, result.reason = "failed", f"{type(error).__name__}: {error}"
        result.trace = traceback.format_exc(limit=-8)
    sequence.folder.mkdir(parents=True, exist_ok=True)
    if result.status == "failed":
        blame_full_disk(sequence, stage, str(result.reason))
    result.seconds = round(time.perf_counter() - start, 3)
    result.cpu_seconds = round(cpu_seconds() - cpu, 3)
    result.peak_memory_mib = round(peak_memory_mib(), 1)
    write_marker(sequence, result)
    return result


def blame_full_disk(sequence: Sequence, stage: str, reason: str) -> None:
    """Raise `DiskFull` where a stage failed on a full disk: COLMAP and SQLite report that in words of their own."""
    if shutil.disk_usage(sequence.folder).free < FULL_BYTES:
        raise DiskFull(
            f"no space left on the disk (stage '{stage}' says: {reason})",
            where=sequence.folder,
            remedy="Free some space or choose another --out, then run the same command again",
        )


def write_marker(sequence: Sequence, result: StageResult) -> None:
    """Write a stage's done-marker: the last thing that a stage does."""
    values = asdict(result)
    values.pop("skipped")
    files.write_json(marker_path(sequence, result.stage), values)


def cpu_seconds() -> float:
    """User and system seconds of this process and of its finished children."""
    own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def peak_memory_mib() -> float:
    """The larger of this process's and its children's peak resident memory."""
    unit = 1 if sys.platform == "darwin" else 1024
    own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return max(own.ru_maxrss, children.ru_maxrss) * unit / 2**20
