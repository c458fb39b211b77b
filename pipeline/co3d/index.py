"""A category's annotations, read once: an SQLite file in WORK/.co3d that gives the frames of a sequence at once.

Frames of a sequence need not lie together in frame_annotations.jgz, and a category can have a million of them: they go
from the stream into the file, and memory stays small. The file is named after the content of the annotations (of a
gzip file a sample, which covers the checksum at its end; of any other file every byte), so it is never out of date; all
parts of an array job share it, and it may be deleted at any time.
"""

from __future__ import annotations

import fcntl
import hashlib
import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from dope.common import files
from dope.common.errors import BadInput, DiskFull
from pipeline.co3d.annotations import (
    FrameAnnotation,
    SequenceAnnotation,
    Viewpoint,
    parse_frame,
    parse_sequence,
    read_rows,
)
from pipeline.inputs.photos import natural_order
from pipeline.json_stream import GZIP_MAGIC
from pipeline.sequence import sequence_id

FORMAT = 2
"""Changes when what the file holds changes."""
VIEWPOINT = struct.Struct("<16d")
"""R, T, focal_length, principal_point."""
FRAMES_FILE, SEQUENCES_FILE = "frame_annotations.jgz", "sequence_annotations.jgz"

TABLES = """
CREATE TABLE sequences (id INTEGER PRIMARY KEY, name TEXT, viewpoint_quality REAL, point_cloud_quality REAL,
    point_cloud TEXT, n_frames INTEGER, first_number INTEGER);
CREATE TABLE frames (sequence INTEGER, number INTEGER, timestamp REAL, image TEXT, height INTEGER, width INTEGER,
    mask TEXT, depth TEXT, depth_scale REAL, depth_mask TEXT, viewpoint BLOB, intrinsics_format TEXT, problem TEXT);
CREATE TABLE faults (file TEXT, row INTEGER, what TEXT);
"""


@dataclass(frozen=True)
class IndexedSequence:
    """A sequence of the index: its key there, its annotation, and how many frames it has from which number on."""

    key: int
    annotation: SequenceAnnotation
    n_frames: int
    first_number: int


Row = tuple[Any, ...]
"""A frame as the index holds it: `COLUMNS`."""

COLUMNS = ("number", "timestamp", "image", "height", "width", "mask", "depth", "depth_scale", "depth_mask", "viewpoint",
           "intrinsics_format", "problem")  # fmt: skip
FILE_COLUMNS = tuple(COLUMNS.index(name) for name in ("image", "mask", "depth", "depth_mask"))


class CategoryIndex:
    """The index of one category; reads only. It can be sent to another process."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._connection: sqlite3.Connection | None = None

    def __reduce__(self) -> tuple[type[CategoryIndex], tuple[Path]]:
        return CategoryIndex, (self.path,)

    def sequences(self) -> list[IndexedSequence]:
        """All sequences that either annotation file names, in natural order of their names."""
        rows = self._query(
            "SELECT id, name, viewpoint_quality, point_cloud_quality, point_cloud, n_frames, first_number "
            "FROM sequences"
        )
        found = [IndexedSequence(row[0], SequenceAnnotation(*row[1:5]), row[5], row[6]) for row in rows]
        return sorted(found, key=lambda s: (natural_order(Path(s.annotation.name)), s.annotation.name))

    def rows(self, sequence: IndexedSequence, every: int = 1) -> list[Row]:
        """The frames of a sequence by number, every k-th from the first; those of one number in the file's order."""
        return self._query(
            f"SELECT {', '.join(COLUMNS)} FROM frames WHERE sequence = ? AND (number - ?) % ? = 0 "
            "ORDER BY number, rowid",
            (sequence.key, sequence.first_number, every),
        )

    def faults(self) -> list[tuple[str, int, str]]:
        """(file, row from 1, what) of the rows that belong to no frame or sequence; the first of each file and kind
        stands for all."""
        return self._query("SELECT file, row, what FROM faults ORDER BY file, row")

    def _query(self, query: str, values: tuple[Any, ...] = ()) -> list[Any]:
        try:
            if self._connection is None:
                # immutable: no lock files, which network file systems do not like
                uri = f"file:{quote(str(self.path.absolute()))}?mode=ro&immutable=1"
                self._connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
            return self._connection.execute(query, values).fetchall()
        except sqlite3.Error as error:
            remedy = "Delete it and run again"
            raise BadInput(f"the index cannot be read ({error})", where=self.path, remedy=remedy) from error


def frame_of(row: Row) -> FrameAnnotation:
    """The annotation that a row of the index holds."""
    return FrameAnnotation(*(*row[:9], _unpack(row[9], row[10]), row[11]))


def open_index(category: Path, work: Path, tell: Callable[[str], None] = lambda text: None) -> CategoryIndex:
    """The index of a category's folder, made where WORK does not have it yet.

    Args:
        tell: called with a line where the annotations have to be read.

    Raises:
        BadInput: an annotation file is absent, cut off or malformed. Nothing is kept of it then: a category with half
            of its frames looks whole.
        DiskFull: no room for the index.
    """
    frames, sequences = category / FRAMES_FILE, category / SEQUENCES_FILE
    try:
        marks = [_content_mark(path) if path.exists() else "absent" for path in (frames, sequences)]
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=error.filename or category) from error
    mark = hashlib.sha256(f"{FORMAT}\0{marks[0]}\0{marks[1]}".encode()).hexdigest()[:16]
    index = CategoryIndex(work / ".co3d" / f"{sequence_id(category.name)[:80]}-{mark}.sqlite")
    if index.path.exists():
        return index
    with _alone_in(index.path.parent):  # the other parts of an array job wait for the first
        if index.path.exists():
            return index
        tell(f"{category.name}: reading {frames.name}")
        with files.atomic_path(index.path) as partial:
            _build(partial, frames, sequences if sequences.exists() else None)
    return index


