"""A run as a service: what it keeps, says, survives and refuses."""

import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tiny_runs import losses_of, tiny
from tiny_shards import write_shards

from dope import guard, trainer
from dope.augmentation import Share
from dope.checkpoints import list_checkpoints, load_network
from dope.common.errors import BadInput, DopeError, UsageError
from dope.config import TrainConfig
from dope.distributed import Ranks
from dope.methods import dope as dope_method
from dope.run_logging import SilentLog, read_metrics
from dope.state import wrap
from dope.trainer import train


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=8, pairs=3, val_objects=3, size=32, n_points=60)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def test_checkpoints_by_step_and_the_best_besides(shards: Path, tmp_path: Path) -> None:
    settings = ["checkpoint.every_steps=2", "checkpoint.keep=1", "checkpoint.keep_best=true", "schedule.epochs=6"]
    train(shards, tmp_path, tiny(*settings, "data.batch_size=2"))
    measured = {line["step"]: line["pck"] for line in read_metrics(tmp_path, "validation") if line["step"]}
    best = max(measured, key=lambda step: (measured[step], -step))
    events = read_metrics(tmp_path, "checkpoint")
    assert {line["step"] for line in events} == set(range(2, 25, 2))  # four steps an epoch: validations are among them
    assert best == [line["step"] for line in events if line["best"]][-1] < 24, "else nothing is shown"
    assert [path.name for path in list_checkpoints(tmp_path)] == [f"step-{best:08d}.pt", "step-00000024.pt"]
    assert load_network(tmp_path / "checkpoints/best")[1]["validation"]["pck"] == measured[best]


def test_a_new_best_is_written_though_no_checkpoint_is_due(shards: Path, tmp_path: Path) -> None:
    train(shards, tmp_path, tiny("checkpoint.keep_best=true", "schedule.epochs=1", "checkpoint.every=0"))
    assert [line["best"] for line in read_metrics(tmp_path, "checkpoint")] == [True]
    settings = ["checkpoint.keep_best=true", "checkpoint.keep=1", "schedule.epochs=2"]
    train(shards, tmp_path / "two", tiny(*settings), stop_after=3)
    assert [line["step"] for line in read_metrics(tmp_path / "two", "checkpoint")] == [2, 3]


