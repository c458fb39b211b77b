import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import many_ranks
import poisoned_rank
import pytest
import torch
from tiny_shards import write_shards

from dope.checkpoints import list_checkpoints, load_network, read_checkpoint
from dope.commands import options
from dope.common.errors import UsageError
from dope.config import load_config
from dope.distributed import Ranks, pick_device, ranks_of
from dope.methods import method_of
from dope.run_logging import read_metrics
from dope.state import new_state
from dope.step import momentum_keys
from dope.streaming import PairDataset, PairLoader
from dope.trainer import train
from dope.validation import pck

ALONE = Ranks(0, 1, torch.device("cpu"))
pytestmark = pytest.mark.timeout(240)


def environment() -> dict[str, str]:
    root = Path(__file__).parents[2]
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(root), "GLOO_SOCKET_IFNAME": "lo"}


def torchrun(world: int, *arguments: str) -> None:
    """So many ranks on this machine; a hanging collective ends with the time limit."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(world)]
    done = subprocess.run([*command, *arguments], env=environment(), timeout=200, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=8, pairs=2, val_objects=3, size=32, n_points=60)


@pytest.fixture(scope="module")
def outcomes(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[int, dict[str, list[dict[str, Any]]]]:
    """Of 2 and of 4 ranks: the outcomes of each variant on all ranks."""
    found = {}
    for world in (2, 4):
        out = tmp_path_factory.mktemp("outcomes")
        torchrun(world, str(Path(many_ranks.__file__)), str(shards), str(out))
        found[world] = {v: [torch.load(out / f"{v}-{r}.pt") for r in range(world)] for v in many_ranks.VARIANTS}
    return found


@pytest.mark.parametrize("world", [2, 4])
@pytest.mark.parametrize("variant", ["plain", "shuffled", "second_view", "same_objects", "micro", "synchronised"])
def test_loss_gradients_and_statistics_do_not_depend_on_the_number_of_ranks(
    shards: Path, outcomes: dict[int, dict[str, list[dict[str, Any]]]], variant: str, world: int
) -> None:
    config = many_ranks.config_of(variant)
    whole = replace(config, data=replace(config.data, micro_batch=0))
    batch = many_ranks.global_batch(shards, variant)
    alone = many_ranks.outcome(batch, whole, ALONE, training=variant == "synchronised")
    assert alone["report"]["points"] == 51
    for found in outcomes[world][variant]:
        assert found["report"] == pytest.approx(alone["report"], abs=1e-5)
        for name, gradient in alone["gradients"].items():
            assert (found["gradients"][name] - gradient).abs().max() <= 1e-5, name
        for ours, theirs in zip(found["statistics"], alone["statistics"], strict=True):
            torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0)


def test_keys_of_a_synchronised_momentum_encoder_are_those_of_one_process(
    shards: Path, outcomes: dict[int, dict[str, list[dict[str, Any]]]]
) -> None:
    batch = many_ranks.global_batch(shards, "synchronised")
    alone = many_ranks.outcome(batch, many_ranks.config_of("synchronised"), ALONE, training=True)
    for world in (2, 4):
        for found in outcomes[world]["synchronised"]:
            torch.testing.assert_close(found["keys"], alone["keys"], atol=1e-5, rtol=0)


def test_one_object_on_two_ranks_is_no_negative_of_itself(outcomes: dict[int, dict[str, Any]]) -> None:
    losses = {v: outcomes[2][v][0]["report"]["contrastive"] for v in ("plain", "same_objects")}
    assert losses["same_objects"] < losses["plain"] - 0.05


def test_local_negatives_are_those_of_the_own_rank(shards: Path, outcomes: dict[int, dict[str, Any]]) -> None:
    config, batch = many_ranks.config_of("local"), many_ranks.global_batch(shards, "local")
    halves = [many_ranks.outcome(many_ranks.sampled_part(batch, rank, 2), config, ALONE)["report"] for rank in (0, 1)]
    expected = sum(half["contrastive"] * half["points"] for half in halves) / 51
    report = outcomes[2]["local"][0]["report"]
    assert report["contrastive"] == pytest.approx(expected, abs=1e-5)
    assert report["contrastive"] < outcomes[2]["plain"][0]["report"]["contrastive"]


def test_keys_are_made_in_shuffled_batches_and_come_back_in_order(
    shards: Path, outcomes: dict[int, dict[str, Any]]
) -> None:
    batch = many_ranks.global_batch(shards, "shuffled")
    order = torch.randperm(8, generator=torch.Generator().manual_seed(3))
    momentum = new_state(method_of(many_ranks.config_of("shuffled")), ALONE).momentum
    expected = torch.empty(8, 8, 8)
    for rows in order.chunk(2):  # BatchNorm in training mode: a key depends on who shares its batch
        expected[rows] = momentum.sample(momentum(batch.views.images2[rows]), batch.cells2[rows])
    for found in outcomes[2]["shuffled"]:
        torch.testing.assert_close(found["keys"], expected, atol=1e-5, rtol=1e-4)
    unshuffled = momentum_keys(momentum, batch, ALONE, shuffle_seed=3, parts=[slice(0, 8)])
    assert not torch.allclose(expected, unshuffled, atol=1e-3)


def test_one_rank_asked_to_stop_stops_all(outcomes: dict[int, dict[str, Any]]) -> None:
    assert all(found["stop"] for world in (2, 4) for found in outcomes[world]["plain"])


def as_flags(settings: list[str]) -> list[str]:
    return [argument for value in settings for argument in ("--set", value)]


def test_a_run_of_many_ranks_is_the_run_of_one(shards: Path, tmp_path: Path) -> None:
    settings = [
        *many_ranks.SETTINGS, "data.batch_size=8", "data.pairs_per_object=1", "data.workers=0", "schedule.epochs=4",
        "validation.every=0", "checkpoint.every=0", "log.every=1", "distributed.sync_batchnorm=true",
        "augmentation.colour_p=0.5", "augmentation.flip_p=0.5", "augmentation.geometry=true",
        # AdamW's first steps turn the rounding of near-zero gradients into steps of the whole rate: so a low one
        "optimiser.lr=1e-6",
    ]  # fmt: skip
    torch.set_num_threads(1)
    train(shards, tmp_path / "1", load_config("nano", None, settings))
    losses = [line["loss"] for line in read_metrics(tmp_path / "1", "step")]
    assert len(losses) == 4
    for world in (2, 4):
        out = tmp_path / str(world)
        arguments = ["-m", "cli", "train", str(shards), "--out", str(out), "--preset", "nano", *as_flags(settings)]
        torchrun(world, *arguments)
        found = [line["loss"] for line in read_metrics(out, "step")]
        assert found == pytest.approx(losses, abs=1e-5), world


def test_two_ranks_train_and_one_goes_on(shards: Path, tmp_path: Path) -> None:
    settings = [
        *many_ranks.SETTINGS, "data.batch_size=4", "data.pairs_per_object=1", "data.workers=1", "schedule.epochs=3",
        "validation.every=1", "checkpoint.every=1", "log.every=1",
    ]  # fmt: skip
    torchrun(
        2, "-m", "cli", "train", str(shards), "--out", str(tmp_path), "--preset", "nano", *as_flags(settings),
        "--stop-after", "3",
    )  # fmt: skip
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
    torchrun(2, str(Path(poisoned_rank.__file__)), what, str(shards), str(tmp_path))
    said, kept = zip(*((tmp_path / f"said-{rank}.txt").read_text().splitlines() for rank in (0, 1)), strict=True)
    assert said[0] == said[1] and f"the {'norm of the ' * (what == 'gradient')}{what} is nan at step 2" in said[0]
    assert kept[0] == kept[1] and kept[0].startswith("True "), "the weights are those before the step, on both"
    written = json.loads((tmp_path / "not_finite-2.json").read_text())
    assert [sample["rank"] for sample in written["samples"]] == [0, 0, 1, 1]
    assert len({sample["key"] for sample in written["samples"]}) == 4
    assert all(sample["key"] in said[0] for sample in written["samples"])


def rank_processes(run: Path) -> dict[int, int]:
    """Rank -> process id of the ranks that train into `run`."""
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if str(run).encode() in (process / "cmdline").read_bytes():
                entries = (process / "environ").read_bytes().split(b"\0")
                found |= {int(entry[5:]): int(process.name) for entry in entries if entry.startswith(b"RANK=")}
        except OSError:  # gone, or not ours
            continue
    return found


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="looks for the ranks in /proc")
@pytest.mark.parametrize("launcher", ["--nproc", "torchrun"])
def test_a_killed_rank_leads_to_a_restart_that_finishes_the_job(shards: Path, tmp_path: Path, launcher: str) -> None:
    settings = [
        *many_ranks.SETTINGS, "data.batch_size=4", "data.pairs_per_object=1", "data.workers=0", "schedule.epochs=30",
        "validation.every=0", "checkpoint.every=2", "checkpoint.keep=2", "log.every=1",
    ]  # fmt: skip
    train = ["-m", "cli", "train", str(shards), "--out", str(tmp_path), "--preset", "nano"]
    train += ["--resume", "never", *as_flags(settings)]  # a restart must go on all the same
    if launcher == "--nproc":
        command = [sys.executable, *train, "--nproc", "2", "--max-restarts", "1"]
    else:
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
        command += ["--max-restarts", "1", *train]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment(), start_new_session=True)
    try:
        while process.poll() is None and not list_checkpoints(tmp_path):
            time.sleep(0.02)
        os.kill(rank_processes(tmp_path)[1], signal.SIGKILL)
        _, errors = process.communicate(timeout=240)
    finally:
        process.terminate()
    assert process.returncode == 0, errors
    starts = read_metrics(tmp_path, "start")
    assert len(starts) == 2 and starts[1]["step"] > 0 and starts[1]["resumed_from"] is not None
    assert [line["step"] for line in read_metrics(tmp_path, "step")] == list(range(1, 61))
    values = read_checkpoint(tmp_path)
    assert (values["step"], values["epoch"], values["samples_consumed"]) == (60, 30, 0)


def test_devices() -> None:
    assert pick_device("cpu") == torch.device("cpu")
    with pytest.raises(UsageError, match="is no device"):
        pick_device("gpu7")
    if not torch.cuda.is_available():
        assert pick_device("auto").type == "cpu"
        with pytest.raises(UsageError, match=r"there is no cuda:0: PyTorch sees 0 GPUs.*--set device=cpu"):
            pick_device("cuda")
        with pytest.raises(UsageError, match=r"^--device: there is no cuda:0.*--device cpu"):
            options.device_name("cuda")
    with pytest.raises(UsageError, match=r"^--device: 'gpu7' is no device"):
        options.device_name("gpu7")


def test_one_process_needs_no_group() -> None:
    with ranks_of("cpu") as ranks:
        tensor = torch.arange(4)
        assert ranks.gather(tensor) is tensor and ranks.share(tensor) is tensor
        assert ranks.collect("x") == ["x"] and ranks.is_first
