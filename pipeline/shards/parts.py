"""One folder of shards by many containers: each writes its tars, whoever is last puts the folder together.

Beside OUT lies `.OUT.<fingerprint>.parts` with `tars/` and, for each whole tar, a note of its rows in `notes/`. A
container that is started again goes on with the tars that have no note yet. Who writes there holds `.lock`, shared;
who completes the folder, or clears what a killed job left, holds it alone.
"""

from __future__ import annotations

import fcntl
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
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

    def is_written(tar: TarPlan) -> bool:  # a kill after the tars were moved to OUT leaves notes without tars
        return (notes / f"{tar.name}.json").is_file() and (tars / tar.name).is_file()

    try:
        held = (parts / ".lock").open("a")
    except FileNotFoundError:
        return 0  # another container was last at this moment, and has finished
    with held as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        if not tars.is_dir():
            return 0
        for tar in share.of(plan):
            if not is_written(tar):
                with files.atomic_path(tars / tar.name) as partial:
                    written = write(partial, tar)
                files.write_json(notes / f"{tar.name}.json", written.to_note())
        missing = sum(not is_written(tar) for tar in plan)
        if missing and tars.is_dir():
            return missing
        fcntl.flock(lock, fcntl.LOCK_UN)  # else two that are last at the same moment would wait for each other
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not tars.is_dir():
            return 0
        shards = [WrittenShard.from_note(files.read_json(notes / f"{tar.name}.json")) for tar in plan]
        _clear(tars, {tar.name for tar in plan})
        with files.explaining_full_disk(out), holding_output(out, wait=True):
            finish(tars, shards)
            files.replace_folder(tars, out)
        shutil.rmtree(parts)
    return 0


def _clear(tars: Path, planned: set[str]) -> None:
    """Remove what killed containers left half-written: the folder becomes the dataset as it is."""
    for path in tars.iterdir():
        if path.name not in planned:
            path.unlink()


def clear_parts(out: Path, fingerprint: str | None = None) -> None:
    """Remove the parts of `out` that jobs left behind, of one fingerprint or of any, unless somebody writes there."""
    pattern = re.compile(rf"\.{re.escape(out.name)}\.{fingerprint or '[0-9a-f]+'}\.parts")
    for parts in [path for path in out.parent.iterdir() if pattern.fullmatch(path.name)]:
        with suppress(BlockingIOError, FileNotFoundError), (parts / ".lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(parts)
