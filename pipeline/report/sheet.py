"""The contact sheet of one sequence as a JSON value: pictures, orbit, pairs and attempts, within a number of bytes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from dope.common import files
from dope.common.errors import BadInput, DopeError
from pipeline.report import pictures
from pipeline.report.orbit import orbit_of
from pipeline.report.status_row import as_float, as_int, as_text
from pipeline.sequence import Frame, Sequence


@dataclass(frozen=True)
class Detail:
    """How much of a sequence is shown."""

    frames: int
    """Frames, each with mask and depth."""
    side: int
    """Longer side of a frame, pixels."""
    pairs: int
    """Pairs of views."""
    view_side: int
    """Side of a view, pixels."""
    quality: int
    """Of the JPEGs."""
    points: int
    """Sparse points."""
    cameras: int
    """Cameras of the orbit."""
    usual_bytes: int
    """What a sheet takes as a rule: tells where to start."""


DETAILS = (
    Detail(frames=7, side=320, pairs=3, view_side=224, quality=80, points=900, cameras=200, usual_bytes=300_000),
    Detail(frames=6, side=240, pairs=3, view_side=192, quality=72, points=600, cameras=120, usual_bytes=160_000),
    Detail(frames=5, side=192, pairs=2, view_side=160, quality=66, points=400, cameras=80, usual_bytes=75_000),
    Detail(frames=4, side=144, pairs=2, view_side=128, quality=60, points=260, cameras=60, usual_bytes=40_000),
    Detail(frames=3, side=112, pairs=1, view_side=112, quality=55, points=160, cameras=40, usual_bytes=19_000),
    Detail(frames=2, side=72, pairs=0, view_side=0, quality=50, points=60, cameras=20, usual_bytes=9_000),
)
"""From much to little; below the last there are no pictures."""

ATTEMPT_KEYS = {
    "rung": as_text, "mapper": as_text, "matching": as_text, "max_image_size": as_int, "n_pairs": as_int,
    "n_frames": as_int, "n_registered": as_int, "n_points": as_int, "mean_error_px": as_float, "seconds": as_float,
    "verdict": as_text,
}  # fmt: skip
MAX_ATTEMPTS = 12
POINTS_A_PAIR = 18
LOWEST_QUALITY = 35
"""JPEGs get no worse than this: fewer and smaller pictures come before that."""
TOLERANCE = 1.5
"""A level of detail is tried where its usual size is at most this many times the limit."""


def build_sheet(row: dict[str, Any], limit: int) -> tuple[str, int]:
    """The sheet of a status row as JSON of at most `limit` bytes, and its level of detail (len(DETAILS): no pictures).

    What cannot be read is left out, and a note in the sheet says what and why.
    """
    sequence, notes = Sequence(Path(row["work"]) / row["id"]), list[str]()
    words: dict[str, Any] = {"attempts": _noting(notes, lambda: _attempts(sequence)) or []}
    frames = _noting(notes, lambda: _frames(sequence)) or []
    for level, detail in enumerate(DETAILS):
        if detail.usual_bytes > TOLERANCE * limit:
            continue
        said = list(notes)
        sheet, quality = {**words, **_pictures(sequence, frames, detail, said), "notes": said}, detail.quality
        while quality >= LOWEST_QUALITY:
            text = as_json(_encoded(sheet, quality))
            if len(text) <= limit:
                return text, level
            quality = min(quality - 1, int(quality * limit / len(text)))
    text = as_json({**words, "notes": notes})
    return text if len(text) <= limit else "{}", len(DETAILS)


def _encoded(value: Any, quality: int) -> Any:
    """A value with its images as base64 JPEG."""
    if isinstance(value, np.ndarray):
        return pictures.encoded(value, quality)
    if isinstance(value, dict):
        return {key: _encoded(item, quality) for key, item in value.items()}
    if isinstance(value, list) and value and isinstance(value[0], (dict, list, np.ndarray)):
        return [_encoded(item, quality) for item in value]
    return value


def as_json(value: Any) -> str:
    """JSON in ASCII that is inert inside <script>: no character in it can end the element or start a comment."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _noting(notes: list[str], read: Callable[[], Any]) -> Any:
    try:
        return read()
    except DopeError as error:
        notes.append(as_text(str(error)) or "")
    except Exception as error:  # a damaged file may fail in any library; the page is there to show what is damaged
        notes.append(as_text(f"{type(error).__name__}: {error}") or "")
    return None