def _content_mark(path: Path) -> str:
    """Identifies the content of an annotation file, whichever byte of it changes."""
    with path.open("rb") as file:
        gzipped = file.read(len(GZIP_MAGIC)) == GZIP_MAGIC
    return files.quick_fingerprint(path) if gzipped else files.sha256_of(path)


def _build(path: Path, frames: Path, sequences: Path | None) -> None:
    try:
        with closing(sqlite3.connect(path, isolation_level=None)) as connection:
            # a half-written file has a temporary name and is deleted: no journal is needed
            connection.executescript("PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF; PRAGMA cache_size = -65536;")
            connection.executescript(TABLES)
            connection.execute("BEGIN")
            _fill(connection, frames, sequences)
            connection.execute("COMMIT")
    except sqlite3.Error as error:
        if "full" in str(error):
            remedy = "Free some space or choose another --out, then run the same command again"
            raise DiskFull("no space left on the disk for the index", where=path.parent, remedy=remedy) from error
        raise BadInput(f"the index cannot be written ({error})", where=path.parent) from error


Faults = dict[tuple[str, str], int]
"""The first row of each (file, what is wrong with it)."""


def _fill(connection: sqlite3.Connection, frames: Path, sequences: Path | None) -> None:
    ids: dict[str, int] = {}
    faults: Faults = {}
    places = ", ".join("?" * (1 + len(COLUMNS)))
    connection.executemany(f"INSERT INTO frames VALUES ({places})", _frame_rows(frames, ids, faults))
    connection.execute("CREATE INDEX by_sequence ON frames (sequence, number)")
    annotated = _read_sequences(sequences, faults) if sequences is not None else {}
    for name in annotated:
        ids.setdefault(name, len(ids))
    counted = connection.execute("SELECT sequence, COUNT(*), MIN(number) FROM frames GROUP BY sequence").fetchall()
    counts = {sequence: (n, first) for sequence, n, first in counted}
    for name, number in ids.items():
        a = annotated.get(name, SequenceAnnotation(name))
        values = (number, name, a.viewpoint_quality, a.point_cloud_quality, a.point_cloud, *counts.get(number, (0, 0)))
        connection.execute("INSERT INTO sequences VALUES (?, ?, ?, ?, ?, ?, ?)", values)
    connection.executemany("INSERT INTO faults VALUES (?, ?, ?)", [(f, row, what) for (f, what), row in faults.items()])


def _frame_rows(path: Path, ids: dict[str, int], faults: Faults) -> Iterator[tuple[Any, ...]]:
    """The rows of the table of frames; sequences get their keys in `ids` as they come."""
    for row in read_rows(path):
        try:
            name, frame = parse_frame(row.value)
        except ValueError as error:
            faults.setdefault((path.name, str(error)), row.number + 1)
            continue
        yield (ids.setdefault(name, len(ids)), frame.number, frame.timestamp, frame.image, frame.height,
               frame.width, frame.mask, frame.depth, frame.depth_scale, frame.depth_mask, _pack(frame.viewpoint),
               frame.viewpoint and frame.viewpoint.intrinsics_format, frame.problem)  # fmt: skip


def _read_sequences(path: Path, faults: Faults) -> dict[str, SequenceAnnotation]:
    """The sequences' annotations by name; of several of one name the first."""
    annotated: dict[str, SequenceAnnotation] = {}
    for row in read_rows(path):
        try:
            annotation = parse_sequence(row.value)
        except ValueError as error:
            faults.setdefault((path.name, str(error)), row.number + 1)
            continue
        annotated.setdefault(annotation.name, annotation)
    return annotated


def _pack(viewpoint: Viewpoint | None) -> bytes | None:
    if viewpoint is None:
        return None
    numbers = (*viewpoint.R, *viewpoint.T, *viewpoint.focal_length, *viewpoint.principal_point)
    return VIEWPOINT.pack(*numbers)


def _unpack(packed: bytes | None, intrinsics_format: str | None) -> Viewpoint | None:
    if packed is None or intrinsics_format is None:
        return None
    values = VIEWPOINT.unpack(packed)
    return Viewpoint(values[:9], values[9:12], values[12:14], values[14:16], intrinsics_format)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Wait until no other process, here or on another machine, builds in `folder`. Raises BadInput."""
    try:
        with files.explaining_full_disk(folder):
            folder.mkdir(parents=True, exist_ok=True)
            lock = (folder / ".lock").open("a+")  # network file systems lock only what is open for writing
            fcntl.flock(lock, fcntl.LOCK_EX)
    except OSError as error:
        remedy = "Check its permissions, or choose another --out"
        raise BadInput(f"cannot be written to or locked ({error.strerror})", where=folder, remedy=remedy) from error
    with lock:
        files.clear_leftovers(folder)
        yield
