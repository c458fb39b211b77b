"""One folder of shards by many containers: each writes its tars, whoever is last puts the folder together.

Beside OUT lies `.OUT.<fingerprint>.parts` with `tars/` and, for each whole tar, a note of its rows in `notes/`. A
container that is started again goes on with the tars that have no note yet.
"""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from dope.common import files
from pipeline.engines import Share
from pipeline.shard_writer import PairSample, ViewSample, WrittenShard, write_tar

Plan = list[tuple[str, list[PairSample] | list[ViewSample]]]
"""Name and samples of every tar of the dataset, the same in every container."""


def write_part(
    out: Path,
    fingerprint: str,
    plan: Plan,
    share: Share,
    finish: Callable[[Path, list[WrittenShard]], None],
    report: Callable[[int], None],
) -> int:
    """Write this container's tars and, if no other is missing, let `finish` complete the folder and move it to `out`.

    Args:
        fingerprint: of the dataset; containers with other inputs or settings do not mix.
        finish: writes tables and manifest beside the tars.
        report: called with the number of samples of each tar that is done.

    Returns:
        The number of tars that other containers have still to write; 0 if the dataset is complete.
    """
    parts = out.with_name(f".{out.name}.{fingerprint}.parts")
    tars, notes = parts / "tars", parts / "notes"
    tars.mkdir(parents=True, exist_ok=True)
    for name, samples in share.of(plan):
        if not (notes / f"{name}.json").is_file():
            with files.atomic_path(tars / name) as partial:
                written = write_tar(partial, samples, name)
            files.write_json(notes / f"{name}.json", asdict(written))
        report(len(samples))
    missing = sum(not (notes / f"{name}.json").is_file() for name, _ in plan)
    if missing and tars.is_dir():
        return missing
    try:
        lock = (parts / ".lock").open("a")
    except FileNotFoundError:
        return 0  # another container was last at the same moment, and has finished
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if tars.is_dir():
            shards = [WrittenShard(**files.read_json(notes / f"{name}.json")) for name, _ in plan]
            with files.explaining_full_disk(out):
                finish(tars, shards)
                files.replace_folder(tars, out)
            shutil.rmtree(parts)
    return 0
