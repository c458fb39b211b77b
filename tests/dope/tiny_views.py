"""Writes a small folder of single views: a few categories, each of some objects, each seen several times."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from tiny_shards import encode, make_pair
from webdataset import TarWriter


def write_views(
    folder: Path, *, categories: int = 3, objects: int = 4, views: int = 2, size: int = 64, with_category: bool = True
) -> Path:
    """Write SHARDS/views.parquet and one tar; view v of object o of category c shows the texture of seed 100 c + o."""
    folder.mkdir(parents=True, exist_ok=True)
    name = "views-000000.tar"
    rows = []
    with (folder / name).open("wb") as file, TarWriter(file, mtime=0, encoder=False) as tar:  # type: ignore[arg-type]
        for c, o, v in np.ndindex(categories, objects, views):
            pair = make_pair(100 * c + o, v, size)
            sequence = f"shape{c}_object{o}"
            start = tar.tarstream.offset
            image, mask = encode(".jpg", pair.images[0]), encode(".png", pair.masks[0])
            info = json.dumps({"sequence": sequence, "frame": v}).encode()
            tar.write({"__key__": f"{sequence}-{v:06d}", "jpg": image, "png": mask, "json": info})
            rows.append(
                {
                    "key": f"{sequence}-{v:06d}",
                    "shard": name,
                    "offset": start,
                    "size": tar.tarstream.offset - start,
                    "sequence": sequence,
                    "instance": sequence,
                    "category": f"shape{c}" if with_category else None,
                    "split": "val" if o == objects - 1 else "train",
                    "frame": v,
                    "mask_share": float((pair.masks[0] > 0).mean()),
                }
            )
    pq.write_table(pa.Table.from_pylist(rows), folder / "views.parquet")
    return folder
