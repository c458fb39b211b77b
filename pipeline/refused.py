"""Inputs that cannot be used, kept in WORK/.refused/<id>.json: status and report show them as failed rows.

They have no folder of their own: their path is wrong, or their id is that of another input's sequence. A note goes when
its input is accepted, or when a later run no longer names it.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from dope.common import files
from pipeline.sequence import sequence_id
from pipeline.stages import StageResult

FOLDER = ".refused"


def refused(sequence: str, stage: str, reason: str) -> StageResult:
    """The row of an input that cannot even be begun."""
    return StageResult(sequence, stage, "failed", reason=reason, details={"refused": True})


def keep_refused(work: Path, rows: Iterable[StageResult], *, elsewhere: Iterable[str] = ()) -> None:
    """Make the notes in WORK those of this run.

    Args:
        rows: of the run; those made by `refused` are kept.
        elsewhere: ids of what other parts of an array job begin: their notes stay.
    """
    reasons: dict[str, list[StageResult]] = {}
    for row in rows:
        if row.details.get("refused"):
            reasons.setdefault(sequence_id(row.sequence), []).append(row)
    others = {sequence_id(name) for name in elsewhere}
    folder = work / FOLDER
    with suppress(OSError):  # what cannot be written to is told by the rows of the run, as all of this is
        for name, its in reasons.items():
            reason = " | ".join(str(row.reason) for row in its)
            note = {"sequence": its[0].sequence, "stage": its[0].stage, "status": "failed", "reason": reason}
            files.write_json(folder / f"{name}.json", note)
        for path in folder.glob("[!.]*.json") if folder.is_dir() else ():
            if path.stem not in reasons and path.stem not in others:
                path.unlink(missing_ok=True)
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