def _frames(sequence: Sequence) -> list[Frame]:
    if not (sequence.folder / "frames.parquet").exists():
        return []
    return [frame for frame in sequence.read_frames() if frame.image is not None and frame.dropped is None]


def _attempts(sequence: Sequence) -> list[dict[str, Any]]:
    if not (sequence.folder / "sequence.json").exists():
        return []
    values = files.read_json(sequence.folder / "sequence.json")
    attempts = values.get("attempts") if isinstance(values, dict) else None
    rows = [attempt for attempt in attempts if isinstance(attempt, dict)] if isinstance(attempts, list) else []
    return [{key: read(row.get(key)) for key, read in ATTEMPT_KEYS.items()} for row in rows[:MAX_ATTEMPTS]]


def _pictures(sequence: Sequence, frames: list[Frame], detail: Detail, notes: list[str]) -> dict[str, Any]:
    chosen = _spaced(frames, detail.frames)
    depths = {
        f.frame: _noting(notes, partial(pictures.small_depth, sequence, f, detail.side)) for f in chosen if f.depth
    }
    known = {number: depth for number, depth in depths.items() if depth is not None}
    near, far = pictures.depth_range(list(known.values()))
    shown = []
    for frame in chosen:
        picture = _noting(notes, partial(_frame_picture, sequence, frame, detail))
        if picture is None:
            continue
        if frame.mask:
            picture["mask"] = _noting(notes, partial(pictures.mask_outline, sequence, frame))
        if frame.frame in known:
            depth = known[frame.frame]
            picture["depth"] = pictures.depth_picture(depth, near, far)
            picture["known"] = round(float((depth > 0).mean()), 3)
        shown.append(picture)
    return {
        "frames": shown,
        "range": [round(near, 3), round(far, 3)] if known else None,
        "orbit": _noting(notes, lambda: orbit_of(frames, sequence.sparse, detail.points, detail.cameras)),
        "pairs": _noting(notes, lambda: _pairs(sequence, detail)) or [],
    }


def _frame_picture(sequence: Sequence, frame: Frame, detail: Detail) -> dict[str, Any]:
    path = pictures.inside(sequence, frame.image)
    image = pictures.thumbnail(path, detail.side, max(frame.width, frame.height))
    return {
        "frame": frame.frame,
        "name": as_text(frame.source_name),
        "registered": frame.registered,
        "flag": as_text(frame.mask_flag),
        "size": [image.shape[1], image.shape[0]],
        "image": image,
    }


def _pairs(sequence: Sequence, detail: Detail) -> list[dict[str, Any]]:
    """Pairs from the smallest angle to the largest, evenly spaced, each with a few points spread over the object."""
    path = sequence.correspondences
    if not detail.pairs or not path.exists():
        return []
    table = pq.read_table(path, columns=["frame1", "frame2", "angle_deg", "overlap", "n_correspondences", "points"])
    order = np.argsort(table["angle_deg"].to_numpy(zero_copy_only=False), kind="stable")
    middles = [(i + 0.5) / detail.pairs for i in range(detail.pairs)]
    rows = sorted({int(order[int(middle * len(order))]) for middle in middles} if len(order) else [])
    shown = []
    for row in table.take(rows).sort_by("angle_deg").to_pylist():
        points = np.array(row["points"], dtype=np.float64).reshape(-1, 4)[:POINTS_A_PAIR]
        views, sides = [], []
        for number in (row["frame1"], row["frame2"]):
            image = pictures.read_image(pictures.inside(sequence, f"views/{int(number):06d}.jpg"))
            sides.append(image.shape[1])
            views.append(pictures.shrunk(image, detail.view_side))
        if not np.isfinite(points).all() or min(sides) < 1:
            raise BadInput("holds points that are not numbers", where=path)
        shares = points * 1000 / np.array([sides[0], sides[0], sides[1], sides[1]])
        shown.append(
            {
                "frames": [row["frame1"], row["frame2"]],
                "views": views,
                "angle": as_float(row["angle_deg"]),
                "overlap": as_float(row["overlap"]),
                "n": row["n_correspondences"],
                "points": np.rint(shares).astype(int).ravel().tolist(),
            }
        )
    return shown


def _spaced(frames: list[Frame], count: int) -> list[Frame]:
    places = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int))
    return [frames[i] for i in places]
