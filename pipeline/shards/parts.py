"""One folder of shards by many containers: each writes its tars, whoever is last puts the folder together.

Beside OUT lies `.OUT.<fingerprint>.parts` with `tars/` and, for each whole tar, a note of its rows in `notes/`. A
container that is started again goes on with the tars that have no note yet.
"""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Callable
from pathlib import Path

from dope.common import files
from pipeline.engines import Share, holding_output
from pipeline.shards.plan import Plan, TarPlan
from pipeline.shards.writer import WrittenShard


def write_part(
    out: Path,
    fingerprint: str,
    plan: Plan,
    share: Share,
    write: Callable[[Path, TarPlan], WrittenShard],
    finish: Callable[[Path, list[WrittenShard]], None],
) -> int:
    """Write this container's tars and, if no other is missing, let `finish` complete the folder and move it to `out`.

    Args:
        fingerprint: of the dataset; containers with other inputs or settings do not mix.
        write: writes one tar.
        finish: writes tables and manifest beside the tars.

    Returns:
        The number of tars that other containers have still to write; 0 if the dataset is complete.
    """
    parts = out.with_name(f".{out.name}.{fingerprint}.parts")
    tars, notes = parts / "tars", parts / "notes"
    tars.mkdir(parents=True, exist_ok=True)
    for tar in share.of(plan):
        if not (notes / f"{tar.name}.json").is_file():
            with files.atomic_path(tars / tar.name) as partial:
                written = write(partial, tar)
            files.write_json(notes / f"{tar.name}.json", written.to_note())
    missing = sum(not (notes / f"{tar.name}.json").is_file() for tar in plan)
    if missing and tars.is_dir():
        return missing
    try:
        lock = (parts / ".lock").open("a")
    except FileNotFoundError:
        return 0  # another container was last at the same moment, and has finished
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if tars.is_dir():
            shards = [WrittenShard.from_note(files.read_json(notes / f"{tar.name}.json")) for tar in plan]
            with files.explaining_full_disk(out), holding_output(out, wait=True):
                finish(tars, shards)
                files.replace_folder(tars, out)
            shutil.rmtree(parts)
    return 0
