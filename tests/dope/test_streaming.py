import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from tiny_shards import make_pair, write_shards

from dope import commands
from dope.common.errors import BadInput, DopeError
from dope.shard_index import read_index, verify_hashes
from dope.streaming import PairDataset, PairLoader, collate


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=6, pairs=2, val_objects=2)


@pytest.fixture
def copy(shards: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(shards, tmp_path / "copy"))


def test_decodes_what_was_written(shards: Path) -> None:
    dataset = PairDataset(shards, "train", image_size=64)
    assert len(dataset) == 12
    row = int(np.flatnonzero(dataset.index.keys == "object_004-0001")[0])
    decoded, made = dataset[row], make_pair(4, 1)
    assert decoded.key == "object_004-0001" and decoded.object == 4
    np.testing.assert_array_equal(decoded.points, made.points)
    for view in (0, 1):
        np.testing.assert_array_equal(decoded.masks[view], made.masks[view] > 0)
        written = cv2.cvtColor(made.images[view], cv2.COLOR_BGR2RGB).transpose(2, 0, 1)
        error = np.abs(decoded.images[view].astype(int) - written)
        assert error.mean() < 6  # JPEG; swapped channels would be far off


def test_correspondences_of_the_helper_are_true() -> None:
    made = make_pair(3, 0, size=96)
    second = made.points[:, :2] @ made.second_from_first[:, :2].T + made.second_from_first[:, 2]
    np.testing.assert_allclose(second, made.points[:, 2:], atol=1e-3)
    # and so are the pixels: warp view 1 onto view 2 and compare inside the object
    warp = made.second_from_first.copy()
    warp[:, 2] += warp[:, :2] @ [0.5, 0.5] - 0.5
    warped = cv2.warpAffine(made.images[0], warp, (96, 96)).astype(int)
    inside = cv2.erode(made.masks[1], np.ones((9, 9))) > 0
    assert np.abs(warped - made.images[1])[inside].mean() < 4


def test_points_are_cut_to_max_points_and_padded_in_a_batch(shards: Path) -> None:
    dataset = PairDataset(shards, "train", image_size=64, max_points=50)
    pairs = [dataset[0], dataset[1]]
    pairs[1] = type(pairs[1])(pairs[1].images, pairs[1].masks, pairs[1].points[:7], 1, "b")
    batch = collate(pairs)
    assert batch.points.shape == (2, 50, 4)
    assert batch.valid.sum(1).tolist() == [50, 7]
    assert batch.images1.dtype == torch.uint8 and batch.images1.shape == (2, 3, 64, 64)
    assert batch.masks1.dtype == torch.bool and batch.masks1.shape == (2, 1, 64, 64)


def test_padding_rows_and_points_outside_are_invalid(shards: Path) -> None:
    pair = PairDataset(shards, "train", image_size=64)[0]
    points = np.array([[-1, -1, -1, -1], [5, 5, 5, 64], [5, 5, 5, np.nan], [5, 6, 7, 8]], np.float32)
    batch = collate([type(pair)(pair.images, pair.masks, points, 0, "a")])
    assert batch.valid.tolist() == [[False, False, False, True]]
    assert torch.isfinite(batch.points).all()


def test_a_pair_without_points_is_a_batch_without_valid_points(shards: Path) -> None:
    pair = PairDataset(shards, "train", image_size=64)[0]
    batch = collate([type(pair)(pair.images, pair.masks, np.zeros((0, 4), np.float32), 0, "a")])
    assert batch.points.shape == (1, 1, 4) and not batch.valid.any()


def test_object_numbers_are_places_among_all_sequences_of_the_dataset(shards: Path) -> None:
    assert sorted(set(read_index(shards, "train").objects)) == [0, 1, 2, 3, 4, 5]
    assert sorted(set(read_index(shards, "val").objects)) == [6, 7]


def test_workers_do_not_change_the_batches(shards: Path) -> None:
    dataset = PairDataset(shards, "train", image_size=64)
    rows = [[0, 5, 3], [1, 2, 4], [11, 10, 9]]
    alone, with_workers = list(PairLoader(dataset, rows)), list(PairLoader(dataset, rows, workers=2))
    assert [batch.keys for batch in alone] == [tuple(dataset.index.keys[r]) for r in rows]
    for a, b in zip(alone, with_workers, strict=True):
        assert a.keys == b.keys
        for name in ("images1", "images2", "masks1", "masks2", "points", "valid", "objects"):
            assert torch.equal(getattr(a, name), getattr(b, name))


