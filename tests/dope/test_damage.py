"""Damaged samples: reported, counted over ranks and resumes, filled in for, and too many of them stop a run."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
import torch
from tiny_shards import to_memory, write_shards

from dope.augmentation import no_augmentation
from dope.batch import DamagedSample, PairBatch
from dope.checkpoints import list_checkpoints, read_checkpoint
from dope.common.errors import BadInput
from dope.config import TrainConfig, load_config
from dope.distributed import Ranks
from dope.methods import method_of
from dope.order import Place, SampleOrder
from dope.run_logging import read_metrics
from dope.shard_index import read_index
from dope.state import new_state, wrap
from dope.step import choose_cells, compute_losses
from dope.streaming import PairDataset, PairLoader
from dope.trainer import train

TINY = [
    "network.width=0.125", "network.pyramid=16", "network.projector=[16, 8]", "data.image_size=32", "data.points=8",
    "data.batch_size=4", "data.pairs_per_object=1", "data.workers=0", "schedule.epochs=4", "validation.every=0",
    "checkpoint.every=0", "log.every=1", "device=cpu",
]  # fmt: skip


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=8, pairs=1, val_objects=3, size=32, n_points=60)


@pytest.fixture
def copy(shards: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(shards, tmp_path / "copy"))


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def tiny(*overrides: str) -> TrainConfig:
    return load_config("nano", None, [*TINY, *overrides])


def damage(folder: Path, *objects: int, split: str = "train", at: int = 512) -> None:
    """Write zeros over the first JPEG of these objects' first pairs (over its tar header where `at` is 0)."""
    index = read_index(folder, split)
    for number in objects:
        row = int((index.objects == number).nonzero()[0][0])
        with (folder / str(index.shards[row])).open("rb+") as file:
            file.seek(int(index.offsets[row]) + at)
            file.write(b"\0" * 400)


def test_a_damaged_sample_is_filled_in_for_by_a_good_one_without_points(copy: Path) -> None:
    damage(copy, 2)
    damage(copy, 5, at=0)
    dataset = PairDataset(copy, "train", image_size=32)
    (batch,) = PairLoader(dataset, [[1, 2, 3, 5]], fill_damaged=True)
    assert batch.damaged == {
        1: DamagedSample("train-000000.tar", "object_002-0000", "1.jpg cannot be decoded"),
        3: DamagedSample("train-000000.tar", "object_005-0000", "has nothing but zeros at byte 46080"),
    }
    assert len(batch) == 4 and batch.objects.tolist() == [1, 1, 3, 3]
    assert batch.valid.any(1).tolist() == [True, False, True, False]
    assert torch.equal(batch.images1[1], batch.images1[0]) and torch.equal(batch.images2[3], batch.images2[2])
    whole = batch.without_damaged()
    assert whole.keys == ("object_001-0000", "object_003-0000") and whole.damaged == {}
    assert torch.equal(whole.points, batch.points[[0, 2]]) and len(whole.masks2) == 2


def test_what_fills_in_has_no_part_in_the_contrastive_loss(copy: Path) -> None:
    def contrastive(batch: PairBatch) -> dict[str, float]:
        config, alone = tiny(), Ranks(0, 1, torch.device("cpu"))
        state = new_state(method_of(config), alone)
        online = wrap(method_of(config).online(state.network), alone).eval()
        state.momentum.eval()
        sampled = choose_cells(no_augmentation(batch), 8, torch.full((len(batch),), 0.5))
        return compute_losses(online, state.momentum, sampled, config, alone).report

    damage(copy, 3)
    dataset = PairDataset(copy, "train", image_size=32)
    (filled,), (without,) = (PairLoader(dataset, [rows], fill_damaged=True) for rows in ([0, 1, 3], [0, 1]))
    ours, expected = contrastive(filled), contrastive(without)
    assert ours["points"] == expected["points"] == 16
    assert ours["contrastive"] == pytest.approx(expected["contrastive"], rel=1e-5)


