import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from tiny_runs import TINY, losses_of, tiny
from tiny_shards import write_shards

from dope.checkpoints import list_checkpoints, load_network
from dope.common.errors import BadInput, UsageError
from dope.config import load_config
from dope.methods import dope as dope_method
from dope.run_logging import read_metrics
from dope.state import learning_rate
from dope.step import StepLosses
from dope.trainer import train


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=8, pairs=3, val_objects=3, size=32, n_points=60)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def test_a_run_leaves_all_that_it_promises(shards: Path, tmp_path: Path) -> None:
    result = train(shards, tmp_path / "run", tiny("checkpoint.every=1", "checkpoint.keep=2"))
    assert (result["status"], result["step"], result["epoch"]) == ("finished", 6, 3)
    run = tmp_path / "run"
    assert [path.name for path in list_checkpoints(run)] == ["step-00000004.pt", "step-00000006.pt"]
    assert result["checkpoint"] == str(list_checkpoints(run)[-1])
    assert [line["step"] for line in read_metrics(run, "step")] == [1, 2, 3, 4, 5, 6]
    validations = read_metrics(run, "validation")
    assert [line["step"] for line in validations] == [0, 2, 4, 6]  # the untrained network first
    assert validations[0]["pck"] == result["pck_untrained"] and validations[-1]["pck"] == result["pck"]
    assert validations[0]["pairs"] == 6 and validations[0]["points"] <= 48
    assert list((run / "tensorboard").iterdir())
    text = (run / "config.yaml").read_text()
    assert load_config(None, run / "config.yaml") == tiny("checkpoint.every=1", "checkpoint.keep=2")
    assert text.startswith("# hash ") and yaml.safe_load(text)["seed"] == 12345
    assert load_network(run)[1]["step"] == 6


