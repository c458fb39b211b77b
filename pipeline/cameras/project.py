"""WORK/<id> as a COLMAP project: database.db and project.ini beside images/ and sparse/.

`colmap gui --project_path project.ini`, started in the folder, opens it. The paths in project.ini are relative: COLMAP
reads them from where it was started, so that a WORK that was moved or mounted elsewhere still opens.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from dope.common import files
from pipeline.cameras import colmap
from pipeline.sequence import Frame, Sequence

DATABASE, PROJECT = "database.db", "project.ini"


def write_project(sequence: Sequence, frames: list[Frame], database: Path | None = None) -> float:
    """Put `database` into the sequence, or one that holds the images alone, with the project file.

    Args:
        frames: all rows of the sequence.
        database: the features, matches and two-view geometries of an attempt; it is copied.

    Returns:
        Size of the database, MiB.
    """
    path = sequence.folder / DATABASE
    with files.atomic_path(path) as partial:
        partial.unlink(missing_ok=True)
        if database is None:
            colmap.enter_images(partial, {f.frame: (f.width, f.height) for f in frames if f.image is not None})
        else:
            # through SQLite: what is still in the journal comes along, and nothing of it is left beside the copy
            with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(partial)) as target:
                source.backup(target)
        with closing(sqlite3.connect(partial)) as whole:
            whole.execute("PRAGMA journal_mode=DELETE")
    files.write_bytes(sequence.folder / PROJECT, f"database_path={DATABASE}\nimage_path=images\n".encode())
    return path.stat().st_size / 2**20


def keep_project(sequence: Sequence, frames: list[Frame], database: Path | None, *, wanted: bool) -> dict[str, float]:
    """`write_project` where it is wanted, else remove what is there. Returns what is to be said of it."""
    if wanted:
        return {"database_mib": round(write_project(sequence, frames, database), 2)}
    for name in (PROJECT, DATABASE):
        (sequence.folder / name).unlink(missing_ok=True)
    return {}
