"""Writes a small folder of labelled views: drawn shapes in any colour before any background. The class is the shape.

Colours and backgrounds say nothing of the class, so random weights do little better than chance.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from tiny_shards import encode, texture
from webdataset import TarWriter

Mask = NDArray[np.uint8]
R = 100  # half the side of the canvas on which shapes are drawn


def _polygon(*points: tuple[float, float]) -> Callable[[Mask], None]:
    corners = np.array([[R + 0.8 * R * x, R + 0.8 * R * y] for x, y in points], np.int32)
    return lambda mask: cv2.fillPoly(mask, [corners], 255)  # type: ignore[func-returns-value]


def _star(mask: Mask) -> None:
    angle, radius = np.arange(10) * np.pi / 5, np.where(np.arange(10) % 2, 0.35, 1.0)
    _polygon(*zip(radius * np.sin(angle), -radius * np.cos(angle), strict=True))(mask)


def _discs(*places: tuple[float, float], radius: float = 0.4, inner: float = 0.0) -> Callable[[Mask], None]:
    def draw(mask: Mask) -> None:
        for x, y in places:
            cv2.circle(mask, (int(R + 0.8 * R * x), int(R + 0.8 * R * y)), int(0.8 * R * radius), 255, -1)
            cv2.circle(mask, (int(R + 0.8 * R * x), int(R + 0.8 * R * y)), int(0.8 * R * inner), 0, -1)

    return draw


def _cross(mask: Mask) -> None:
    _polygon((-1, -0.25), (1, -0.25), (1, 0.25), (-1, 0.25))(mask)
    _polygon((-0.25, -1), (-0.25, 1), (0.25, 1), (0.25, -1))(mask)


def _gate(mask: Mask) -> None:
    _polygon((-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9))(mask)
    cv2.rectangle(mask, (int(0.68 * R), int(0.76 * R)), (int(1.32 * R), 2 * R), 0, -1)


SHAPES: dict[str, Callable[[Mask], None]] = {
    "bar": _polygon((-1, -0.2), (1, -0.2), (1, 0.2), (-1, 0.2)),
    "cross": _cross,
    "disc": _discs((0, 0), radius=0.9),
    "ring": _discs((0, 0), radius=1.0, inner=0.6),
    "square": _polygon((-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)),
    "triangle": _polygon((0, -1), (1, 0.8), (-1, 0.8)),
    # of the tests alone
    "corner": _polygon((-0.9, -0.9), (-0.3, -0.9), (-0.3, 0.3), (0.9, 0.3), (0.9, 0.9), (-0.9, 0.9)),
    "gate": _gate,
    "post": _polygon((-0.2, -1), (0.2, -1), (0.2, 1), (-0.2, 1)),
    "star": _star,
    "two": _discs((-0.55, 0), (0.55, 0)),
}  # fmt: skip
"""Shape -> draws it on a black canvas of side 2 R."""
BASE, UNSEEN = tuple(SHAPES)[:6], tuple(SHAPES)[6:]


def view(shape: str, number: int, seed: int, size: int) -> tuple[NDArray[np.uint8], Mask]:
    """Image (BGR) and mask (255 = object) of object `number` of a shape, moved and before a background by the seed."""
    own, random = np.random.default_rng([number, 7]), np.random.default_rng([number, seed])
    colour, width, height = own.integers(0, 256, 3), own.uniform(0.8, 1.0), own.uniform(0.8, 1.0)
    canvas = np.zeros((2 * R, 2 * R), np.uint8)
    SHAPES[shape](canvas)
    turn, scale = np.deg2rad(random.uniform(-15, 15)), size / (2 * R) * random.uniform(0.8, 1.0)
    c, s = np.cos(turn), np.sin(turn)
    linear = scale * np.array([[c, -s], [s, c]]) @ np.diag([width, height])
    shift = size / 2 + random.uniform(-0.06, 0.06, 2) * size - linear @ [R, R]
    mask = cv2.warpAffine(canvas, np.column_stack([linear, shift]), (size, size), flags=cv2.INTER_NEAREST)
    surface = np.clip(colour + random.normal(0, 12, (size, size, 3)), 0, 255).astype(np.uint8)
    return np.where(mask[..., None] > 0, surface, texture(random, size)), mask


def write_labelled(
    folder: Path,
    *,
    shapes: Sequence[str] = BASE,
    objects: int = 6,
    held_out: int = 0,
    views: int = 2,
    size: int = 32,
    unnamed: bool = False,
) -> Path:
    """Write SHARDS: of each shape `objects` objects for training and `held_out` more, each seen `views` times.

    Args:
        unnamed: leave the categories out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    name, rows = "views-000000.tar", []
    with (folder / name).open("wb") as file, TarWriter(file, mtime=0, encoder=False) as tar:  # type: ignore[arg-type]
        for kind, number, turn in np.ndindex(len(shapes), objects + held_out, views):
            # objects of all shapes differ, and a shape's are the same whatever the other ones are
            image, mask = view(shapes[kind], 100 * tuple(SHAPES).index(shapes[kind]) + number, turn, size)
            sequence, start = f"{shapes[kind]}_{number}", tar.tarstream.offset
            key = f"{sequence}-{turn:06d}"
            info = json.dumps({"sequence": sequence, "frame": turn}).encode()
            tar.write({"__key__": key, "jpg": encode(".jpg", image), "png": encode(".png", mask), "json": info})
            rows.append(
                {
                    "key": key,
                    "shard": name,
                    "offset": start,
                    "size": tar.tarstream.offset - start,
                    "sequence": sequence,
                    "instance": sequence,
                    "category": None if unnamed else shapes[kind],
                    "split": "train" if number < objects else "val",
                    "frame": turn,
                    "mask_share": float((mask > 0).mean()),
                }
            )
    table = pa.Table.from_pylist(rows)
    if unnamed:
        table = table.set_column(table.column_names.index("category"), "category", pa.nulls(len(rows), pa.string()))
    pq.write_table(table, folder / "views.parquet")
    data = (folder / name).read_bytes()
    shards = {name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data), "samples": len(rows)}}
    tables = {"views.parquet": hashlib.sha256((folder / "views.parquet").read_bytes()).hexdigest()}
    manifest = {"counts": {"views": len(rows)}, "shards": shards, "tables": tables, "settings": {}, "versions": {}}
    (folder / "dataset.json").write_text(json.dumps(manifest, indent=1))
    return folder


def rewrite(folder: Path, change: Callable[[list[dict[str, Any]]], object]) -> None:
    """Change rows of views.parquet, and its hash in dataset.json."""
    rows = pq.read_table(folder / "views.parquet").to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows), folder / "views.parquet")
    manifest = json.loads((folder / "dataset.json").read_text())
    manifest["tables"]["views.parquet"] = hashlib.sha256((folder / "views.parquet").read_bytes()).hexdigest()
    (folder / "dataset.json").write_text(json.dumps(manifest))


def damage(folder: Path, *keys: str) -> None:
    """Overwrite the photos of these views; sizes and hashes in dataset.json stay."""
    rows = {row["key"]: row for row in pq.read_table(folder / "views.parquet").to_pylist()}
    for key in keys:
        path, at = folder / rows[key]["shard"], rows[key]["offset"]
        data = bytearray(path.read_bytes())
        found = data.index(b"\xff\xd8\xff", at, at + rows[key]["size"])
        data[found : found + 64] = bytes(64)
        path.write_bytes(bytes(data))
