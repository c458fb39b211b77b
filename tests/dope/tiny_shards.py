"""Writes a small, valid folder of shards: textured discs, where view 2 is a known similarity transform of view 1."""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from webdataset import TarWriter

TABLES = ("index.parquet", "views.parquet")


@dataclass
class TinyPair:
    """Two views (BGR), their masks (255 = object), N x 4 true correspondences and the transform between the views."""

    images: list[NDArray[np.uint8]]
    masks: list[NDArray[np.uint8]]
    points: NDArray[np.float32]
    second_from_first: NDArray[np.float64]
    """(2, 3): pixel of view 2 = A @ (x, y, 1), pixel centres at +0.5."""


def texture(generator: np.random.Generator, size: int) -> NDArray[np.uint8]:
    """Random colour blobs of three scales."""
    layers = [cv2.resize(generator.random((n, n, 3)), (size, size), interpolation=cv2.INTER_CUBIC) for n in (3, 7, 15)]
    return np.clip(255 * (0.5 * layers[0] + 0.3 * layers[1] + 0.2 * layers[2]), 0, 255).astype(np.uint8)


def make_pair(
    object_seed: int,
    pair_seed: int,
    size: int = 64,
    n_points: int = 200,
    max_turn: float = 25.0,
    max_shift: float = 0.1,
) -> TinyPair:
    """One object's texture (by `object_seed`) seen twice (by `pair_seed`) before two random backgrounds."""
    surface = texture(np.random.default_rng(object_seed), size)
    generator = np.random.default_rng([object_seed, pair_seed])
    radius = 0.33 * size
    transforms, images, masks = [], [], []
    for _ in range(2):
        turn, shift = generator.uniform(-max_turn, max_turn), generator.uniform(-max_shift, max_shift, 2) * size
        transform = cv2.getRotationMatrix2D((size / 2, size / 2), turn, 1.0)
        transform[:, 2] += shift
        # cv2 has pixel centres at whole numbers: the same transform, moved by half a pixel
        warp = transform.copy()
        warp[:, 2] += transform[:, :2] @ [0.5, 0.5] - 0.5
        mask = np.zeros((size, size), np.uint8)
        cv2.circle(mask, (size // 2, size // 2), int(radius), 255, -1)
        mask = cv2.warpAffine(mask, warp, (size, size), flags=cv2.INTER_NEAREST)
        seen = cv2.warpAffine(surface, warp, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        images.append(np.where(mask[..., None] > 0, seen, texture(generator, size)))
        masks.append(mask)
        transforms.append(np.vstack([transform, [0, 0, 1]]))
    angle, distance = generator.uniform(0, 2 * np.pi, n_points), (radius - 2) * np.sqrt(generator.random(n_points))
    surface_points = np.stack(
        [size / 2 + distance * np.cos(angle), size / 2 + distance * np.sin(angle), np.ones(n_points)]
    )
    views = [(transform[:2] @ surface_points).T for transform in transforms]
    points = np.concatenate(views, axis=1)
    inside = ((points >= 0) & (points < size)).all(axis=1)
    return TinyPair(
        images, masks, points[inside].astype(np.float32), (transforms[1] @ np.linalg.inv(transforms[0]))[:2]
    )


def write_shards(
    folder: Path,
    *,
    n_objects: int = 8,
    pairs: int = 2,
    val_objects: int = 0,
    val_pairs: int = 2,
    size: int = 64,
    n_points: int = 200,
    per_shard: int = 10,
    seed: int = 0,
) -> Path:
    """Write SHARDS with `n_objects` x `pairs` training pairs and `val_objects` x `val_pairs` held-out ones."""
    folder.mkdir(parents=True, exist_ok=True)
    shards: dict[str, Any] = {}
    index: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    for split, first, count, n_pairs in (("train", 0, n_objects, pairs), ("val", n_objects, val_objects, val_pairs)):
        samples = [(o, p) for p in range(n_pairs) for o in range(first, first + count)]  # rounds over objects
        for number in range(0, len(samples), per_shard):
            name = f"{split}-{number // per_shard:06d}.tar"
            chunk = samples[number : number + per_shard]
            encoded = [_pair_sample(make_pair(seed * 1000 + o, p, size, n_points), o, p) for o, p in chunk]
            index += _write_tar(folder, name, split, encoded, shards)
    encoded = [_view_sample(make_pair(seed * 1000 + o, 0, size, n_points), o) for o in range(n_objects + val_objects)]
    views += _write_tar(folder, "views-000000.tar", "train", encoded, shards)
    pq.write_table(pa.Table.from_pylist(index), folder / "index.parquet")
    pq.write_table(pa.Table.from_pylist(views), folder / "views.parquet")
    counts = {"pairs": len(index), "views": len(views), "objects": n_objects + val_objects}
    tables = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in TABLES}
    manifest = {"counts": counts, "shards": shards, "tables": tables, "settings": {"seed": seed}, "versions": {}}
    (folder / "dataset.json").write_text(json.dumps(manifest, indent=1))
    return folder


def to_memory(folder: Path, name: str) -> str:
    """Copy SHARDS into fsspec's memory:// and return the URL."""
    memory = fsspec.filesystem("memory")
    for path in folder.iterdir():
        memory.pipe_file(f"/{name}/{path.name}", path.read_bytes())
    return f"memory://{name}"


def _write_tar(
    folder: Path, name: str, split: str, samples: list[tuple[dict[str, Any], dict[str, Any]]], shards: dict[str, Any]
) -> list[dict[str, Any]]:
    rows = []
    with (folder / name).open("wb") as file, TarWriter(file, mtime=0, encoder=False) as tar:  # type: ignore[arg-type]
        for sample, row in samples:
            start = tar.tarstream.offset
            tar.write(sample)
            placed = {"key": sample["__key__"], "shard": name, "offset": start, "size": tar.tarstream.offset - start}
            rows.append({**placed, "split": split, **row})
    data = (folder / name).read_bytes()
    shards[name] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data), "samples": len(samples)}
    return rows


