"""Batches of single views: what is decoded, and what becomes of damaged samples."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny_labelled import SHAPES, damage, view, write_labelled
from tiny_shards import encode

from dope.common.errors import BadInput
from dope.single_views import ImageBatch, ViewDataset
from dope.streaming import PairLoader

NAMES = ("bar", "disc", "ring")


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_labelled(tmp_path_factory.mktemp("shards"), shapes=NAMES, objects=2, size=32)


@pytest.fixture
def copy(shards: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(shards, tmp_path / "copy"))


def test_a_batch_holds_the_views_of_its_rows_in_their_order(shards: Path) -> None:
    dataset = ViewDataset(shards, "train", image_size=32)
    rows = [7, 0, 11, 7]  # one of them twice, as two episodes of a step may have it
    batch = dataset.batch(rows)
    assert dataset.classes == NAMES and batch.images.dtype == torch.uint8 and batch.masks.dtype == torch.bool
    assert batch.images.shape == (4, 3, 32, 32) and batch.masks.shape == (4, 1, 32, 32) and not batch.damaged
    for place, row in enumerate(rows):
        name, number = str(dataset.index.sequences[row]).split("_")
        image, mask = view(name, 100 * tuple(SHAPES).index(name) + int(number), int(batch.keys[place][-1]), 32)
        assert dataset.classes[batch.labels[place]] == name
        assert np.array_equal(batch.masks[place, 0].numpy(), mask > 0)
        stored = cv2.imdecode(np.frombuffer(encode(".jpg", image), np.uint8), cv2.IMREAD_COLOR)
        assert np.array_equal(batch.images[place].numpy(), stored[..., ::-1].transpose(2, 0, 1))  # RGB
    assert batch.objects.tolist() == dataset.index.objects[rows].tolist()


def test_views_are_resized(shards: Path) -> None:
    batch = ViewDataset(shards, "train", image_size=64).batch([0, 1])
    assert batch.images.shape == (2, 3, 64, 64)
    small = ViewDataset(shards, "train", image_size=32).batch([0, 1])
    shrunk = torch.nn.functional.avg_pool2d(batch.masks.float(), 2)
    assert (shrunk - small.masks.float()).abs().mean() < 0.05


def test_a_damaged_view_is_named_and_its_place_filled_by_a_good_one(copy: Path) -> None:
    dataset = ViewDataset(copy, "train", image_size=32)
    whole = dataset.batch([0, 1, 5, 9])
    damage(copy, whole.keys[1], whole.keys[2])
    batch = ViewDataset(copy, "train", image_size=32).batch([0, 1, 5, 9])
    assert set(batch.damaged) == {1, 2} and batch.keys == whole.keys
    assert batch.damaged[1].key == whole.keys[1] and batch.damaged[1].shard == "views-000000.tar"
    for place, other in ((1, 0), (2, 3)):
        assert torch.equal(batch.images[place], batch.images[other])
        assert batch.labels[place] == batch.labels[other] and batch.objects[place] == batch.objects[other]
    good = batch.without_damaged()
    assert good.keys == (whole.keys[0], whole.keys[3]) and not good.damaged
    assert torch.equal(good.images, whole.images[[0, 3]]) and torch.equal(good.labels, whole.labels[[0, 3]])
    assert dataset.index.labels[[1, 5]].tolist() == whole.labels[[1, 2]].tolist()  # the index itself is what it was


def test_a_batch_without_any_good_view_has_no_labels(copy: Path) -> None:
    keys = ViewDataset(copy, "train", image_size=32).batch([2, 3]).keys
    damage(copy, *keys)
    batch = ViewDataset(copy, "train", image_size=32).batch([2, 3])
    assert batch.labels.tolist() == batch.objects.tolist() == [-1, -1]
    assert batch.images.max() == 0 and not batch.masks.any() and len(batch.without_damaged()) == 0


@pytest.mark.parametrize("workers", [0, 1])
def test_the_loader_gives_the_same_batches_with_any_number_of_workers(shards: Path, workers: int) -> None:
    dataset, rows = ViewDataset(shards, "train", image_size=32), [[0, 5], [3, 1], [11, 10]]
    for batch, wanted in zip(PairLoader(dataset, rows, workers=workers), rows, strict=True):
        assert isinstance(batch, ImageBatch) and torch.equal(batch.images, dataset.batch(wanted).images)


def test_where_nobody_asks_for_damaged_views_the_first_one_is_an_error(copy: Path) -> None:
    dataset = ViewDataset(copy, "train", image_size=32)
    damage(copy, dataset.batch([4]).keys[0])
    with pytest.raises(BadInput, match=r"views-000000\.tar, sample .*-000000: .*jpg"):
        list(PairLoader(dataset, [[4, 5]]))


def test_parts_of_a_batch(shards: Path) -> None:
    batch = ViewDataset(shards, "train", image_size=32).batch(range(6))
    assert batch.at([4, 1]).keys == (batch.keys[4], batch.keys[1])
    part = batch.at(slice(2, 5))
    assert len(part) == 3 and torch.equal(part.images, batch.images[2:5]) and part.keys == batch.keys[2:5]
    inner = batch.laid_out(channels_last=True)
    assert inner.images.is_contiguous(memory_format=torch.channels_last) and torch.equal(inner.images, batch.images)
