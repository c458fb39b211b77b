import io
import json
import os
import shutil
import subprocess
import tarfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from tiny_shards import make_pair, write_shards
from webdataset import TarWriter

from dope.common.errors import BadInput, DopeError
from dope.shard_index import read_index, verify_hashes
from dope.streaming import PairDataset, PairLoader, collate
from dope.tar_samples import ShardReader, split_members


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=6, pairs=2, val_objects=2)


@pytest.fixture
def copy(shards: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(shards, tmp_path / "copy"))


def test_members_equal_tarfile(shards: Path) -> None:
    path = shards / "train-000000.tar"
    with tarfile.open(path) as tar:
        expected = {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]
    assert split_members(path.read_bytes(), "x") == expected


@pytest.mark.parametrize("format", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_long_names_of_all_tar_formats(format: int) -> None:
    names = ["short.1.jpg", "folder/" * 20 + "long.1.png", "x" * 95 + ".json"]
    if format != tarfile.USTAR_FORMAT:
        names += ["ä" * 80 + ".1.jpg", "y" * 300 + ".corr.npy"]
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=format) as tar:
        for i, name in enumerate(names):
            info = tarfile.TarInfo(name)
            info.size = 700 * i
            tar.addfile(info, io.BytesIO(bytes([i]) * info.size))
    assert split_members(buffer.getvalue(), "x") == {name: bytes([i]) * 700 * i for i, name in enumerate(names)}


def test_a_damaged_header_and_a_cut_member_are_errors() -> None:
    buffer = io.BytesIO()
    with TarWriter(buffer, mtime=0, encoder=False) as tar:
        tar.write({"__key__": "a", "jpg": b"1" * 2000})
    data = bytearray(buffer.getvalue())
    with pytest.raises(BadInput, match="cut off"):
        split_members(bytes(data[:1500]), "shard.tar")
    data[3] ^= 1
    with pytest.raises(BadInput, match=r"shard\.tar: damaged tar header"):
        split_members(bytes(data), "shard.tar")


def test_decodes_what_was_written(shards: Path) -> None:
    dataset = PairDataset(shards, "train", image_size=64)
    assert len(dataset) == 12
    row = int(np.flatnonzero(dataset.index.keys == "object_004-0001")[0])
    decoded, made = dataset[row], make_pair(4, 1)
    assert decoded.key == "object_004-0001" and decoded.object == 4
    np.testing.assert_array_equal(decoded.points, made.points)
    for view in (0, 1):
        np.testing.assert_array_equal(decoded.masks[view], made.masks[view] > 0)
        error = np.abs(decoded.images[view].astype(int) - cv2.cvtColor(made.images[view], cv2.COLOR_BGR2RGB))
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


def test_smaller_images_scale_points_and_shrink_by_area(shards: Path) -> None:
    full, half = PairDataset(shards, "train", image_size=64)[0], PairDataset(shards, "train", image_size=32)[0]
    np.testing.assert_allclose(half.points, full.points / 2)
    blocks = full.images[0].reshape(32, 2, 32, 2, 3).mean((1, 3))
    assert np.abs(half.images[0] - blocks).max() <= 1.0
    assert half.masks[1].shape == (32, 32)


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


def unfinished(folder: Path) -> None:
    (folder / "dataset.json").unlink()


def no_shards_listed(folder: Path) -> None:
    (folder / "dataset.json").write_text(json.dumps({"counts": {}}))


@pytest.mark.parametrize(
    ("damage", "file", "what"),
    [
        (cut, "train-000001.tar", "cut off"),
        (remove, "train-000001.tar", "missing"),
        (exchange, "train-000000.tar", "another dataset|cut off"),
        (exchange_with_same_size, "train-000001.tar", "different datasets"),
        (garble_index, "index.parquet", "cannot be read"),
        (drop_column, "index.parquet", "lacks the columns offset"),
        (another_index, "index.parquet", "is not the one of dataset.json"),
        (drop_rows, "train-000000.tar", "9 samples of it, dataset.json 10"),
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
    dataset._reader.sample = lambda *_: os.kill(os.getpid(), 9)  # type: ignore[method-assign,assignment,return-value]
    with pytest.raises(DopeError, match=r"process that decodes samples died .*data\.workers"):
        list(PairLoader(dataset, [[0, 1]], workers=1))


def test_pickled_correspondences_are_refused(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.save(buffer, np.array([object()]), allow_pickle=True)
    folder = write_shards(tmp_path, n_objects=2, pairs=1)
    dataset = PairDataset(folder, "train", image_size=64)
    members = dataset._reader.sample(
        str(dataset.index.shards[0]), int(dataset.index.offsets[0]), int(dataset.index.sizes[0]), "object_000-0000"
    )
    dataset._reader.sample = lambda *_: {**members, "corr.npy": buffer.getvalue()}  # type: ignore[method-assign]
    with pytest.raises(BadInput, match=r"corr\.npy cannot be read"):
        dataset[0]


def test_a_reader_survives_pickling_after_it_opened_files(shards: Path) -> None:
    import pickle

    index, reader = read_index(shards, "train"), ShardReader(shards)
    place = (str(index.shards[0]), int(index.offsets[0]), int(index.sizes[0]), str(index.keys[0]))
    first = reader.sample(*place)
    assert pickle.loads(pickle.dumps(reader)).sample(*place) == first
    reader.close()


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