@pytest.mark.parametrize("workers", [0, 1])
def test_without_a_limit_the_first_one_is_an_error(copy: Path, workers: int) -> None:
    damage(copy, 2)
    dataset = PairDataset(copy, "train", image_size=32)
    with pytest.raises(BadInput, match=r"train-000000\.tar, sample object_002-0000: 1\.jpg cannot be decoded"):
        list(PairLoader(dataset, [[0, 1], [2, 3]], workers=workers))


def test_a_share_without_any_good_sample_is_black(copy: Path) -> None:
    damage(copy, 2, 3)
    (batch,) = PairLoader(PairDataset(copy, "train", image_size=32), [[2, 3]], fill_damaged=True)
    assert len(batch) == len(batch.damaged) == 2 and not batch.valid.any() and not batch.images1.any()
    assert batch.images1.shape == (2, 3, 32, 32) and batch.objects.tolist() == [-1, -1]


def test_the_first_damaged_sample_stops_a_run_which_goes_on_with_a_limit(copy: Path, tmp_path: Path) -> None:
    damage(copy, 6)
    run = tmp_path / "run"
    with pytest.raises(
        BadInput, match=r"train-000000\.tar, sample object_006-0000: 1\.jpg cannot be decoded"
    ) as caught:
        train(copy, run, tiny())
    assert "--max-bad-samples 1" in str(caught.value) and "data.max_bad_samples is 0" in str(caught.value)
    result = train(copy, run, tiny("data.max_bad_samples=1"))
    assert result["status"] == "finished" and result["step"] == 8 and result["damaged"] == 1
    lines = read_metrics(run, "damaged")
    assert {(line["shard"], line["key"], line["reason"]) for line in lines} == {
        ("train-000000.tar", "object_006-0000", "1.jpg cannot be decoded")
    }
    assert [line["step"] for line in read_metrics(run, "step")] == list(range(1, 9))  # four epochs, all their steps


