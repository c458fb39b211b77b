"""One sequence of WORK as one flat row: what its small JSON files say of it, whatever state they are in.

Only sequence.json and stages/*.json are read, no image and no table, so that 100,000 sequences are a matter of seconds.
A file that is cut off, damaged or of another shape never raises: it becomes the reason of a failed row.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

STAGES = ("frames", "sfm", "depth", "masks", "correspond")
STATUSES = ("ok", "waiting", "running", "empty", "failed")
MAX_BYTES = 32 << 20
"""A JSON file larger than this is not one of ours."""

INT, FLOAT, TEXT, BOOL = pa.int64(), pa.float64(), pa.string(), pa.bool_()


@dataclass(frozen=True)
class Column:
    """A column of the status table, and where its value is found."""

    name: str
    type: pa.DataType
    doc: str
    stage: str | None = None
    """The stage whose marker has it; None: it is worked out in `sequence_row`."""
    detail: str | None = None
    """Its name among the marker's details."""


COLUMNS = (
    Column("id", TEXT, "the sequence's name: its folder in WORK"),
    Column("status", TEXT, "ok (all stages done), waiting, running (a process holds it), empty or failed"),
    Column("stage", TEXT, "the stage that failed, or the last one that ended"),
    Column("next", TEXT, "the stage that a waiting sequence waits for"),
    Column("reason", TEXT, "why it failed or came out empty"),
    Column("kind", TEXT, "video, photos, co3d or render"),
    Column("category", TEXT, "its category, where one is known"),
    Column("instance", TEXT, "the object"),
    Column("source", TEXT, "the input"),
    *(Column(f"stage_{name}", TEXT, f"ok, empty, failed or damaged; null: {name} has not been run") for name in STAGES),
    Column("frames", INT, "frames read", "frames", "frames"),
    Column("kept", INT, "frames kept", "frames", "kept"),
    Column("registered", INT, "frames with a camera", "sfm", "n_registered"),
    Column("registered_share", FLOAT, "of the frames that were to be registered", "sfm", "registered_share"),
    Column("error_px", FLOAT, "mean reprojection error, pixels", "sfm", "mean_error_px"),
    Column("points", INT, "triangulated points", "sfm", "n_points"),
    Column("ray_angle_deg", FLOAT, "median over the points: largest angle between two rays", "sfm", "median_angle_deg"),
    Column("rung", TEXT, "the attempt that was believed", "sfm", "rung"),
    Column("attempts", INT, "attempts at reconstruction", "sfm", "n_attempts"),
    Column("depth_frames", INT, "frames with depth", "depth", "frames_with_depth"),
    Column("depth_coverage", FLOAT, "share of the pixels with depth", "depth", "coverage"),
    Column("depth_mask_coverage", FLOAT, "share of the masks' pixels with depth", "depth", "mask_coverage"),
    Column("depth_error", FLOAT, "median relative error against the sparse points", "depth", "sparse_median_error"),
    Column("depth_within_2", FLOAT, "share of the points met within 2%", "depth", "sparse_within_2_percent"),
    Column("masks", INT, "frames with a mask", "masks", "masks"),
    Column("masks_missing", INT, "frames without a mask", "masks", "missing"),
    Column("masks_empty", INT, "masks without an object", "masks", "empty"),
    Column("masks_flagged", INT, "masks that disagree with the others", "masks", "flagged"),
    Column("mask_share", FLOAT, "mean share of the pixels that are the object's", "masks", "mean_share"),
    Column("masks_from", TEXT, "input, import or grabcut"),
    Column("views", INT, "224 px views", "correspond", "views"),
    Column("pairs", INT, "pairs of views", "correspond", "pairs"),
    Column("correspondences", FLOAT, "median over the pairs", "correspond", "median_correspondences"),
    Column("pair_angle_deg", FLOAT, "median over the pairs", "correspond", "median_angle_deg"),
    Column("pair_overlap", FLOAT, "median over the pairs", "correspond", "median_overlap"),
    Column("seconds", FLOAT, "wall-clock seconds of all stages"),
    Column("cpu_seconds", FLOAT, "CPU seconds of all stages"),
    Column("peak_memory_mib", FLOAT, "largest peak memory of a stage"),
    Column("warnings", INT, "number of warnings"),
    Column("warning_texts", TEXT, "the warnings, separated by ' | '"),
    Column("work", TEXT, "the WORK folder"),
    Column("duplicate", BOOL, "the same id is in another row, too"),
)
SCHEMA = pa.schema([(column.name, column.type) for column in COLUMNS])
NAMES = tuple(SCHEMA.names)


def as_text(value: object) -> str | None:
    """A string that can be written as UTF-8, or None for what is not a string."""
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else None


