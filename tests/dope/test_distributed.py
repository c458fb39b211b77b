import json
import os
import subprocess
import sys
from pathlib import Path

import poisoned_rank
import pytest
import torch
import two_ranks
from tiny_shards import write_shards

from dope import commands
from dope.checkpoints import list_checkpoints, load_network
from dope.common.errors import UsageError
from dope.config import load_config
from dope.distributed import Ranks, pick_device, ranks_of
from dope.run_logging import read_metrics
from dope.state import new_state
from dope.step import momentum_keys
from dope.streaming import PairDataset, PairLoader
from dope.trainer import train
from dope.validation import pck

ALONE = Ranks(0, 1, torch.device("cpu"))
pytestmark = pytest.mark.timeout(240)


def torchrun(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Two ranks on this machine; a hanging collective ends with the time limit."""
    root = Path(__file__).parents[2]
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(root), "GLOO_SOCKET_IFNAME": "lo"}
    return subprocess.run(command, env=environment, timeout=200, capture_output=True, text=True, cwd=root)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=8, pairs=2, val_objects=3, size=32, n_points=60)


@pytest.fixture(scope="module")
def outcomes(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, int], dict]:
    out = tmp_path_factory.mktemp("outcomes")
    done = torchrun(str(Path(two_ranks.__file__)), str(shards), str(out))
    assert done.returncode == 0, done.stderr
    return {(v, rank): torch.load(out / f"{v}-{rank}.pt") for v in two_ranks.VARIANTS for rank in (0, 1)}


@pytest.mark.parametrize("variant", ["plain", "shuffled", "second_view", "same_objects"])
def test_loss_and_gradients_do_not_depend_on_the_number_of_ranks(
    shards: Path, outcomes: dict[tuple[str, int], dict], variant: str
) -> None:
    alone = two_ranks.outcome(two_ranks.global_batch(shards, variant), two_ranks.config_of(variant), ALONE)
    assert alone["report"]["points"] == 19
    for rank in (0, 1):
        for name, value in alone["report"].items():
            assert outcomes[variant, rank]["report"][name] == pytest.approx(value, abs=1e-5), name
        for name, gradient in alone["gradients"].items():
            torch.testing.assert_close(
                outcomes[variant, rank]["gradients"][name], gradient, atol=1e-5, rtol=1e-4, msg=lambda m, n=name: n + m
            )


def test_one_object_on_two_ranks_is_no_negative_of_itself(outcomes: dict[tuple[str, int], dict]) -> None:
    losses = {v: outcomes[v, 0]["report"]["contrastive"] for v in ("plain", "same_objects")}
    assert losses["same_objects"] < losses["plain"] - 0.05


def test_local_negatives_are_those_of_the_own_rank(shards: Path, outcomes: dict[tuple[str, int], dict]) -> None:
    config, batch = two_ranks.config_of("local"), two_ranks.global_batch(shards, "local")
    halves = [two_ranks.outcome(two_ranks.part(batch, rank, 2), config, ALONE)["report"] for rank in (0, 1)]
    expected = sum(half["contrastive"] * half["points"] for half in halves) / 19
    report = outcomes["local", 0]["report"]
    assert report["contrastive"] == pytest.approx(expected, abs=1e-5)
    assert report["contrastive"] < outcomes["plain", 0]["report"]["contrastive"]


def test_keys_are_made_in_shuffled_batches_and_come_back_in_order(
    shards: Path, outcomes: dict[tuple[str, int], dict]
) -> None:
    batch = two_ranks.global_batch(shards, "shuffled")
    order = torch.randperm(4, generator=torch.Generator().manual_seed(3))
    momentum = new_state(two_ranks.config_of("shuffled"), ALONE).momentum
    expected = torch.empty(4, 8, 8)
    for rows in order.chunk(2):  # BatchNorm in training mode: a key depends on who shares its batch
        expected[rows] = momentum.sample(momentum(batch.views.images2[rows]), batch.cells2[rows])
    for rank in (0, 1):
        torch.testing.assert_close(outcomes["shuffled", rank]["keys"], expected, atol=1e-5, rtol=1e-4)
    unshuffled = momentum_keys(momentum, batch, ALONE, shuffle_seed=3)
    assert not torch.allclose(expected, unshuffled, atol=1e-3)


def test_one_rank_asked_to_stop_stops_all(outcomes: dict[tuple[str, int], dict]) -> None:
    assert outcomes["plain", 0]["stop"] and outcomes["plain", 1]["stop"]


def test_two_ranks_train_and_one_goes_on(shards: Path, tmp_path: Path) -> None:
    settings = [
        *two_ranks.SETTINGS, "data.batch_size=4", "data.pairs_per_object=1", "data.workers=1", "schedule.epochs=3",
        "validation.every=1", "checkpoint.every=1", "log.every=1",
    ]  # fmt: skip
    arguments = [argument for value in settings for argument in ("--set", value)]
    done = torchrun(
        "-m", "cli", "train", str(shards), "--out", str(tmp_path), "--preset", "nano", *arguments,
        "--stop-after", "3",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [path.name for path in list_checkpoints(tmp_path)] == ["step-00000002.pt", "step-00000003.pt"]
    assert read_metrics(tmp_path, "start")[0]["world"] == 2
    torch.set_num_threads(1)
    validation = read_metrics(tmp_path, "validation")[1]
    network, _ = load_network(list_checkpoints(tmp_path)[0])
    held_out = PairLoader(PairDataset(shards, "val", image_size=32, max_points=8), [[0, 1, 2, 3, 4, 5]])
    alone = pck(network, held_out, points=8)
    assert validation["step"] == 2 and validation["pairs"] == 6 and validation["points"] == alone["points"]
    assert validation["pck"] == pytest.approx(alone["pck"], abs=1.5 / alone["points"])  # one tie may fall otherwise
    assert validation["mask_iou"] == pytest.approx(alone["mask_iou"], abs=0.02)  # the ranks' shares add up
    result = train(shards, tmp_path, load_config("nano", None, settings))
    assert result["status"] == "finished" and result["steps_of_this_call"] == 3
    assert [line["step"] for line in read_metrics(tmp_path, "step")] == [1, 2, 3, 4, 5, 6]
    assert load_network(tmp_path)[1]["step"] == 6


@pytest.mark.parametrize("what", ["loss", "gradient"])
def test_all_ranks_stop_together_where_one_is_not_finite(shards: Path, tmp_path: Path, what: str) -> None:
    done = torchrun(str(Path(poisoned_rank.__file__)), what, str(shards), str(tmp_path))
    assert done.returncode == 0, done.stderr
    said, kept = zip(*((tmp_path / f"said-{rank}.txt").read_text().splitlines() for rank in (0, 1)), strict=True)
    assert said[0] == said[1] and f"the {'norm of the ' * (what == 'gradient')}{what} is nan at step 2" in said[0]
    assert kept[0] == kept[1] and kept[0].startswith("True "), "the weights are those before the step, on both"
    written = json.loads((tmp_path / "not_finite-2.json").read_text())
    assert [sample["rank"] for sample in written["samples"]] == [0, 0, 1, 1]
    assert len({sample["key"] for sample in written["samples"]}) == 4
    assert all(sample["key"] in said[0] for sample in written["samples"])


def test_devices() -> None:
    assert pick_device("cpu") == torch.device("cpu")
    with pytest.raises(UsageError, match="is no device"):
        pick_device("gpu7")
    if not torch.cuda.is_available():
        assert pick_device("auto").type == "cpu"
        with pytest.raises(UsageError, match=r"there is no cuda:0: PyTorch sees 0 GPUs.*--set device=cpu"):
            pick_device("cuda")
        with pytest.raises(UsageError, match=r"^--device: there is no cuda:0.*--device cpu"):
            commands._device("cuda")
    with pytest.raises(UsageError, match=r"^--device: 'gpu7' is no device"):
        commands._device("gpu7")


def test_synchronised_batchnorm_needs_cuda() -> None:
    config = load_config("nano", None, [*two_ranks.SETTINGS, "distributed.sync_batchnorm=true"])
    with pytest.raises(UsageError, match="needs CUDA"):
        new_state(config, Ranks(0, 2, torch.device("cpu")))


def test_one_process_needs_no_group() -> None:
    with ranks_of("cpu") as ranks:
        tensor = torch.arange(4)
        assert ranks.gather(tensor) is tensor and ranks.share(tensor) is tensor
        assert ranks.collect("x") == ["x"] and ranks.is_first
