"""Samples to tar files that stock `webdataset` reads: encoding, byte offsets, hashes. No knowledge of splits."""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.correspond.views import views_table
from pipeline.sequence import Sequence

Kind = Literal["pairs", "views"]
"""What the samples of a tar are."""

REDO = "Run `dope prep correspond --overwrite` for this sequence"
PAIR_COLUMNS = ["frame1", "frame2", "angle_deg", "overlap", "n_correspondences"]

_PLACE = [("key", pa.string()), ("shard", pa.string()), ("offset", pa.int64()), ("size", pa.int64())]
_NAMES = [("sequence", pa.string()), ("instance", pa.string()), ("category", pa.string()), ("split", pa.string())]
PAIR_ROWS = pa.schema(
    [
        *_PLACE,
        *_NAMES,
        ("frame1", pa.int32()),
        ("frame2", pa.int32()),
        ("n_correspondences", pa.int32()),
        ("angle_deg", pa.float64()),
        ("overlap", pa.float64()),
    ]
)
VIEW_ROWS = pa.schema([*_PLACE, *_NAMES, ("frame", pa.int32()), ("mask_share", pa.float64())])
SCHEMAS = {"pairs": PAIR_ROWS, "views": VIEW_ROWS}
"""Columns of index.parquet and of views.parquet."""


@dataclass(frozen=True)
class SequenceContents:
    """What the correspond stage left of one sequence; everything but small tables stays on the disk.

    Attributes:
        views, pairs: rows of views.parquet and of correspondences.parquet (without the points).
    """

    sequence: Sequence
    instance: str
    category: str | None
    views: pa.Table
    pairs: pa.Table

    @staticmethod
    def read(sequence: Sequence) -> SequenceContents:
        """Raises `BadInput` where a table or a view is absent or damaged."""
        info = sequence.read_info()
        views = _read_table(views_table(sequence))
        pairs = _read_table(sequence.correspondences, PAIR_COLUMNS)
        for column in ("image", "mask"):
            for name in views[column].to_pylist():
                if not (sequence.folder / name).is_file():
                    raise BadInput("this view is missing", where=sequence.folder / name, remedy=REDO)
        contents = SequenceContents(sequence, info.instance or sequence.id, info.category, views, pairs)
        unknown = {*contents.pair_frames.ravel().tolist()} - {*contents.frames.tolist()}
        if unknown:
            raise BadInput(f"frame {min(unknown)} has no view", where=sequence.correspondences, remedy=REDO)
        return contents

    @property
    def id(self) -> str:
        return self.sequence.id

    @cached_property
    def frames(self) -> NDArray[np.int32]:
        """(V,) frame numbers of the views, ascending."""
        return self.views["frame"].to_numpy()

    @cached_property
    def pair_frames(self) -> NDArray[np.int32]:
        """(P, 2) frame numbers of the pairs."""
        return np.stack([self.pairs["frame1"].to_numpy(), self.pairs["frame2"].to_numpy()], axis=1)

    def view(self, frame: int) -> dict[str, Any]:
        """The row of views.parquet of a frame."""
        return self.views.slice(int(np.searchsorted(self.frames, frame)), 1).to_pylist()[0]

    def pair(self, row: int) -> dict[str, Any]:
        """A row of correspondences.parquet, without the points."""
        return self.pairs.slice(row, 1).to_pylist()[0]

    def points(self, row: int) -> NDArray[np.float32]:
        """The correspondences (N, 4) of a pair: only its row group is read, since rounds visit sequences in turn."""
        path = self.sequence.correspondences
        try:
            with pq.ParquetFile(path) as file:
                group = 0
                while row >= (rows := file.metadata.row_group(group).num_rows):
                    row, group = row - rows, group + 1
                values = file.read_row_group(group, columns=["points"], use_threads=False)["points"][row].values
        except (OSError, pa.ArrowException) as error:
            raise BadInput(f"cannot be read ({error})", where=path, remedy=REDO) from error
        return values.to_numpy().astype(np.float32).reshape(-1, 4)