def test_damaged_samples_are_counted_once_and_over_resumes(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(copy, 1, 6)
    run = tmp_path / "run"
    train(copy, run, tiny("data.max_bad_samples=2"), stop_after=4)
    assert sorted(line["key"] for line in read_metrics(run, "damaged")) == ["object_001-0000", "object_006-0000"]
    said = [line for line in capsys.readouterr().err.splitlines() if "damaged sample" in line]
    assert len(said) == 2 and "object_00" in said[0] and "(1 of at most 2)" in said[0] and "train-000000.tar" in said[0]
    assert read_checkpoint(list_checkpoints(run)[-1])["damaged"] == ["object_001-0000", "object_006-0000"]
    damage(copy, 3)
    assert train(copy, run, tiny("data.max_bad_samples=3"))["damaged"] == 3
    assert len(read_metrics(run, "damaged")) == 3
    with pytest.raises(BadInput, match=r"3 damaged, data\.max_bad_samples is 2"):
        train(copy, run, tiny("data.max_bad_samples=2"))


def test_where_too_many_are_damaged_a_checkpoint_keeps_what_was_learnt(copy: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(copy, run, tiny(), stop_after=3)
    damage(copy, *range(8))
    with pytest.raises(BadInput):
        train(copy, run, tiny("data.max_bad_samples=3"))
    newest = read_checkpoint(run)
    assert newest["step"] == 3 and len(newest["damaged"]) == 4  # the batch that was too much


def test_a_share_that_is_damaged_as_a_whole_stops_a_run(copy: Path, tmp_path: Path) -> None:
    train(copy, tmp_path / "run", tiny("data.max_bad_samples=100"), stop_after=1)
    list_checkpoints(tmp_path / "run")[0].rename(given := tmp_path / "given.pt")
    damage(copy, *range(8))
    with pytest.raises(BadInput, match=r"all 4 samples of rank 0 at step 1 are damaged.*1\.jpg cannot be decoded"):
        train(copy, tmp_path / "new", tiny("data.max_bad_samples=100"), resume=given)
    assert read_checkpoint(tmp_path / "new")["step"] == 1, "nothing is lost"


def test_held_out_pairs_count_too_and_are_left_out(copy: Path, tmp_path: Path) -> None:
    damage(copy, 9, split="val")
    with pytest.raises(BadInput, match=r"val-000000\.tar, sample object_009-0000.*--max-bad-samples 1"):
        train(copy, tmp_path / "stopped", tiny("validation.every=1"))
    result = train(copy, tmp_path / "run", tiny("validation.every=1", "data.max_bad_samples=1", "schedule.epochs=1"))
    assert result["damaged"] == 1 and read_metrics(tmp_path / "run", "validation")[0]["pairs"] == 5


@pytest.mark.parametrize("order", ["shuffled", "sequential"])
def test_a_run_on_remote_shards_is_that_on_local_ones(shards: Path, tmp_path: Path, order: str) -> None:
    url = to_memory(shards, "remote")
    settings = tiny(f"data.order={order}", "data.block=2", "data.workers=2", "validation.every=2")
    results = [train(of, tmp_path / str(i), settings) for i, of in enumerate((shards, url))]
    assert results[0]["loss"] == results[1]["loss"] and results[0]["pck"] == results[1]["pck"]
    fsspec.filesystem("memory").rm("/remote", recursive=True)


@pytest.mark.parametrize("order", ["shuffled", "sequential"])
def test_an_interrupted_epoch_goes_on_with_other_ranks_and_workers(shards: Path, order: str) -> None:
    dataset = PairDataset(shards, "train", image_size=32)  # one shard, and more workers than that
    rows = SampleOrder(dataset.index.objects, 4, order=order, block=2)  # type: ignore[arg-type]
    first = next(iter(PairLoader(dataset, rows.batches(Place(), 1))))

    def rest() -> Iterator[str]:
        for rank in (0, 1):
            loader = PairLoader(dataset, rows.batches(rows.after(Place()), 1, rank=rank, world=2), workers=3)
            yield from (key for batch in loader for key in batch.keys)

    keys = [*first.keys, *rest()]
    assert len(keys) == 8 and set(keys) == set(dataset.index.keys)


@pytest.mark.timeout(240)
def test_two_ranks_count_together_and_stop_together(copy: Path, tmp_path: Path) -> None:
    dataset = PairDataset(copy, "train", image_size=32)
    rows = SampleOrder(dataset.index.objects, 4).epoch(0)
    bad = rows[[0, 0, 1], [0, 2, 0]]  # at the first step one in each rank's share, at the second step rank 0's
    damage(copy, *dataset.index.objects[bad])
    root = Path(__file__).parents[2]
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", __file__]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": f"{root}:{root}/tests/dope"}
    environment["GLOO_SOCKET_IFNAME"] = "lo"
    done = subprocess.run(
        [*command, str(copy), str(tmp_path)], env=environment, timeout=200, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for rank in (0, 1):  # neither has met more than two itself
        assert "3 damaged, data.max_bad_samples is 2" in (tmp_path / f"{rank}.txt").read_text()
    lines = read_metrics(tmp_path / "run", "damaged")
    assert [line["step"] for line in lines] == [0, 0, 1] and [line["key"] for line in lines] == list(
        dataset.index.keys[bad]
    )
    newest = read_checkpoint(tmp_path / "run")
    assert newest["step"] == 1 and newest["damaged"] == sorted(dataset.index.keys[bad].tolist())


def on_a_rank(shards: Path, out: Path) -> None:
    """What each of two ranks does: train until the third damaged sample."""
    torch.set_num_threads(1)
    with pytest.raises(BadInput) as caught:
        train(shards, out / "run", tiny("data.max_bad_samples=2"))
    (out / f"{os.environ['RANK']}.txt").write_text(str(caught.value))


if __name__ == "__main__":
    on_a_rank(Path(sys.argv[1]), Path(sys.argv[2]))
