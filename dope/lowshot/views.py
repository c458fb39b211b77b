"""The single views of a folder of shards, read by index: what is evaluated, and what figures show."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput, UsageError
from dope.decoding import resized
from dope.shard_index import fingerprint_of, read_table
from dope.storage import Shards, Storage, open_storage
from dope.tar_samples import REMAKE, Location, ShardReader

COLUMNS = ("key", "shard", "offset", "size", "sequence", "instance", "category", "split", "frame")


@dataclass(frozen=True)
class View:
    """One view: `image` (H, W, 3) uint8 RGB, `mask` (H, W) bool, and the sample's JSON."""

    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    info: dict[str, Any]


class ViewShards:
    """The rows of SHARDS/views.parquet, and the views behind them.

    Attributes:
        folder: the path or URL where the shards lie.
        columns: the columns of views.parquet, each a list with one entry a view.

    Raises:
        BadInput: the folder or its views.parquet is absent, damaged or lacks columns, or has no views.
    """

    def __init__(self, shards: Shards) -> None:
        self._storage = open_storage(shards)
        self.folder = self._storage.address
        self.columns = _read_columns(self._storage)
        self._reader = ShardReader(self._storage)

    def __len__(self) -> int:
        return len(self.columns["key"])

    def read(self, index: int) -> View:
        """Decode one view. Raises `BadInput` naming the shard and sample where it cannot be."""
        members = self._members(index)
        image = self._decode(index, members, "jpg", cv2.IMREAD_COLOR)
        mask = self._decode(index, members, "png", cv2.IMREAD_GRAYSCALE) > 127
        try:
            info = json.loads(members["json"])
        except (KeyError, ValueError) as error:
            what = f"{self.columns['key'][index]}.json is missing or damaged"
            raise BadInput(what, where=self._where(index), remedy=REMAKE) from error
        return View(np.ascontiguousarray(image[..., ::-1]), mask, info)

    def image(self, index: int) -> NDArray[np.uint8]:
        """The image alone, (H, W, 3) uint8 RGB."""
        return np.ascontiguousarray(self._decode(index, self._members(index), "jpg", cv2.IMREAD_COLOR)[..., ::-1])

    def mask(self, index: int) -> NDArray[np.bool_]:
        """The mask alone, (H, W) bool."""
        return self._decode(index, self._members(index), "png", cv2.IMREAD_GRAYSCALE) > 127

    def masks(
        self, indices: Sequence[int] | NDArray[np.integer], *, image_size: int | None = None
    ) -> NDArray[np.bool_]:
        """Masks of `indices` (B, H, W); with `image_size` resized as the images are."""
        return np.stack([resized(255 * self.mask(int(i)).astype(np.uint8), image_size) > 127 for i in indices])

    def batches(
        self, indices: Sequence[int] | NDArray[np.integer], size: int, *, image_size: int | None = None
    ) -> Iterator[NDArray[np.uint8]]:
        """Images of `indices` in batches (B, H, W, 3) uint8 RGB; the next one is decoded while one is in use.

        With `image_size` views of another size become squares of that side, as in training.
        """
        chunks = [indices[start : start + size] for start in range(0, len(indices), size)]
        with ThreadPoolExecutor(1) as pool:
            pending = [pool.submit(self._batch, chunk, image_size) for chunk in chunks[:2]]
            for number in range(len(chunks)):
                batch = pending.pop(0).result()
                if number + 2 < len(chunks):
                    pending.append(pool.submit(self._batch, chunks[number + 2], image_size))
                yield batch

    def select(self, split: str = "all", categories: Sequence[str] = ()) -> NDArray[np.int64]:
        """Indices of the views of a split and of some categories (none given: of all).

        Raises:
            UsageError: a category that is not there (the closest one is named), or nothing is left.
        """
        known = sorted({name for name in self.columns["category"] if name})
        for name in categories:
            if name not in known:
                raise UsageError(f"no category '{name}' ({_closest(name, known)})", where=self.folder)
        chosen = np.array([split in ("all", s) for s in self.columns["split"]])
        if categories:
            chosen &= np.array([name in categories for name in self.columns["category"]])
        if not chosen.any():
            splits = ", ".join(sorted({str(s) for s in self.columns["split"]}))
            raise UsageError(f"no views of split '{split}' (there are: {splits})", where=self.folder)
        return np.flatnonzero(chosen)

    def population(
        self, indices: NDArray[np.integer], *, by_category: bool = True
    ) -> Mapping[str, dict[str, list[int]]]:
        """category -> object -> its views among `indices`; views without a category are of the category "".

        Raises:
            UsageError: `by_category` and no view has a category.
        """
        category, instance, sequence = (self.columns[name] for name in ("category", "instance", "sequence"))
        population: dict[str, dict[str, list[int]]] = {}
        for i in indices.tolist():
            if by_category and not category[i]:
                continue
            population.setdefault(category[i] or "", {}).setdefault(instance[i] or sequence[i], []).append(i)
        if not population:
            remedy = "Use --classes instance, or give the categories to `dope prep shards`"
            raise UsageError("the views have no category", where=self.folder, remedy=remedy)
        return population

    def of_sequence(self, sequence: str) -> NDArray[np.int64]:
        """Indices of a sequence's views by frame. Raises `UsageError` naming close ones where it is unknown."""
        found = [i for i, name in enumerate(self.columns["sequence"]) if name == sequence]
        if not found:
            hint = _closest(sequence, sorted(set(self.columns["sequence"])))
            raise UsageError(f"no views of sequence '{sequence}' ({hint})", where=self.folder)
        return np.array(sorted(found, key=lambda i: self.columns["frame"][i]), np.int64)

    @property
    def fingerprint(self) -> str:
        """16 hex digits that change whenever a view does: of the table and, where listed, the shards' hashes."""
        listed = self._listed()
        hashes = [[name, listed.get(name)] for name in sorted(set(self.columns["shard"]))]
        table = [[self.columns[name][i] for name in COLUMNS] for i in range(len(self))]
        return sha256(json.dumps([hashes, table], default=str).encode()).hexdigest()[:16]

    def categories_of_pairs(self, fingerprint: str) -> frozenset[str]:
        """Categories of the pairs for training beside these views; none where those have another fingerprint."""
        if fingerprint_of(self._listed(), "train") != fingerprint or "index.parquet" not in self._storage.sizes():
            return frozenset()
        table, _ = read_table(self._storage, "index.parquet", ("category", "split"), may_be_null=("category",))
        rows = zip(table["category"].to_pylist(), table["split"].to_pylist(), strict=True)
        return frozenset(name for name, split in rows if name and split == "train")

    def _listed(self) -> dict[str, Any]:
        """The shards' SHA-256 (None where unknown) by name, as far as dataset.json lists them."""
        known = "dataset.json" in self._storage.sizes()
        listed = self._storage.read_json("dataset.json").get("shards", {}) if known else {}
        return {name: entry.get("sha256") for name, entry in listed.items()}

    def _members(self, index: int) -> dict[str, bytes]:
        return self._reader.sample(**{name: self.columns[name][index] for name in Location._fields})

    def _where(self, index: int) -> str:
        return self._storage.where(self.columns["shard"][index])

    def _decode(self, index: int, members: Mapping[str, bytes], name: str, flags: int) -> NDArray[Any]:
        data = members.get(name)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
        if image is None:
            what = f"{self.columns['key'][index]}.{name} {'cannot be decoded' if data else 'is missing'}"
            raise BadInput(what, where=self._where(index), remedy=REMAKE)
        return image

    def _batch(self, indices: Sequence[int] | NDArray[np.integer], image_size: int | None) -> NDArray[np.uint8]:
        images = [resized(self.image(int(i)), image_size) for i in indices]
        for i, image in zip(indices, images, strict=True):
            if image.shape != images[0].shape:
                what = f"view {self.columns['key'][int(i)]} is {image.shape[1]}x{image.shape[0]} px, others are not"
                raise BadInput(what, where=self.folder, remedy="All views of a folder of shards have one size")
        return np.stack(images)


def _read_columns(storage: Storage) -> dict[str, list[Any]]:
    storage.sizes()  # is there such a folder at all?
    table, _ = read_table(storage, "views.parquet", COLUMNS, may_be_null=("category",))
    if not len(table):
        raise BadInput("has no views", where=storage.where("views.parquet"), remedy=REMAKE)
    return {name: column.to_pylist() for name, column in zip(table.column_names, table.columns, strict=True)}


def _closest(name: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    if close:
        return "did you mean " + " or ".join(f"'{other}'" for other in close) + "?"
    shown = ", ".join(known[:8]) + (" ..." if len(known) > 8 else "")
    return f"there are: {shown}" if known else "there are none"
