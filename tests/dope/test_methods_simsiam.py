"""VISPE++ with SimSiam: the loss against a loop, the stop of the gradient, the predictor's rate, what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from tiny_drawn import draw_pairs
from tiny_method_runs import better_than_chance, same_after_a_stop, tiny_method
from tiny_shards import write_shards
from torch import Tensor, nn

from dope.common.errors import UsageError
from dope.config import load_config
from dope.distributed import Ranks
from dope.methods import method_of
from dope.methods.configs import SimSiamConfig
from dope.methods.queue import spread
from dope.methods.vispe_simsiam import SimSiamNetwork, negative_cosine
from dope.state import highest_rate, learning_rate, new_state, set_learning_rate
from dope.trainer import train

ALONE = Ranks(0, 1, torch.device("cpu"))


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=8, pairs=3, val_objects=3, size=32, n_points=10)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def some(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_loss_is_that_of_a_loop_and_only_predictions_have_gradient() -> None:
    p, z = some(5, 7).requires_grad_(), some(5, 7, seed=1).requires_grad_()
    expected = 0.0
    for a, b in zip(p.tolist(), z.tolist(), strict=True):
        dot = sum(x * y for x, y in zip(a, b, strict=True))
        expected -= dot / math.hypot(*a) / math.hypot(*b) / 5
    loss = negative_cosine(p, z)
    assert loss.item() == pytest.approx(expected, abs=1e-12)
    loss.backward()
    assert z.grad is None and p.grad is not None and (p.grad.abs().sum(1) > 0).all()


def test_a_step_predicts_each_view_from_the_other_without_gradient_to_the_predicted(shards: Path) -> None:
    method = method_of(tiny_method("vispe_simsiam"))
    dataset, state = method.dataset(shards, "train"), new_state(method, ALONE)
    network = state.network.eval()
    assert isinstance(network, SimSiamNetwork)
    batch = method.prepare(dataset.batch([0, 1, 2, 3]), 0)
    losses = method.losses(method.online(network), state.momentum, batch, ALONE)
    losses.backward()
    found = {name: p.grad.clone() for name, p in network.named_parameters() if p.grad is not None}
    assert found.keys() == dict(network.named_parameters()).keys()

    network.zero_grad()
    (_, p1), (_, p2) = network(batch.images1), network(batch.images2)
    with torch.no_grad():
        (target1, _), (target2, _) = network(batch.images1), network(batch.images2)
    loss = -(F.cosine_similarity(p1, target2) + F.cosine_similarity(p2, target1)).mean() / 2
    assert losses.report["loss"] == pytest.approx(loss.item(), abs=1e-6)
    loss.backward()
    for name, p in network.named_parameters():
        torch.testing.assert_close(found[name], p.grad, atol=1e-6, rtol=1e-4, msg=name)


def test_the_network_is_simsiams() -> None:
    network = SimSiamNetwork(1.0, SimSiamConfig())
    linear = [m for m in network.modules() if isinstance(m, nn.Linear)]
    shapes = [(m.in_features, m.out_features, m.bias is not None) for m in linear]
    three = [(512, 2048, False), (2048, 2048, False), (2048, 2048, False)]
    assert shapes == [*three, (2048, 512, False), (512, 2048, True)]
    norms = [m for m in network.modules() if isinstance(m, nn.BatchNorm1d)]
    assert [(m.num_features, m.affine) for m in norms] == [(2048, True), (2048, True), (2048, False), (512, True)]
    kinds = [type(m).__name__ for m in (*network.projector, *network.predictor)]
    block = ["Linear", "BatchNorm1d", "ReLU"]
    assert kinds == [*block, *block, "Linear", "BatchNorm1d", *block, "Linear"]


@pytest.mark.parametrize("constant", [True, False])
def test_the_predictor_keeps_its_learning_rate(constant: bool) -> None:
    config = tiny_method("vispe_simsiam", f"simsiam.constant_predictor_lr={constant}", "schedule.warmup_steps=0")
    state = new_state(method_of(config), ALONE)
    late = learning_rate(config, 4, 2)  # of three epochs of two steps
    set_learning_rate(state.optimiser, late, config.optimiser.lr)
    assert isinstance(state.network, SimSiamNetwork) and late < config.optimiser.lr
    rates = {id(p): group["lr"] for group in state.optimiser.param_groups for p in group["params"]}
    assert len(rates) == len(list(state.network.parameters())), "each weight once"
    predictor = {rates[id(p)] for p in state.network.predictor.parameters()}
    others = {rates[id(p)] for part in (state.network.encoder, state.network.projector) for p in part.parameters()}
    assert predictor == ({config.optimiser.lr} if constant else others)
    assert others == {late}
    assert isinstance(state.optimiser, torch.optim.SGD)


def test_spread_tells_collapse() -> None:
    assert spread(torch.ones(8, 16)).item() == 0
    assert spread(torch.randn(4096, 64, generator=torch.Generator().manual_seed(0))).item() == pytest.approx(
        1, abs=0.02
    )


def test_one_pair_a_rank_is_refused(shards: Path) -> None:
    method = method_of(tiny_method("vispe_simsiam"))
    dataset, state = method.dataset(shards, "train"), new_state(method, ALONE)
    batch = method.prepare(dataset.batch([0]), 0)
    with pytest.raises(UsageError, match=r"^data.batch_size: leaves one pair .*sync_batchnorm"):
        method.losses(method.online(state.network), state.momentum, batch, ALONE)


def test_one_held_out_pair_left_over_is_validated(shards: Path, tmp_path: Path) -> None:
    settings = ["validation.batch_size=5", "schedule.epochs=1"]  # of 6 pairs the last batch has one
    result = train(shards, tmp_path, tiny_method("vispe_simsiam", *settings))
    assert result["status"] == "finished" and 0 <= result["score"] <= 1 and 0 <= result["score_untrained"] <= 1


def test_what_evaluation_sees_is_the_encoder() -> None:
    method = method_of(tiny_method("vispe_simsiam"))
    network = new_state(method, ALONE).network.eval()
    embedder, images = method.embedder(network), torch.rand(2, 3, 32, 32)
    assert (embedder.name, embedder.own_classifier) == ("vispe_simsiam", "nearest")
    torch.testing.assert_close(embedder.pooled(images), network.encoder(images))


def test_presets_are_the_papers() -> None:
    config = load_config("paper_co3d", method="vispe_simsiam")
    assert (config.optimiser.name, config.optimiser.lr, config.optimiser.momentum) == ("sgd", 0.05, 0.9)
    assert (config.optimiser.weight_decay, config.data.batch_size, config.schedule.shape) == (1e-4, 256, "cosine")
    colours = config.augmentation
    assert (colours.colour_p, colours.jitter_p, colours.grey_p, colours.blur_p, colours.flip_p) == (
        0,
        0.8,
        0.2,
        0.5,
        0.5,
    )
    assert colours.jitter == (0.4, 0.4, 0.4, 0.1) and colours.background_removal == "paired"
    assert (config.simsiam.projector, config.simsiam.predictor) == (2048, 512)


def test_the_rate_goes_with_the_batch() -> None:
    for batch, rate in ((256, 0.05), (512, 0.1), (64, 0.0125)):
        config = load_config("paper", None, [f"data.batch_size={batch}"], method="vispe_simsiam")
        assert highest_rate(config) == learning_rate(config, 0, 10) == pytest.approx(rate)
    assert highest_rate(load_config("paper", None, ["data.batch_size=64"])) == 1e-4, "only where it is asked for"
    with pytest.raises(UsageError, match=r"optimiser\.lr_batch: .*must not be negative"):
        load_config("paper", None, ["optimiser.lr_batch=-1"])


def test_a_run_that_was_stopped_ends_with_the_same_weights(shards: Path, tmp_path: Path) -> None:
    same_after_a_stop(shards, tmp_path, tiny_method("vispe_simsiam"))


@pytest.mark.timeout(240)
def test_it_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shards = draw_pairs(tmp_path / "shards", monkeypatch, objects=64, held_out=64)
    better_than_chance(shards, tmp_path / "run", "vispe_simsiam")