def test_stopping_and_going_on_is_bitwise_the_same(shards: Path, tmp_path: Path) -> None:
    config = tiny("validation.every=0")
    whole = train(shards, tmp_path / "whole", config)
    first = train(shards, tmp_path / "parts", config, stop_after=3)
    assert (first["status"], first["step"], first["epoch"]) == ("stopped", 3, 1)
    # settings that do not change the result may differ
    second = train(shards, tmp_path / "parts", replace(config, data=replace(config.data, workers=1)))
    assert second["status"] == "finished" and whole["loss"] == second["loss"]
    assert losses_of(tmp_path / "whole") == losses_of(tmp_path / "parts")
    ours, theirs = (load_network(tmp_path / name)[0].state_dict() for name in ("whole", "parts"))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_a_signal_within_a_step_ends_the_run_after_this_very_step(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = dope_method.compute_losses

    def signalled(*arguments: Any, **options: Any) -> StepLosses:
        os.kill(os.getpid(), signal.SIGUSR1)
        return real(*arguments, **options)

    monkeypatch.setattr(dope_method, "compute_losses", signalled)
    assert train(shards, tmp_path, tiny("validation.every=0"))["step"] == 1


def test_max_steps_ends_a_run(shards: Path, tmp_path: Path) -> None:
    result = train(shards, tmp_path, tiny("schedule.max_steps=3"))
    assert (result["status"], result["step"], result["epoch"]) == ("finished", 3, 1)
    assert [line["step"] for line in read_metrics(tmp_path, "validation")] == [0, 2, 3]


def test_another_seed_gives_another_run(shards: Path, tmp_path: Path) -> None:
    for seed in (1, 2):
        train(shards, tmp_path / str(seed), tiny(f"seed={seed}", "schedule.epochs=1", "validation.every=0"))
    assert losses_of(tmp_path / "1") != losses_of(tmp_path / "2")


def test_lines_after_the_checkpoint_are_forgotten_when_a_killed_run_goes_on(shards: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(shards, run, tiny("validation.every=0"), stop_after=2)
    with (run / "metrics.jsonl").open("a") as file:  # as a run killed between two checkpoints leaves it
        file.write(json.dumps({"event": "step", "step": 3, "epoch": 1, "loss": -1.0}) + '\n{"event": "st')
    train(shards, run, tiny("validation.every=0"))
    lines = read_metrics(run, "step")
    assert [line["step"] for line in lines] == [1, 2, 3, 4, 5, 6]
    assert all(line["loss"] > 0 for line in lines)


def test_a_finished_run_has_nothing_to_do(shards: Path, tmp_path: Path) -> None:
    train(shards, tmp_path, tiny("schedule.epochs=1"))
    again = train(shards, tmp_path, tiny("schedule.epochs=1"))
    assert again["status"] == "finished" and again["steps_of_this_call"] == 0 and again["pck"] is not None
    assert again["loss"] is None  # and no "loss nan" is printed


def test_resume_never_insists_on_a_new_folder(shards: Path, tmp_path: Path) -> None:
    train(shards, tmp_path, tiny("schedule.epochs=1", "validation.every=0"))
    with pytest.raises(UsageError, match=r"already holds a run .*--out"):
        train(shards, tmp_path, tiny(), resume="never")


def test_resuming_with_other_settings_names_them(shards: Path, tmp_path: Path) -> None:
    train(shards, tmp_path, tiny("validation.every=0"), stop_after=1)
    with pytest.raises(UsageError, match=r"optimiser\.lr is 0\.5, was 0\.001"):
        train(shards, tmp_path, tiny("optimiser.lr=0.5"))


def test_resume_from_a_given_checkpoint_of_another_folder(shards: Path, tmp_path: Path) -> None:
    config = tiny("validation.every=0")
    train(shards, tmp_path / "a", config, stop_after=2)
    result = train(shards, tmp_path / "b", config, resume=str(list_checkpoints(tmp_path / "a")[0]))
    assert result["steps_of_this_call"] == 4
    with pytest.raises(BadInput, match="no such file"):
        train(shards, tmp_path / "c", config, resume=tmp_path / "none.pt")


def test_without_held_out_pairs_nothing_is_validated(tmp_path: Path) -> None:
    shards = write_shards(tmp_path / "shards", n_objects=4, pairs=1, size=32)
    result = train(shards, tmp_path / "run", tiny("schedule.epochs=1"))
    assert result["pck"] is None and read_metrics(tmp_path / "run", "validation") == []


def test_too_few_objects_for_a_batch_name_the_setting(shards: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"data\.batch_size"):
        train(shards, tmp_path, tiny("data.batch_size=64"))


def test_damaged_shards_stop_before_the_first_step(shards: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(shards, tmp_path / "copy"))
    os.truncate(copy / "train-000001.tar", 3000)
    with pytest.raises(BadInput, match=r"train-000001\.tar: is cut off"):
        train(copy, tmp_path / "run", tiny())
    assert not (tmp_path / "run").exists()


def test_the_momentum_encoder_follows_after_the_step(shards: Path, tmp_path: Path) -> None:
    train(shards, tmp_path, tiny("schedule.epochs=1", "validation.every=0", "momentum=0.0"))
    values = torch.load(list_checkpoints(tmp_path)[0], weights_only=True)
    for name, value in values["network"].items():
        if "running" not in name and "num_batches" not in name:
            assert torch.allclose(value, values["momentum"][name], atol=1e-7), name


def test_learning_rates() -> None:
    paper = load_config("paper")
    rates = [learning_rate(paper, step, 10) for step in range(30_000)]
    assert rates[0] == rates[9] == 1e-4 and rates[10] < rates[9]  # stepped once an epoch
    assert rates[15_000] == pytest.approx(0.5e-4) and 0 < rates[-1] < 1e-9
    config = load_config("nano", None, ["schedule.warmup_steps=4", "schedule.epochs=2", "optimiser.lr=1.0"])
    rates = [learning_rate(config, step, 12) for step in range(24)]
    assert rates[:4] == pytest.approx([0.2, 0.4, 0.6, 0.8]) and rates[4] == 1.0
    assert rates[14] == pytest.approx(0.5) and rates[4:] == sorted(rates[4:], reverse=True)
    short = load_config("nano", None, ["schedule.warmup_steps=0", "schedule.max_steps=20", "schedule.epochs=99"])
    assert learning_rate(short, 10, 12) == pytest.approx(short.optimiser.lr / 2)
    constant = load_config("nano", None, ["schedule.shape=constant", "schedule.warmup_steps=0"])
    assert {learning_rate(constant, step, 12) for step in range(99)} == {constant.optimiser.lr}


@pytest.mark.timeout(180)
@pytest.mark.parametrize(
    ("number", "processes"),
    [(signal.SIGTERM, 1), (signal.SIGINT, 1), (signal.SIGINT, 2), (signal.SIGUSR1, 1), (signal.SIGUSR1, 2)],
)
def test_a_signal_writes_a_checkpoint_and_exits_with_75(
    shards: Path, tmp_path: Path, number: int, processes: int
) -> None:
    arguments = [
        argument for value in [*TINY, "schedule.epochs=100000", "data.workers=1"] for argument in ("--set", value)
    ]
    command = [sys.executable, "-m", "cli", "train", str(shards), "--out", str(tmp_path), "--preset", "nano"]
    process = subprocess.Popen(
        [*command, "--nproc", str(processes), *arguments],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=environment(),
    )
    try:
        for _ in range(600):
            if len(read_metrics(tmp_path, "step")) > 2 or process.poll() is not None:
                break
            time.sleep(0.1)
        job = descendants(process.pid)
        if number == signal.SIGUSR1:  # Slurm sends it to every process of the job, the loader's workers included
            for pid in (process.pid, *job):
                os.kill(pid, number)
        else:
            os.killpg(process.pid, number)  # to the loader's workers too, as a batch system does
        process.wait(timeout=60)
        left = [pid for pid in job if is_training(pid)]
        errors = process.communicate()[1]
    finally:
        process.terminate()
    assert process.returncode == 75, errors
    assert not left, "it ended before the ranks had done so, perhaps before the checkpoint was written"
    assert "Traceback" not in errors
    steps = [line["step"] for line in read_metrics(tmp_path, "step")]
    assert [path.name for path in list_checkpoints(tmp_path)] == [f"step-{steps[-1]:08d}.pt"]
    assert load_network(tmp_path)[1]["step"] == steps[-1]


@pytest.mark.timeout(180)
def test_it_learns(tmp_path: Path) -> None:
    shards = write_shards(tmp_path / "shards", n_objects=16, pairs=8, val_objects=8, size=64)
    settings = [
        "network.width=0.25", "network.pyramid=32", "network.projector=[64, 32]", "data.image_size=64",
        "data.points=16", "data.batch_size=16", "data.workers=0", "schedule.epochs=15", "validation.every=0",
        "checkpoint.every=0", "log.every=1", "optimiser.lr=3e-3", "device=cpu", "validation.every=100",
        "augmentation.colour_p=0.2", "augmentation.geometry=false",
    ]  # fmt: skip
    result = train(shards, tmp_path / "run", load_config("nano", None, settings))
    losses = losses_of(tmp_path / "run")
    assert sum(losses[-10:]) < 0.85 * sum(losses[:10])
    assert result["pck"] > 3 * result["pck_untrained"] and result["pck"] > 0.05


def descendants(pid: int) -> list[int]:
    """The processes that a process started, those that they started, and so on."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # ended meanwhile
            children.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(int(stat.parent.name))
    found = list(children.get(pid, ()))
    for child in found:
        found += children.get(child, ())
    return found


def is_training(pid: int) -> bool:
    """Whether a process of `dope train` still runs; zombies do not count."""
    with contextlib.suppress(OSError):
        zombie = (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] == "Z"
        return not zombie and b"cli.py\0train\0" in (Path("/proc") / str(pid) / "cmdline").read_bytes()
    return False


def environment() -> dict[str, str]:
    root = str(Path(__file__).parents[2])
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": root, "GLOO_SOCKET_IFNAME": "lo"}