def _pair_sample(pair: TinyPair, number: int, pair_number: int) -> tuple[dict[str, Any], dict[str, Any]]:
    sequence = f"object_{number:03d}"
    row = {
        "sequence": sequence,
        "instance": sequence,
        "category": f"category_{number % 4}",
        "frame1": 2 * pair_number,
        "frame2": 2 * pair_number + 1,
        "n_correspondences": len(pair.points),
        "angle_deg": 10.0,
    }
    buffer = io.BytesIO()
    np.save(buffer, pair.points)
    sample: dict[str, Any] = {"__key__": f"{sequence}-{pair_number:04d}"}
    for view in (0, 1):
        sample[f"{view + 1}.jpg"] = encode(".jpg", pair.images[view])
        sample[f"{view + 1}.png"] = encode(".png", pair.masks[view])
    return {**sample, "corr.npy": buffer.getvalue(), "json": json.dumps(row).encode()}, row


def _view_sample(pair: TinyPair, number: int) -> tuple[dict[str, Any], dict[str, Any]]:
    sequence = f"object_{number:03d}"
    row = {"sequence": sequence, "instance": sequence, "category": f"category_{number % 4}", "frame": 0}
    row["mask_share"] = float((pair.masks[0] > 0).mean())
    sample = {"__key__": f"{sequence}-000000", "jpg": encode(".jpg", pair.images[0])}
    return {**sample, "png": encode(".png", pair.masks[0]), "json": json.dumps(row).encode()}, row


def encode(suffix: str, image: NDArray[np.uint8]) -> bytes:
    """An image as JPEG (quality 95) or PNG bytes."""
    return cv2.imencode(suffix, image, [cv2.IMWRITE_JPEG_QUALITY, 95] if suffix == ".jpg" else [])[1].tobytes()