def test_a_damaged_newest_checkpoint_is_passed_over_loudly(
    shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, run = tiny("validation.every=0", "checkpoint.every=1", "checkpoint.keep=0"), tmp_path / "run"
    train(shards, tmp_path / "whole", config)
    train(shards, run, config, stop_after=4)
    damaged = list_checkpoints(run)[-1]
    damaged.write_bytes(damaged.read_bytes()[:5000])
    capsys.readouterr()
    assert train(shards, run, config)["steps_of_this_call"] == 4
    said = capsys.readouterr().err
    assert f"WARNING: {damaged}: is damaged" in said and f"from an older one, {list_checkpoints(run)[0]}" in said
    (event,) = read_metrics(run, "damaged_checkpoint")
    assert event["file"] == str(damaged) and event["step"] == 2 and "SHA-256" in event["reason"]
    assert losses_of(run) == losses_of(tmp_path / "whole")
    for path in list_checkpoints(run):
        path.write_bytes(b"")
    with pytest.raises(BadInput, match="no older one can be read either"):
        train(shards, run, config)


def test_what_a_killed_run_left_half_written_is_cleared(shards: Path, tmp_path: Path) -> None:
    train(shards, tmp_path, tiny("validation.every=0"), stop_after=1)
    (tmp_path / "checkpoints/.step-00000002.99.partial.pt").write_bytes(b"half")
    train(shards, tmp_path, tiny("validation.every=0"))
    assert not [path for path in tmp_path.rglob("*") if "partial" in path.name]


def test_steps_say_how_fast_they_are_and_how_long_they_wait(shards: Path, tmp_path: Path) -> None:
    train(shards, tmp_path, tiny("validation.every=0", "schedule.epochs=2"))
    lines = read_metrics(tmp_path, "step")
    assert all(0 < line["data_wait"] < 1 and line["pairs_per_second"] > 0 and line["lr"] > 0 for line in lines)


def test_a_run_says_what_it_trains_on_and_where_it_goes_on(
    shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(shards, tmp_path, tiny("validation.every=0"), stop_after=3)
    said = capsys.readouterr().err
    assert "training dope on 24 pairs of 8 objects: 4 pairs a step, 2 steps an epoch, 6 in all\n" in said
    assert "M parameters, fp32, cpu\n" in said and "going on" not in said
    train(shards, tmp_path, tiny("validation.every=0"))
    assert f"going on at step 3 from {tmp_path}/checkpoints/step-00000003.pt\n" in capsys.readouterr().err
    first, second = read_metrics(tmp_path, "start")
    assert (first["objects"], first["total_steps"], first["resumed_from"]) == (8, 6, None)
    assert first["parameters"] > 1000 and second["resumed_at"] == 3


def test_validations_leave_pictures(shards: Path, tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for pictures in (2, 0):
        train(shards, tmp_path / str(pictures), tiny("schedule.epochs=1", f"log.pictures={pictures}"))
        board = EventAccumulator(str(tmp_path / str(pictures) / "tensorboard"))
        board.Reload()
        assert board.Tags()["images"] == (["validation/pairs"] if pictures else [])
        if pictures:
            assert [shown.step for shown in board.Images("validation/pairs")] == [0, 2]


def test_pictures_change_nothing_that_is_learnt(shards: Path, tmp_path: Path) -> None:
    for pictures in (0, 2):
        train(shards, tmp_path / str(pictures), tiny(f"log.pictures={pictures}"))
    assert losses_of(tmp_path / "0") == losses_of(tmp_path / "2")


def test_wandb_must_be_installed_before_anything_is_written(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(UsageError, match=r"log\.wandb"):
        train(shards, tmp_path / "run", tiny("log.wandb=mugs"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("last", [None, 4])
def test_profiled_steps_are_in_the_trace_and_training_goes_on(
    shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], last: int | None
) -> None:
    train(shards, tmp_path / "plain", tiny("validation.every=0"))
    capsys.readouterr()
    result = train(shards, tmp_path / "run", tiny("validation.every=0"), profile=3, stop_after=last)
    assert result["step"] == (last or 6)
    assert losses_of(tmp_path / "run") == losses_of(tmp_path / "plain")[: result["step"]]
    trace = json.loads((tmp_path / "run/profile/trace.json").read_text())["traceEvents"]
    steps = {event["name"] for event in trace if event["name"].startswith("ProfilerStep#")}
    # the two that warm up are left out; a run that ends earlier writes what it has
    assert {f"ProfilerStep#{n}" for n in ((2, 3, 4) if last is None else (2, 3))} <= steps
    assert not {"ProfilerStep#0", "ProfilerStep#1", "ProfilerStep#5"} & steps
    assert sum("convolution" in event["name"] for event in trace) > 10
    said = capsys.readouterr().err
    assert "slowest operators, CPU time" in said and " x  aten::" in said and "profile/trace.json" in said


def test_a_run_too_short_to_be_profiled_says_so(
    shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(shards, tmp_path, tiny("validation.every=0"), profile=3, stop_after=1)
    assert "no trace was written" in capsys.readouterr().err and not (tmp_path / "profile").exists()
    (tmp_path / "profile").mkdir()
    (tmp_path / "profile/trace.json").write_text("of another call")
    train(shards, tmp_path, tiny("validation.every=0"), profile=3, stop_after=1)
    assert "no trace was written" in capsys.readouterr().err


def test_a_loss_that_is_not_finite_stops_with_step_and_samples(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = dope_method.sample_batch

    def poisoned(batch: Any, config: TrainConfig, step: int, share: Share) -> object:
        sampled = real(batch, config, step, share)
        if step == 2:
            sampled.views.images1[0, 0, 0, 0] = float("nan")
        return sampled

    monkeypatch.setattr(dope_method, "sample_batch", poisoned)
    with pytest.raises(DopeError, match=r"the loss is nan at step 2 .*object_00\d-000\d") as caught:
        train(shards, tmp_path, tiny("validation.every=0"))
    assert "into another --out with a lower --set optimiser.lr" in str(caught.value)
    assert "not_finite-2.json" in str(caught.value)
    line = read_metrics(tmp_path, "not_finite")[0]
    assert line["step"] == 2 and len(line["keys"]) == 4
    written = json.loads((tmp_path / "not_finite-2.json").read_text())
    assert (written["not_finite"], written["values"]["loss"], written["epoch"]) == ("loss", "nan", 1)
    assert [sample["key"] for sample in written["samples"]] == line["keys"]
    assert all(sample["key"].startswith(sample["sequence"] + "-") for sample in written["samples"])


def test_samples_in_place_of_damaged_ones_are_not_named(tmp_path: Path) -> None:
    index = SimpleNamespace(objects=np.array([5]), sequences=np.array(["mug"]))
    state = SimpleNamespace(step=1, place=SimpleNamespace(epoch=0))
    run: Any = SimpleNamespace(state=state, dataset=SimpleNamespace(index=index), out=tmp_path)
    run.ranks = SimpleNamespace(rank=0, is_first=True, collect=lambda mine: [mine])
    damaged = {0: None, 1: None}
    batch: Any = SimpleNamespace(keys=("", "a"), objects=torch.tensor([-1, 5]), damaged=damaged)
    for keys in ([], ["a"]):
        with pytest.raises(DopeError, match="the loss is nan"):
            guard.require_finite(run, {"loss": math.nan, "grad_norm": 0.0}, batch, SilentLog())
        samples = json.loads((tmp_path / "not_finite-1.json").read_text())["samples"]
        assert [sample["key"] for sample in samples] == keys
        damaged.pop(1, None)


def test_a_gradient_that_is_not_finite_stops_before_it_reaches_the_weights(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loss is finite; only the way back is not."""
    networks: list[torch.nn.Module] = []
    before: dict[str, torch.Tensor] = {}

    def overflowing(gradient: torch.Tensor) -> torch.Tensor:
        weights = {name: p.detach().clone() for name, p in networks[0].named_parameters()}
        if before and any(not torch.equal(weights[name], before[name]) for name in before):
            networks.append(networks[0])  # a step later: counts the steps
        before.update(weights)
        return gradient if len(networks) < 3 else gradient * float("inf")

    def hooked(network: torch.nn.Module, ranks: Ranks) -> torch.nn.Module:
        networks.append(network)
        next(network.parameters()).register_hook(overflowing)
        return wrap(network, ranks)

    monkeypatch.setattr(trainer, "wrap", hooked)
    with pytest.raises(DopeError, match=r"the norm of the gradient is (inf|nan) at step 2 \(loss \d.*object_00"):
        train(shards, tmp_path, tiny("validation.every=0"))
    assert all(torch.equal(p, before[name]) for name, p in networks[0].named_parameters())
    assert json.loads((tmp_path / "not_finite-2.json").read_text())["not_finite"] == "grad_norm"
    norms = [line["grad_norm"] for line in read_metrics(tmp_path, "step")]
    assert len(norms) == 2 and all(norm > 0 for norm in norms)


def test_the_gradient_norm_is_that_of_all_gradients_together_and_changes_none() -> None:
    parameters = [torch.nn.Parameter(torch.zeros(n)) for n in (2, 1, 5)]
    parameters[0].grad, parameters[1].grad = torch.tensor([1.0, 2.0]), torch.tensor([2.0])  # the last has none
    assert guard.gradient_norm(parameters) == pytest.approx(3.0)
    assert parameters[0].grad.tolist() == [1.0, 2.0] and parameters[2].grad is None