@dataclass(frozen=True)
class PairSample:
    """One pair of views, to be written."""

    contents: SequenceContents
    row: int
    split: str

    def encode(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The sample as WebDataset wants it, and its row in index.parquet (without shard, offset and size)."""
        contents, pair = self.contents, self.contents.pair(self.row)
        one, two = contents.view(pair["frame1"]), contents.view(pair["frame2"])
        named = {"sequence": contents.id, "instance": contents.instance, "category": contents.category}
        buffer = io.BytesIO()
        np.save(buffer, self.contents.points(self.row))
        sample: dict[str, Any] = {
            "__key__": f"{contents.id}-{pair['frame1']:06d}-{pair['frame2']:06d}",
            "corr.npy": buffer.getvalue(),
        }
        facts = {**named, "frame1": pair["frame1"], "frame2": pair["frame2"], "angle_deg": pair["angle_deg"]}
        for number, view in ((1, one), (2, two)):
            sample[f"{number}.jpg"] = (contents.sequence.folder / view["image"]).read_bytes()
            sample[f"{number}.png"] = (contents.sequence.folder / view["mask"]).read_bytes()
            facts |= {f"{name}{number}": value for name, value in camera_facts(view).items()}
        sample["json"] = to_json(facts)
        return sample, {"key": sample["__key__"], **named, "split": self.split, **pair}


@dataclass(frozen=True)
class ViewSample:
    """One view, to be written."""

    contents: SequenceContents
    frame: int
    split: str

    def encode(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The sample as WebDataset wants it, and its row in views.parquet (without shard, offset and size)."""
        contents, view = self.contents, self.contents.view(self.frame)
        named = {"sequence": contents.id, "instance": contents.instance, "category": contents.category}
        sample = {
            "__key__": f"{contents.id}-{self.frame:06d}",
            "jpg": (contents.sequence.folder / view["image"]).read_bytes(),
            "png": (contents.sequence.folder / view["mask"]).read_bytes(),
            "json": to_json({**named, "frame": self.frame, **camera_facts(view), "mask_share": view["mask_share"]}),
        }
        row = {"key": sample["__key__"], **named, "split": self.split, "frame": self.frame}
        return sample, {**row, "mask_share": view["mask_share"]}


class Sample(Protocol):
    """What can be written."""

    def encode(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The sample as WebDataset wants it, and its row in the table (without shard, offset and size)."""


def camera_facts(view: dict[str, Any]) -> dict[str, Any]:
    """K (3, 3), R (3, 3) and t (3,) of a row of views.parquet as nested lists; every float as it is."""
    return {
        "K": [[view["fx"], 0.0, view["cx"]], [0.0, view["fy"], view["cy"]], [0.0, 0.0, 1.0]],
        "R": [view["R"][0:3], view["R"][3:6], view["R"][6:9]],
        "t": view["t"],
    }


def to_json(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False).encode()


@dataclass(frozen=True)
class WrittenShard:
    """One tar on the disk: what it holds, its entry in dataset.json and the rows of its samples (`SCHEMAS`)."""

    name: str
    kind: Kind
    entry: dict[str, Any]
    rows: pa.Table

    def to_note(self) -> dict[str, Any]:
        """JSON values, for the container that puts the dataset together."""
        return {"name": self.name, "kind": self.kind, "entry": self.entry, "rows": self.rows.to_pylist()}

    @staticmethod
    def from_note(note: dict[str, Any]) -> WrittenShard:
        rows = pa.Table.from_pylist(note["rows"], SCHEMAS[note["kind"]])
        return WrittenShard(note["name"], note["kind"], note["entry"], rows)


class HashingFile:
    """A file opened for writing that knows the SHA-256 of what went in, so that no tar is read a second time."""

    def __init__(self, path: Path) -> None:
        self.file = path.open("wb")
        self.digest = hashlib.sha256()

    def write(self, data: bytes) -> int:
        if self.file.closed:  # an archive that was given up after an error flushes its rest when it is collected
            return len(data)
        self.digest.update(data)
        return self.file.write(data)

    def close(self) -> None:
        self.file.close()


def write_tar(path: Path, kind: Kind, samples: Iterable[Sample], name: str) -> WrittenShard:
    """Write one shard and sync it; equal samples give equal bytes.

    Args:
        path: where it is written, maybe a temporary name.
        kind: what the samples are.
        name: of the shard.

    Raises:
        BadInput: a file of a sequence cannot be read.
        OSError: the disk is full, or another failure to write.
    """
    from webdataset.writer import TarWriter  # imports torch, which nothing else here needs

    rows = []
    file = HashingFile(path)
    try:
        tar = TarWriter(file, mtime=0, encoder=False)
        for sample in samples:
            members, row = _encode(sample)
            offset = tar.tarstream.offset
            tar.write(members)
            rows.append({**row, "shard": name, "offset": offset, "size": tar.tarstream.offset - offset})
        tar.close()
        file.file.flush()
        os.fsync(file.file.fileno())
    finally:
        file.close()
    entry = {"samples": len(rows), "bytes": path.stat().st_size, "sha256": file.digest.hexdigest()}
    return WrittenShard(name, kind, entry, pa.Table.from_pylist(rows, SCHEMAS[kind]))


def _encode(sample: Sample) -> tuple[dict[str, Any], dict[str, Any]]:
    try:
        return sample.encode()
    except FileNotFoundError as error:
        raise BadInput("was there when writing began and is gone", where=error.filename, remedy=REDO) from error


def _read_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    try:
        return pq.read_table(path, columns=columns, use_threads=False)
    except FileNotFoundError:
        raise BadInput("no such file", where=path, remedy=REDO) from None
    except (OSError, pa.ArrowException) as error:
        raise BadInput(f"cannot be read ({error})", where=path, remedy=REDO) from error