def cut(folder: Path) -> None:
    os.truncate(folder / "train-000001.tar", (folder / "train-000001.tar").stat().st_size // 2)


def remove(folder: Path) -> None:
    (folder / "train-000001.tar").unlink()


def exchange(folder: Path) -> None:
    other = write_shards(folder / "other", n_objects=5, pairs=2, seed=9, n_points=100)
    shutil.copy(other / "train-000000.tar", folder / "train-000000.tar")


def exchange_with_same_size(folder: Path) -> None:
    path = folder / "train-000001.tar"
    data = path.read_bytes()
    size = int(data[124:135], 8)
    path.write_bytes(data[512 + -(-size // 512) * 512 :] + data[: 512 + -(-size // 512) * 512])


def garble_index(folder: Path) -> None:
    (folder / "index.parquet").write_bytes(b"PAR1 nothing")


def drop_column(folder: Path) -> None:
    pq.write_table(pq.read_table(folder / "index.parquet").drop_columns(["offset"]), folder / "index.parquet")


def another_index(folder: Path) -> None:
    table = pq.read_table(folder / "index.parquet")
    pq.write_table(table.take(list(reversed(range(len(table))))), folder / "index.parquet")


def forget_hashes(folder: Path) -> None:
    manifest = json.loads((folder / "dataset.json").read_text())
    del manifest["tables"]
    (folder / "dataset.json").write_text(json.dumps(manifest))


def drop_rows(folder: Path) -> None:
    forget_hashes(folder)
    pq.write_table(pq.read_table(folder / "index.parquet").slice(1), folder / "index.parquet")


def garble_both_ends(folder: Path) -> None:
    path = folder / "train-000001.tar"
    path.write_bytes(b"\7" * path.stat().st_size)


def beyond_the_end(folder: Path) -> None:
    forget_hashes(folder)
    table = pq.read_table(folder / "index.parquet")
    offsets = [offset + (10**6 if i == 3 else 0) for i, offset in enumerate(table["offset"].to_pylist())]
    table = table.set_column(table.schema.get_field_index("offset"), "offset", [offsets])
    pq.write_table(table, folder / "index.parquet")


def swapped_keys(folder: Path) -> None:
    forget_hashes(folder)
    table = pq.read_table(folder / "index.parquet")
    keys = table["key"].to_pylist()
    keys[0], keys[1] = keys[1], keys[0]
    pq.write_table(table.set_column(table.schema.get_field_index("key"), "key", [keys]), folder / "index.parquet")


def unlisted(folder: Path) -> None:
    manifest = json.loads((folder / "dataset.json").read_text())
    del manifest["shards"]["train-000001.tar"]
    (folder / "dataset.json").write_text(json.dumps(manifest))


def unfinished(folder: Path) -> None:
    (folder / "dataset.json").unlink()


def no_shards_listed(folder: Path) -> None:
    (folder / "dataset.json").write_text(json.dumps({"counts": {}}))


def manifest_of_another_kind(folder: Path) -> None:
    (folder / "dataset.json").write_text("[]")


def size_that_is_none(folder: Path) -> None:
    path = folder / "dataset.json"
    manifest = json.loads(path.read_text())
    manifest["shards"]["train-000001.tar"]["bytes"] = "many"
    path.write_text(json.dumps(manifest))


def column(name: str, values: list[object]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        forget_hashes(folder)
        table = pq.read_table(folder / "index.parquet")
        of = pa.array([values[i % len(values)] for i in range(len(table))])
        table = table.set_column(table.schema.get_field_index(name), name, of)
        pq.write_table(table, folder / "index.parquet")

    return damage


@pytest.mark.parametrize(
    ("damage", "file", "what"),
    [
        (manifest_of_another_kind, "dataset.json", "lists no shards"),
        (size_that_is_none, "dataset.json", "lists no shards"),
        (column("offset", ["a"]), "index.parquet", "values of another kind"),
        (column("split", [1]), "index.parquet", "values of another kind"),
        (column("n_correspondences", [None, 3]), "index.parquet", "has rows without n_correspondences"),
        (cut, "train-000001.tar", "cut off"),
        (remove, "train-000001.tar", "missing"),
        (exchange, "train-000000.tar", "another dataset|cut off"),
        (exchange_with_same_size, "train-000001.tar", "different datasets"),
        (garble_index, "index.parquet", "cannot be read"),
        (drop_column, "index.parquet", "lacks the columns offset"),
        (another_index, "index.parquet", "is not the one of dataset.json"),
        (drop_rows, "train-000000.tar", "9 samples of it, dataset.json 10"),
        (garble_both_ends, "train-000001.tar", "damaged tar header"),
        (beyond_the_end, "train-000000.tar", "is cut off: .* its samples need"),
        (swapped_keys, "train-000000.tar", "different datasets"),
        (unlisted, "train-000001.tar", "in index.parquet but not in dataset.json"),
        (unfinished, "copy", "no dataset.json"),
        (no_shards_listed, "dataset.json", "lists no shards"),
    ],
)
def test_damage_is_found_before_training_and_named(
    copy: Path, damage: Callable[[Path], None], file: str, what: str
) -> None:
    damage(copy)
    with pytest.raises(BadInput, match=what) as caught:
        PairDataset(copy, "train")
    assert Path(str(caught.value.where)).name == file
    assert caught.value.remedy


def test_a_damaged_first_sample_is_left_to_the_training(copy: Path) -> None:
    with (copy / "train-000000.tar").open("rb+") as file:
        file.write(b"damage")
    dataset = PairDataset(copy, "train", image_size=64)
    with pytest.raises(BadInput, match=r"train-000000\.tar, sample object_000-0000: damaged tar header"):
        dataset[0]


def test_damage_inside_a_shard_is_found_by_its_hash(copy: Path) -> None:
    verify_hashes(copy)
    with (copy / "train-000001.tar").open("rb+") as file:
        file.seek(5000)
        file.write(b"damage")
    with pytest.raises(BadInput, match=r"train-000001\.tar: its SHA-256"):
        verify_hashes(copy, "train")
    verify_hashes(copy, "val")


@pytest.mark.parametrize("workers", [0, 1])
def test_an_image_that_cannot_be_decoded_is_named_by_shard_and_key(copy: Path, workers: int) -> None:
    dataset = PairDataset(copy, "train", image_size=64)
    index = dataset.index
    with (copy / str(index.shards[3])).open("rb+") as file:
        file.seek(int(index.offsets[3]) + 512)
        file.write(b"\0" * 600)  # over the header of the first JPEG
    with pytest.raises(BadInput) as caught:
        list(PairLoader(dataset, [[2, 3]], workers=workers))
    assert str(index.shards[3]) in str(caught.value) and str(index.keys[3]) in str(caught.value)
    assert "Traceback" not in str(caught.value)


def test_a_worker_that_is_killed_is_explained(shards: Path) -> None:
    dataset = PairDataset(shards, "train", image_size=64)
    dataset._reader.samples = lambda *_: os.kill(os.getpid(), 9)  # type: ignore[method-assign,assignment,return-value]
    with pytest.raises(DopeError, match=r"process that decodes samples died .*data\.workers"):
        list(PairLoader(dataset, [[0, 1]], workers=1))


def test_pairs_with_too_few_correspondences_are_left_out(copy: Path) -> None:
    forget_hashes(copy)
    table = pq.read_table(copy / "index.parquet")
    counts = [n if i % 3 else i for i, n in enumerate(table["n_correspondences"].to_pylist())]
    counts = pa.array(counts)
    place = table.schema.get_field_index("n_correspondences")
    pq.write_table(table.set_column(place, "n_correspondences", counts), copy / "index.parquet")
    everything = PairDataset(copy, "train", image_size=64)
    some = PairDataset(copy, "train", image_size=64, min_correspondences=4)
    assert len(everything) == 12 and len(some) == 10 and some.index.left_out == 2  # rows 0 and 3 have 0 and 3
    assert list(some.index.keys) == [key for i, key in enumerate(everything.index.keys) if i not in (0, 3)]
    assert [some[row].key for row in (0, 9)] == [some.index.keys[0], some.index.keys[9]]
    assert some.index.fingerprint == everything.index.fingerprint
    assert len(PairDataset(copy, "train", image_size=64, min_correspondences=1)) == 11
    with pytest.raises(BadInput, match=r"none of its 12 pairs has 999 correspondences.*data\.min_correspondences=\d+"):
        PairDataset(copy, "train", min_correspondences=999)


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no such folder"):
        PairDataset(tmp_path / "none", "train")


def test_the_helper_is_deterministic_and_stock_webdataset_reads_it(shards: Path, tmp_path: Path) -> None:
    again = write_shards(tmp_path / "again", n_objects=6, pairs=2, val_objects=2)
    for path in shards.glob("*.tar"):
        assert path.read_bytes() == (again / path.name).read_bytes()
    import webdataset

    stock = webdataset.WebDataset(str(shards / "train-000000.tar"), shardshuffle=False)
    assert [sample["__key__"] for sample in stock] == list(read_index(shards, "train").keys[:10])
    subprocess.run(["tar", "tf", str(shards / "val-000000.tar")], check=True, capture_output=True)


def test_changed_bytes_that_can_be_decoded_are_found_on_request(copy: Path, tmp_path: Path) -> None:
    row = PairDataset(copy, "train", image_size=64).index.location(3)
    path = copy / row.shard
    data = bytearray(path.read_bytes())
    place = data.index(b"NUMPY", row.offset) + 200  # within the points
    data[place] ^= 1
    path.write_bytes(data)
    assert len(PairDataset(copy, "train", image_size=64)[3].points), "else nothing is shown"
    with pytest.raises(BadInput, match=f"{row.shard}: its SHA-256 is not the one in dataset.json"):
        commands.train(str(copy), tmp_path / "run", preset="nano", verify_shards=True)
    assert not (tmp_path / "run").exists()
