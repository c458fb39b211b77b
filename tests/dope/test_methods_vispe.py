"""VISPE: the loss against a loop, which pairs are contrasted, and that gradients flow to both views."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from tiny_drawn import draw_pairs
from tiny_method_runs import better_than_chance, same_after_a_stop, tiny_method
from tiny_shards import write_shards
from torch import Tensor

from dope.batch import DamagedSample
from dope.common.errors import UsageError
from dope.config import load_config
from dope.distributed import Ranks
from dope.methods import method_of
from dope.methods.vispe import vispe_losses
from dope.state import new_state

ALONE = Ranks(0, 1, torch.device("cpu"))


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=8, pairs=3, val_objects=3, size=32, n_points=10)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def units(*shape: int, seed: int = 0) -> Tensor:
    values = torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return F.normalize(values, dim=-1)


def by_loop(first: Tensor, second: Tensor, objects: list[int], temperature: float) -> tuple[float, float]:
    n, likelihood, divergence = len(first), 0.0, 0.0
    for i in range(n):
        columns = [j for j in range(n) if j == i or objects[j] != objects[i]]
        across = {j: math.exp(float(first[i] @ second[j]) / temperature) for j in columns}
        within = {j: math.exp(float((first if j == i else second)[i] @ second[j]) / temperature) for j in columns}
        p1 = {j: across[j] / sum(across.values()) for j in columns}
        p2 = {j: within[j] / sum(within.values()) for j in columns}
        likelihood -= (math.log(p1[i]) + math.log(p2[i])) / n
        divergence += sum(p2[j] * math.log(p2[j] / p1[j]) for j in columns) / n
    return likelihood, divergence


@pytest.mark.parametrize("objects", [[0, 1, 2, 3, 4, 5], [0, 1, 0, 2, 1, 0]])
def test_the_losses_are_those_of_a_loop(objects: list[int]) -> None:
    first, second, numbers = units(6, 5), units(6, 5, seed=1), torch.tensor(objects)
    expected = by_loop(first, second, objects, 0.3)
    found = vispe_losses(first, second, torch.arange(6), second, numbers, 0.3)
    assert [value.item() for value in found] == pytest.approx(expected, abs=1e-12)
    # the parts of the batch that two ranks hold
    halves = [
        vispe_losses(first[r], second[r], torch.arange(6)[r], second, numbers, 0.3) for r in (slice(3), slice(3, 6))
    ]
    assert [sum(h[k].item() for h in halves) / 2 for k in (0, 1)] == pytest.approx(expected, abs=1e-12)


def test_a_share_of_one_object_has_no_loss_and_no_nan() -> None:
    first, second = units(3, 5).requires_grad_(), units(3, 5, seed=1).requires_grad_()
    losses = vispe_losses(first, second, torch.arange(3), second, torch.full((3,), -1), 0.05)
    assert [value.item() for value in losses] == [0, 0]
    sum(losses).backward()  # type: ignore[union-attr]
    assert (first.grad == 0).all() and (second.grad == 0).all()  # type: ignore[union-attr]


def test_gradients_reach_both_views_and_the_other_pairs() -> None:
    first, second = units(4, 5).requires_grad_(), units(4, 5, seed=1).requires_grad_()
    likelihood, divergence = vispe_losses(first, second, torch.arange(4), second, torch.arange(4), 0.5)
    for part in (likelihood, divergence):
        a, b = torch.autograd.grad(part, [first, second], retain_graph=True)
        assert (a.abs().sum(1) > 1e-4).all() and (b.abs().sum(1) > 1e-4).all()
    function = lambda a, b: vispe_losses(a, b, torch.arange(4), b, torch.tensor([0, 1, 0, 2]), 0.5)  # noqa: E731
    assert torch.autograd.gradcheck(function, (first, second))


def test_the_total_weighs_the_divergence_with_alpha(shards: Path) -> None:
    method = method_of(tiny_method("vispe", "vispe.alpha=5"))
    dataset, state = method.dataset(shards, "train"), new_state(method, ALONE)
    report = method.losses(
        method.online(state.network), state.momentum, method.prepare(dataset.batch([0, 1, 2, 3]), 0), ALONE
    ).report
    assert report["loss"] == pytest.approx(report["likelihood"] + 5 * report["divergence"], rel=1e-6)
    assert report["divergence"] > 0


def test_pairs_of_few_correspondences_are_learnt_from_as_well(tmp_path: Path) -> None:
    shards = write_shards(tmp_path, n_objects=4, pairs=1, size=32, n_points=0)
    assert len(method_of(tiny_method("vispe", "data.min_correspondences=5")).dataset(shards, "train")) == 4


def test_views_change_places_and_one_view_may_be_both(shards: Path) -> None:
    plain = [f"augmentation.{name}" for name in ("colour_p=0", "flip_p=0", "background_removal=off")]
    method, twice = (method_of(tiny_method("vispe", *plain, *more)) for more in ([], ["pairs=one_view_twice"]))
    loaded = method.dataset(shards, "train").batch(list(range(8)))
    batch, again, same = method.prepare(loaded, 3), method.prepare(loaded, 3), twice.prepare(loaded, 3)
    first = [torch.equal(a, b.float() / 255) for a, b in zip(batch.images1, loaded.images1, strict=True)]
    second = [torch.equal(a, b.float() / 255) for a, b in zip(batch.images1, loaded.images2, strict=True)]
    assert [a != b for a, b in zip(first, second, strict=True)] == [True] * 8 and any(first) and any(second)
    assert torch.equal(batch.images1, again.images1)
    assert torch.equal(same.images1, same.images2) and torch.equal(same.images1, batch.images1)


def test_a_damaged_sample_is_no_negative_of_the_one_that_fills_its_place(shards: Path) -> None:
    method = method_of(tiny_method("vispe"))
    batch = method.dataset(shards, "train").batch([0, 1, 2, 3])
    for name in ("images1", "images2", "masks1", "masks2", "objects"):
        getattr(batch, name)[3] = getattr(batch, name)[0]
    batch = replace(batch, damaged={3: DamagedSample("shard", "key", "why")})
    state = new_state(method, ALONE)
    state.network.eval()
    online = method.online(state.network)
    report = method.losses(online, state.momentum, method.prepare(batch, 0), ALONE).report
    alone = replace(batch, objects=torch.arange(4))
    contrasted = method.losses(online, state.momentum, method.prepare(alone, 0), ALONE).report
    assert report["likelihood"] < contrasted["likelihood"] - 0.01


def test_presets_are_the_papers() -> None:
    config = load_config("paper_modelnet", method="vispe")
    assert (config.vispe.temperature, config.vispe.alpha, config.data.batch_size) == (0.05, 5.0, 32)
    assert (config.optimiser.name, config.optimiser.lr, config.optimiser.weight_decay) == ("adamw", 1e-4, 1e-2)
    assert config.schedule.epochs == 1000


def test_settings_that_make_no_sense_are_refused() -> None:
    for wrong in ("vispe.temperature=0", "vispe.alpha=-1"):
        with pytest.raises(UsageError, match=f"^{wrong.split('=')[0]}: "):
            load_config("nano", None, [wrong], method="vispe")


def test_what_evaluation_sees(shards: Path) -> None:
    method = method_of(tiny_method("vispe"))
    network = new_state(method, ALONE).network.eval()
    embedder = method.embedder(network)
    assert (embedder.name, embedder.own_classifier, embedder.image_size) == ("vispe", "centroid", 32)
    images = torch.rand(2, 3, 32, 32)
    torch.testing.assert_close(embedder.pooled(images), network(images))


def test_a_run_that_was_stopped_ends_with_the_same_weights(shards: Path, tmp_path: Path) -> None:
    same_after_a_stop(shards, tmp_path, tiny_method("vispe"))


@pytest.mark.timeout(240)
def test_it_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shards = draw_pairs(tmp_path / "shards", monkeypatch, objects=64, held_out=64)
    better_than_chance(shards, tmp_path / "run", "vispe", "optimiser.lr=3e-3")