def as_float(value: object) -> float | None:
    """A finite float, or None."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def as_int(value: object) -> int | None:
    """A count, or None; a list counts as its length (a stage may name its frames instead of counting them)."""
    if isinstance(value, (list, dict)):
        return len(value)
    number = as_float(value)
    return int(number) if number is not None and abs(number) < 2**53 else None


CONVERTERS: dict[pa.DataType, Callable[[object], Any]] = {TEXT: as_text, FLOAT: as_float, INT: as_int}
FROM_STAGE = {
    stage: [(c.name, c.detail, CONVERTERS[c.type]) for c in COLUMNS if c.stage == stage and c.detail is not None]
    for stage in STAGES
}


class Damaged(Exception):
    """A file that is there and cannot be read as a JSON object; the message says why."""


def read_object(path: str) -> dict[str, Any] | None:
    """A JSON object, or None where there is no such file. Raises `Damaged` for all else."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe in its place must not hang us
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise Damaged(f"cannot be read ({error.strerror})") from None
    try:
        data = part = os.read(handle, 1 << 16)
        while len(part) == 1 << 16 and len(data) <= MAX_BYTES:
            part = os.read(handle, 1 << 16)
            data += part
    except OSError as error:
        raise Damaged(f"cannot be read ({error.strerror})") from None
    finally:
        os.close(handle)
    if not data or len(data) > MAX_BYTES:
        raise Damaged("is empty" if not data else "is too large")
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise Damaged(f"is not valid JSON ({type(error).__name__})") from None
    if not isinstance(value, dict):
        raise Damaged("is not a JSON object")
    return value


def sequence_row(work: str, name: str, *, running: bool = False) -> dict[str, Any] | None:
    """The row of WORK/name, or None where that folder is no sequence.

    Args:
        running: a process holds the folder at this moment.
    """
    folder = f"{work}/{name}"
    row: dict[str, Any] = dict.fromkeys(NAMES)
    row |= {"id": as_text(name), "work": as_text(work), "duplicate": False}
    problems: list[tuple[str, str]] = []
    try:
        info = read_object(f"{folder}/sequence.json")
    except Damaged as damage:
        info, problems = {}, [("frames", f"sequence.json {damage}")]
    if info is None and not running and not os.path.isdir(f"{folder}/stages"):  # noqa: PTH112 - 100,000 Paths are slow
        return None
    _add_info(row, info or {})
    warnings: list[str] = []
    empty: list[tuple[str, str]] = []
    for stage in STAGES:
        try:
            marker = read_object(f"{folder}/stages/{stage}.json")
        except Damaged as damage:
            row[f"stage_{stage}"] = "damaged"
            problems.append((stage, f"stages/{stage}.json {damage}; the stage will be run again"))
            continue
        if marker is None:
            continue
        row["stage"], status = stage, marker.get("status")
        _add_marker(row, stage, marker, warnings)
        if status == "ok":
            row[f"stage_{stage}"] = status
        elif status in ("empty", "failed"):
            row[f"stage_{stage}"] = status
            (empty if status == "empty" else problems).append(
                (stage, as_text(marker.get("reason")) or "no reason given")
            )
        else:
            row[f"stage_{stage}"] = "damaged"
            problems.append((stage, f"stages/{stage}.json has no status; the stage will be run again"))
    if info is None and row["stage_frames"] == "ok":
        problems.append(("frames", "sequence.json is missing"))
    row["warnings"], row["warning_texts"] = len(warnings), " | ".join(warnings) or None
    _judge(row, problems, empty, running)
    return row


def refused_row(work: str, name: str) -> dict[str, Any]:
    """The row of WORK/.refused/name.json: an input that could not be begun (see `pipeline.refused`)."""
    row: dict[str, Any] = dict.fromkeys(NAMES)
    row |= {"id": as_text(name), "work": as_text(work), "duplicate": False, "status": "failed", "stage": "frames"}
    try:
        note = read_object(f"{work}/.refused/{name}.json") or {}
        row["reason"] = as_text(note.get("reason")) or "no reason given"
    except Damaged as damage:
        row["reason"] = f".refused/{name}.json {damage}"
    return row


def _add_info(row: dict[str, Any], info: dict[str, Any]) -> None:
    for key in ("kind", "category", "instance", "source", "masks_from"):
        row[key] = as_text(info.get(key))
    if info.get("attempts"):  # a reconstruction was tried, perhaps in vain
        row["attempts"] = as_int(info["attempts"])
        row["registered"] = as_int(info.get("n_registered"))
        row["registered_share"] = as_float(info.get("registered_share"))


def _add_marker(row: dict[str, Any], stage: str, marker: dict[str, Any], warnings: list[str]) -> None:
    for key in ("seconds", "cpu_seconds"):
        row[key] = round((row[key] or 0.0) + (as_float(marker.get(key)) or 0.0), 3)
    row["peak_memory_mib"] = max(row["peak_memory_mib"] or 0.0, as_float(marker.get("peak_memory_mib")) or 0.0)
    details = marker.get("details")
    if not isinstance(details, dict):
        return
    for column, key, convert in FROM_STAGE[stage]:
        value = convert(details.get(key))
        if value is not None:
            row[column] = value
    given = details.get("warnings")
    if isinstance(given, list):
        warnings += [text for text in map(as_text, given) if text]


def _judge(
    row: dict[str, Any], problems: list[tuple[str, str]], empty: Iterable[tuple[str, str]], running: bool
) -> None:
    """The overall status: what is wrong comes first, in the order of the stages."""
    worst = [*sorted(problems, key=lambda problem: STAGES.index(problem[0])), *empty]
    if worst:
        row["stage"], row["reason"] = worst[0]
    done = row["stage_correspond"] == "ok"
    row["status"] = "failed" if problems else "empty" if worst else "ok" if done else "waiting"
    if running:
        row["status"] = "running"
    if row["status"] == "waiting":
        needed = [
            s for s in STAGES if row[f"stage_{s}"] is None and not (s == "masks" and row["masks_from"] == "input")
        ]
        row["next"] = needed[0]
