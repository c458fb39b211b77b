"""A step of DOPE: what is drawn, what its losses are, what of it depends on what."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from many_ranks import part
from tiny_runs import tiny
from tiny_shards import write_shards

from dope.augmentation import Share, no_augmentation
from dope.batch import PairBatch
from dope.config import TrainConfig
from dope.distributed import Ranks
from dope.methods import method_of
from dope.state import TrainState, new_state, wrap
from dope.step import StepLosses, choose_cells, compute_losses, sample_batch
from dope.streaming import PairDataset, collate

ALONE = Ranks(0, 1, torch.device("cpu"))

STARTS = torch.tensor([0.1, 0.9, 0.4, 0.6])  # where the farthest point sampling of four pairs begins


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=8, pairs=3, val_objects=3, size=32, n_points=60)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.mark.parametrize("pairs", ["two_views", "one_view_twice"])
@pytest.mark.parametrize("negatives", ["both", "other_objects", "second_view"])
@pytest.mark.parametrize("predict_mask", [True, False])
def test_every_ablation_trains(shards: Path, pairs: str, negatives: str, predict_mask: bool) -> None:
    config = tiny(f"pairs={pairs}", f"loss.negatives={negatives}", f"network.predict_mask={predict_mask}".lower())
    state, losses = one_step(shards, config)
    losses.backward()
    gradients = [p.grad for p in state.network.parameters()]
    assert all(g is not None and torch.isfinite(g).all() for g in gradients)
    assert sum(float(g.abs().sum()) for g in gradients if g is not None) > 0
    assert (losses.report["mask"] > 0) == predict_mask


def test_half_precision_gives_nearly_the_same_loss_and_full_gradients(shards: Path) -> None:
    reports = []
    for precision in ("fp32", "bf16"):
        state, losses = one_step(shards, tiny(f"precision={precision}"))
        losses.backward()
        assert all(p.grad is not None and p.grad.dtype == torch.float32 for p in state.network.parameters())
        reports.append(losses.report["loss"])
    assert reports[0] != reports[1] and reports[0] == pytest.approx(reports[1], rel=0.05)


def test_pairs_without_valid_points_do_no_harm(shards: Path) -> None:
    config = tiny()
    batch = batch_of(shards, config)
    half, none = batch.valid.clone(), torch.zeros_like(batch.valid)
    half[0] = False
    for valid, points in ((half, 24), (none, 0)):
        state = new_state(method_of(config), ALONE)
        sampled = choose_cells(no_augmentation(replace(batch, valid=valid)), config.data.points)
        losses = losses_of_step(state, sampled, config)
        losses.backward()
        assert losses.report["points"] == points and math.isfinite(losses.report["loss"])
        assert all(p.grad is None or bool(torch.isfinite(p.grad).all()) for p in state.network.parameters())


def test_the_loss_is_the_mean_over_points_by_a_naive_loop(shards: Path) -> None:
    config = tiny()
    state, batch = new_state(method_of(config), ALONE), batch_of(shards, config)
    batch.valid[1, 3:] = False  # three points only
    sampled = choose_cells(no_augmentation(batch), config.data.points, STARTS)
    report = losses_of_step(state, sampled, config).report
    first = state.network(sampled.views.images1)
    queries = state.network.sample(first, sampled.cells1)
    keys = state.momentum.sample(state.momentum(sampled.views.images2), sampled.cells2)
    losses = []
    for b in range(4):
        for p in torch.nonzero(sampled.ok[b]).flatten().tolist():
            logits = torch.stack([queries[b, p] @ keys[i, j] for i in range(4) for j in range(8) if sampled.ok[i, j]])
            positive = queries[b, p] @ keys[b, p]
            losses.append((logits / 0.1).logsumexp(0) - positive / 0.1)
    assert report["points"] == 27
    assert report["contrastive"] == pytest.approx(torch.stack(losses).mean().item(), rel=1e-5)
    assert report["loss"] == pytest.approx(report["contrastive"] + report["mask"])
    target = torch.nn.functional.max_pool2d(sampled.views.masks1.float(), 4)  # any coverage of a cell counts
    p = first.mask_logits.double().sigmoid()
    cross_entropy = -(target * p.log() + (1 - target) * (1 - p).log()).mean()
    assert report["mask"] == pytest.approx(cross_entropy.item(), rel=1e-5)


def test_cells_hold_their_points(shards: Path) -> None:
    config = tiny()
    sampled = sample_batch(batch_of(shards, config), config, step=3)
    views = sampled.views
    for b in range(4):
        first = {(int(y // 4), int(x // 4)) for x, y, _, _ in views.points[b][views.valid[b]].tolist()}
        second = {(int(y // 4), int(x // 4)) for _, _, x, y in views.points[b][views.valid[b]].tolist()}
        assert {tuple(cell) for cell in sampled.cells1[b][sampled.ok[b]].tolist()} <= first
        assert {tuple(cell) for cell in sampled.cells2[b][sampled.ok[b]].tolist()} <= second


def test_points_are_the_farthest_in_view_1(shards: Path) -> None:
    batch = batch_of(shards, tiny())
    batch.points[..., 2:] = 1.0  # all alike in view 2
    batch.points[:, :, :2] = torch.tensor([9.0, 9.0])
    corners = torch.tensor([[1.0, 1.0], [31.0, 1.0], [1.0, 31.0], [31.0, 31.0]])
    batch.points[:, [5, 20, 30, 40], :2] = corners
    batch.valid[:] = True
    sampled = choose_cells(no_augmentation(batch), 5, STARTS)
    for cells in sampled.cells1.tolist():
        assert {(0, 0), (0, 7), (7, 0), (7, 7)} <= {tuple(cell) for cell in cells}


def test_either_view_may_be_the_first(shards: Path) -> None:
    config = tiny("augmentation.colour_p=0", "augmentation.flip_p=0", "augmentation.background_removal=off")
    batch = batch_of(shards, config)
    same = [
        torch.equal(sample_batch(batch, config, step).views.images1[0], batch.images1[0].float() / 255)
        for step in range(20)
    ]
    assert 4 <= sum(same) <= 16


@pytest.mark.parametrize(("channels_last", "layout"), [(True, torch.channels_last), (False, torch.contiguous_format)])
def test_images_lie_in_memory_as_the_setting_says(
    shards: Path, channels_last: bool, layout: torch.memory_format
) -> None:
    config = tiny(f"channels_last={channels_last}")
    views = sample_batch(batch_of(shards, config), config, 0).views
    assert views.images1.is_contiguous(memory_format=layout) and views.images2.is_contiguous(memory_format=layout)


@pytest.mark.parametrize("pairs", ["two_views", "one_view_twice"])
def test_random_numbers_are_a_function_of_seed_step_and_place_in_the_global_batch(shards: Path, pairs: str) -> None:
    config = tiny(f"pairs={pairs}", "augmentation.geometry_p=1", "augmentation.noise_p=1")
    batch = batch_of(shards, config)
    whole, again = sample_batch(batch, config, 0), sample_batch(batch, config, 0)
    assert torch.equal(whole.views.images1, again.views.images1)
    assert not torch.equal(whole.views.images1, sample_batch(batch, config, 1).views.images1)
    assert not torch.equal(whole.views.images1, sample_batch(batch, replace(config, seed=1), 0).views.images1)
    for world in (2, 4):
        parts = [sample_batch(part(batch, r, world), config, 0, Share(r, world)) for r in range(world)]
        for name in ("images1", "images2", "masks1", "masks2", "points", "valid"):
            joined = torch.cat([getattr(part.views, name) for part in parts])
            torch.testing.assert_close(joined, getattr(whole.views, name), atol=1e-6, rtol=0)
        for name in ("cells1", "cells2", "ok"):
            assert torch.equal(torch.cat([getattr(part, name) for part in parts]), getattr(whole, name)), name


def batch_of(shards: Path, config: TrainConfig) -> PairBatch:
    dataset = PairDataset(shards, "train", image_size=config.data.image_size)
    return collate([dataset[row] for row in range(4)])


def one_step(shards: Path, config: TrainConfig) -> tuple[TrainState, StepLosses]:
    state = new_state(method_of(config), ALONE)
    sampled = sample_batch(batch_of(shards, config), config, step=0)
    return state, losses_of_step(state, sampled, config)


def losses_of_step(state: Any, sampled: Any, config: Any) -> StepLosses:
    return compute_losses(wrap(method_of(config).online(state.network), ALONE), state.momentum, sampled, config, ALONE)
