"""Encoding view 1: micro batches, precision, memory layout, compilation."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import many_ranks
import pytest
import torch
from tiny_shards import write_shards

from dope.checkpoints import load_network
from dope.common.errors import BadInput, DopeError, UsageError
from dope.config import TrainConfig, load_config
from dope.distributed import Ranks
from dope.memory import MemoryWatch
from dope.methods import method_of
from dope.networks.compiling import compiled
from dope.queries import autocast, micro_batches
from dope.run_logging import read_metrics
from dope.state import new_state, wrap
from dope.step import StepLosses, compute_losses
from dope.trainer import train

ALONE = Ranks(0, 1, torch.device("cpu"))
RUN = ["data.batch_size=4", "data.pairs_per_object=1", "data.workers=0", "validation.every=0", "log.every=1"]


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=8, pairs=2, size=32, n_points=60)


def tiny(*overrides: str) -> TrainConfig:
    return load_config("nano", None, [*many_ranks.SETTINGS, *overrides])


def stepped(shards: Path, config: TrainConfig, *, training: bool) -> tuple[Any, StepLosses]:
    """A state whose weights have their gradients, and the losses."""
    state = new_state(method_of(config), ALONE)
    online = wrap(method_of(config).online(state.network), ALONE).train(training)
    state.momentum.train(training)
    losses = compute_losses(online, state.momentum, many_ranks.global_batch(shards, "plain"), config, ALONE)
    losses.backward()
    return state, losses


@pytest.mark.parametrize("size", [1, 2, 4])
@pytest.mark.parametrize("predict_mask", ["true", "false"])
def test_micro_batches_give_the_whole_batchs_gradients(shards: Path, size: int, predict_mask: str) -> None:
    settings = [f"network.predict_mask={predict_mask}", "loss.mask_weight=0.7"]
    whole, expected = stepped(shards, tiny(*settings), training=False)
    parts, losses = stepped(shards, tiny(*settings, f"data.micro_batch={size}"), training=False)
    assert losses.report == pytest.approx(expected.report, abs=1e-5)
    for (name, ours), theirs in zip(parts.network.named_parameters(), whole.network.parameters(), strict=True):
        assert (ours.grad - theirs.grad).abs().max() <= 1e-5, name


def test_micro_batches_move_running_statistics_once(shards: Path) -> None:
    whole, _ = stepped(shards, tiny(), training=True)
    parts, _ = stepped(shards, tiny("data.micro_batch=2"), training=True)
    for ours, theirs in ((parts.network, whole.network), (parts.momentum.network, whole.momentum.network)):
        first, expected = ours.backbone.bn1, theirs.backbone.bn1
        assert first.num_batches_tracked == 1
        torch.testing.assert_close(first.running_mean, expected.running_mean)  # a mean of equal parts' means
        assert not torch.equal(first.running_mean, torch.zeros_like(first.running_mean))
        torch.testing.assert_close(first.running_var, expected.running_var, rtol=0.02, atol=0)


def test_micro_batches_train_and_hold_fewer_activations(shards: Path, tmp_path: Path) -> None:
    held = {}
    for size in (0, 2):
        out = tmp_path / str(size)
        train(shards, out, tiny(*RUN, "schedule.epochs=2", f"data.micro_batch={size}"))
        memory = read_metrics(out, "memory")
        assert [line["step"] for line in memory] == [1]  # measured in the first step alone
        held[size] = memory[0]["activations_mib"]
        assert memory[0]["peak_mib"] > held[size]
    assert 0 < held[2] < 0.7 * held[0]


def test_micro_batches_must_divide_a_ranks_share(shards: Path, tmp_path: Path) -> None:
    assert micro_batches(6, 0) == [slice(0, 6)] and micro_batches(6, 3) == [slice(0, 3), slice(3, 6)]
    with pytest.raises(UsageError, match=r"^data\.micro_batch: .*4 pairs .* micro batches of 3"):
        train(shards, tmp_path / "run", tiny(*RUN, "data.micro_batch=3"))
    assert not (tmp_path / "run").exists()


def test_the_watch_counts_what_autograd_keeps_once() -> None:
    layer = torch.nn.Linear(256, 256, bias=False)
    x = torch.rand(1024, 256, requires_grad=True)
    with MemoryWatch(layer, torch.device("cpu")) as watch:
        hidden = layer(x)  # keeps x, and the weight, which is a parameter
        (hidden * hidden.exp()).sum().backward()  # keeps hidden once, though twice in use, and its exponential
        assert watch.report()["activations_mib"] == 3.0
        layer(x).sum().backward()  # what was kept is free again: no new peak
    assert watch.report()["activations_mib"] == 3.0 and watch.report()["peak_mib"] > 10


def test_auto_is_half_precision_on_cuda_alone() -> None:
    for precision, device, half in [
        ("auto", "cpu", False), ("auto", "cuda", True), ("bf16", "cpu", True), ("fp32", "cuda", False)
    ]:  # fmt: skip
        if device == "cpu" or torch.cuda.is_available():
            with autocast(precision, torch.device(device)):
                assert torch.is_autocast_enabled(device) is half
                assert not half or torch.get_autocast_dtype(device) == torch.bfloat16


def test_half_precision_keeps_normalisation_and_losses_in_full_precision(shards: Path) -> None:
    seen: dict[str, set[torch.dtype]] = {}

    class Watch(torch.utils._python_dispatch.TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
            tensors = [t for t in torch.utils._pytree.tree_leaves(args) if isinstance(t, torch.Tensor)]
            seen.setdefault(func.overloadpacket.__name__, set()).update(t.dtype for t in tensors)
            return func(*args, **(kwargs or {}))

    config = tiny("precision=bf16")
    with Watch():
        state, losses = stepped(shards, config, training=True)
    half = torch.bfloat16
    assert half in seen["convolution"] and half in seen["addmm"]
    for name in ("linalg_vector_norm", "sigmoid", "exp_", "log", "binary_cross_entropy_with_logits", "log_sigmoid"):
        assert half not in seen.get(name, set()), name
    assert {"linalg_vector_norm", "sigmoid", "exp_", "log"} <= seen.keys()
    assert all(p.grad is not None and p.grad.dtype == torch.float32 for p in state.network.parameters())
    assert state.network.backbone.bn1.running_mean.dtype == torch.float32 and math.isfinite(losses.report["loss"])


def test_channels_last_computes_the_same_and_a_run_may_change_to_it(shards: Path, tmp_path: Path) -> None:
    plain, _ = stepped(shards, tiny("channels_last=false"), training=False)
    last, _ = stepped(shards, tiny(), training=False)
    for network in (last.network, last.momentum.network):
        weight = network.backbone.layer1[0].conv1.weight
        assert weight.is_contiguous(memory_format=torch.channels_last) and not weight.is_contiguous()
    for (name, ours), theirs in zip(last.network.named_parameters(), plain.network.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, theirs.grad, atol=1e-5, rtol=1e-4, msg=lambda m, n=name: n + m)

    config = tiny(*RUN, "schedule.epochs=3", "schedule.warmup_steps=0", "channels_last=false")
    train(shards, tmp_path / "plain", config)
    train(shards, tmp_path / "changed", config, stop_after=3)
    train(shards, tmp_path / "changed", replace(config, channels_last=True))
    losses = [[line["loss"] for line in read_metrics(tmp_path / name, "step")] for name in ("plain", "changed")]
    assert losses[1] == pytest.approx(losses[0], abs=2e-3)


def test_compiling_changes_no_key(shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = []

    def compile_(function: Any) -> Any:
        def run(images: torch.Tensor) -> Any:
            compiled.append(images.shape)
            return function(images)

        return run

    monkeypatch.setattr(torch, "compile", compile_)
    train(shards, tmp_path, tiny(*RUN, "schedule.max_steps=1", "compile=true"))
    assert compiled == [(4, 3, 32, 32)] * 2  # the momentum encoder and the online encoder
    assert set(load_network(tmp_path)[0].state_dict()) == set(new_state(method_of(tiny()), ALONE).network.state_dict())


def test_what_cannot_be_compiled_is_explained_and_other_errors_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    from torch._dynamo.exc import TorchDynamoException

    def compile_(function: Any) -> Any:
        return lambda images: (_ for _ in ()).throw(images)

    monkeypatch.setattr(torch, "compile", compile_)
    fast: Any = compiled(abs)  # type: ignore[arg-type]
    with pytest.raises(DopeError, match=r"^compile: torch.compile failed \(.*no compiler.*--set compile=false"):
        fast(TorchDynamoException("no compiler\n\nand more"))
    with pytest.raises(BadInput, match="97x97"):
        fast(BadInput("images are 97x97 px"))
