"""SimpleShot and RFS: cross entropy on base classes, and the mean feature."""

from __future__ import annotations

import logging
import math
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from episodes_of_rows import episodes_of
from numpy.typing import NDArray
from tiny_labelled import UNSEEN, damage, rewrite, write_labelled

from dope.augmentation import Share
from dope.checkpoints import find_checkpoint, load_method, load_network
from dope.common.errors import BadInput, UsageError
from dope.config import TrainConfig, load_config
from dope.distributed import Ranks
from dope.lowshot.episodes import EpisodeConfig
from dope.lowshot.evaluate import EvaluationConfig, evaluate
from dope.methods import load_embedder, method_of
from dope.methods.pooled import PooledNetwork
from dope.methods.simpleshot import SimpleShot, SimpleShotEmbedder, SimpleShotNetwork, mean_feature
from dope.methods.supervised import ClassifierNetwork, augmented, cross_entropy
from dope.order import Place
from dope.run_logging import read_metrics
from dope.single_views import ViewDataset
from dope.state import new_state
from dope.trainer import train

ALONE = Ranks(0, 1, torch.device("cpu"))
TINY = [
    "network.width=0.125", "data.image_size=32", "data.batch_size=8", "data.pairs_per_object=1", "data.workers=0",
    "schedule.epochs=2", "validation.every=1", "validation.batch_size=5", "checkpoint.every=0", "log.every=1",
    "schedule.warmup_steps=0", "device=cpu",
]  # fmt: skip


def tiny(*overrides: str, method: str = "simpleshot") -> TrainConfig:
    return load_config("nano", None, [*TINY, *overrides], method=method)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    names = ("bar", "disc", "ring", "square")
    return write_labelled(tmp_path_factory.mktemp("shards"), shapes=names, objects=4, held_out=2)


@pytest.fixture
def copy(shards: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(shards, tmp_path / "copy"))


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def test_the_pooled_network_averages_the_last_stage() -> None:
    network = PooledNetwork(0.125).eval()
    images = torch.rand(2, 3, 64, 64)
    grid = network.backbone(images)[-1].detach()
    assert grid.shape == (2, network.dim, 2, 2) and network.dim == 64
    naive = [[float(grid[b, c].sum()) / 4 for c in range(network.dim)] for b in range(2)]
    assert torch.allclose(network(images).detach(), torch.tensor(naive), atol=1e-6)


def test_cross_entropy_is_the_naive_loop_over_what_counts() -> None:
    random = np.random.default_rng(0)
    logits, labels = random.normal(0, 3, (7, 4)), np.array([0, 3, -1, 2, 2, -1, 1])
    naive, hits = 0.0, 0
    for row, label in zip(logits, labels, strict=True):
        if label >= 0:
            naive -= row[label] - math.log(sum(math.exp(x) for x in row))
            hits += int(row[label] == max(row))
    total, right, n = cross_entropy(torch.from_numpy(logits), torch.from_numpy(labels))
    assert float(total) == pytest.approx(naive, abs=1e-12) and (int(right), int(n)) == (hits, 5)


def test_a_batch_without_labels_costs_nothing_and_moves_nothing() -> None:
    logits = torch.randn(3, 4, requires_grad=True)
    total, right, n = cross_entropy(logits, torch.full((3,), -1))
    total.backward()
    assert float(total) == 0 and int(right) == int(n) == 0 and not logits.grad.any()  # type: ignore[union-attr]


def step_of(config: TrainConfig, batch: Any, rows: list[int] | None = None) -> tuple[dict[str, float], Any]:
    """Report and gradients of a step with BatchNorm frozen."""
    method = method_of(config)
    state = new_state(method, ALONE, {"classes": ["bar", "disc", "ring", "square"]})
    state.network.eval()
    prepared = batch if rows is None else batch.at(rows)
    losses = method.losses(method.online(state.network), state.momentum, prepared, ALONE)
    losses.backward()
    return losses.report, [p.grad for p in state.network.parameters()]


def test_a_view_that_fills_a_damaged_ones_place_does_not_count_twice(copy: Path) -> None:
    config, dataset = tiny(), ViewDataset(copy, "train", image_size=32)
    damage(copy, *(dataset.batch([1, 6]).keys))
    batch = dataset.batch([0, 1, 5, 6, 9])
    prepared = augmented(batch, config, 4)
    assert set(batch.damaged) == {1, 3} and prepared.labels.tolist() == [0, -1, 0, -1, 1]
    assert batch.labels.tolist()[1] != -1  # what was handed in stays
    report, gradients = step_of(config, prepared)
    wanted, wanted_gradients = step_of(config, prepared, [0, 2, 4])
    assert report == pytest.approx(wanted, abs=1e-6)
    assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(gradients, wanted_gradients, strict=True))


def test_augmentation_is_a_function_of_the_step_and_of_the_place_in_the_global_batch(shards: Path) -> None:
    config = tiny()
    batch = ViewDataset(shards, "train", image_size=32).batch(range(8))
    whole = augmented(batch, config, 3)
    halves = [augmented(batch.at(slice(4 * r, 4 * r + 4)), config, 3, Share(r, 2)) for r in range(2)]
    assert torch.equal(whole.images, torch.cat([half.images for half in halves]))
    assert torch.equal(whole.images, augmented(batch, config, 3).images)
    assert not torch.equal(whole.images, augmented(batch, config, 4).images)
    assert whole.images.dtype == torch.float32 and float(whole.images.max()) <= 1
    kept = [bool((a == b.float() / 255).all()) for a, b in zip(whole.images, batch.images, strict=True)]
    assert not all(kept)


def test_half_of_the_views_lose_their_background(shards: Path) -> None:
    settings = ("augmentation.colour_p=0", "augmentation.flip_p=0", "augmentation.geometry=false")
    batch = ViewDataset(shards, "train", image_size=32).batch([0] * 200)
    changed = augmented(batch, tiny(*settings), 0).images
    lost = (changed - batch.images.float() / 255).abs().amax((1, 2, 3)) > 0.05
    assert 0.35 < float(lost.float().mean()) < 0.65
    off = augmented(batch, tiny(*settings, "augmentation.background_removal=off"), 0).images
    assert torch.equal(off, batch.images.float() / 255)


def naive_mean(network: SimpleShotNetwork, dataset: ViewDataset, rows: list[int]) -> NDArray[np.float64]:
    """View by view."""
    with torch.no_grad():
        each = [network.encoder(dataset.batch([row]).images.float() / 255)[0].double() for row in rows]
    return np.mean([vector.numpy() for vector in each], axis=0)


def settled(config: TrainConfig, dataset: ViewDataset) -> tuple[SimpleShot, SimpleShotNetwork]:
    """A network whose BatchNorm has seen images, in training mode."""
    method = method_of(config)
    network = new_state(method, ALONE, method.facts(dataset)).network
    assert isinstance(method, SimpleShot) and isinstance(network, SimpleShotNetwork)
    with torch.no_grad():
        network(dataset.batch(range(16)).images.float() / 255)
    return method, network


@pytest.mark.parametrize("batch_size", [1, 5, 32, 1000])
def test_the_mean_feature_is_that_of_all_training_views_whatever_the_batches(shards: Path, batch_size: int) -> None:
    dataset = ViewDataset(shards, "train", image_size=32)
    _, network = settled(tiny(), dataset)
    found = mean_feature(network.encoder, dataset, batch_size=batch_size)
    assert network.training and network.encoder.training
    wanted = naive_mean(network.eval(), dataset, list(range(len(dataset))))
    assert len(dataset) == 32 and np.abs(found.numpy() - wanted).max() < 1e-6 * np.abs(wanted).max()


def test_before_a_checkpoint_the_mean_is_that_of_its_weights_and_made_once(
    shards: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = ViewDataset(shards, "train", image_size=32)
    method, network = settled(tiny(), dataset)
    calls = []
    real = network.encoder.forward
    monkeypatch.setattr(network.encoder, "forward", lambda images: calls.append(len(images)) or real(images))
    method.before_save(network, dataset)
    first, times = network.mean.clone(), len(calls)
    assert sum(calls) == 32 and first.abs().max() > 0
    method.before_save(network, dataset)
    assert len(calls) == times  # the same weights
    with torch.no_grad():
        next(iter(network.encoder.parameters())).mul_(1.5)
    method.before_save(network, dataset)
    assert len(calls) == 2 * times and not torch.allclose(network.mean, first)


def test_a_signal_does_not_wait_for_the_mean_and_no_other_is_taken_for_it(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, config = SimpleShot.losses, tiny("validation.every=0", "checkpoint.every=1")

    def signalled(*arguments: Any, step: int, **options: Any) -> Any:
        if step == 2:  # the checkpoint of step 2 has a mean of its own
            os.kill(os.getpid(), signal.SIGTERM)
        return real(*arguments, step=step, **options)

    with monkeypatch.context() as patch:
        patch.setattr(SimpleShot, "losses", signalled)
        assert train(shards, tmp_path, config)["step"] == 3
    embedder, _ = load_embedder(tmp_path)
    assert isinstance(embedder, SimpleShotEmbedder) and bool(embedder.mean.isnan().all())
    drawn, vectors = episodes_of([[[0], [1]]], [[[2], [3]]]), np.ones((4, 64), np.float32)
    with pytest.raises(UsageError, match=r"--classifier cl2n: .*no mean feature.*Go on with the run"):
        embedder.classify(vectors, drawn)
    assert embedder.pooled(torch.rand(1, 3, 32, 32)).isfinite().all()
    embedder.transform = "l2n"
    assert embedder.classify(vectors, drawn).shape == (1, 2, 1)  # which needs none
    train(shards, tmp_path, config)
    embedder, _ = load_embedder(tmp_path)
    assert isinstance(embedder, SimpleShotEmbedder) and bool(embedder.mean.isfinite().all())


def test_damaged_views_are_left_out_of_the_mean_and_said_to_be(copy: Path, caplog: pytest.LogCaptureFixture) -> None:
    dataset = ViewDataset(copy, "train", image_size=32)
    _, network = settled(tiny(), dataset)
    damage(copy, *dataset.batch([3, 8, 9]).keys)
    with caplog.at_level(logging.WARNING):
        found = mean_feature(network.encoder, dataset, batch_size=2)  # one batch has nothing else
    assert "leaves out 3 damaged views of 32" in caplog.text
    wanted = naive_mean(network.eval(), dataset, [row for row in range(32) if row not in (3, 8, 9)])
    assert np.abs(found.numpy() - wanted).max() < 1e-6 * np.abs(wanted).max()


def test_rfs_is_the_same_training_without_a_mean(shards: Path, tmp_path: Path) -> None:
    for name in ("simpleshot", "rfs"):
        train(shards, tmp_path / name, tiny("validation.every=0", method=name))
    networks = {name: load_method(tmp_path / name)[1] for name in ("simpleshot", "rfs")}
    theirs = networks["rfs"].state_dict()
    ours = {key: value for key, value in networks["simpleshot"].state_dict().items() if key != "mean"}
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours)
    embedder = method_of(tiny(method="rfs")).embedder(networks["rfs"])
    assert (embedder.name, embedder.own_classifier, embedder.image_size) == ("rfs", "logistic", 32)


def test_a_run_is_scored_by_its_classifier_and_a_checkpoint_has_the_mean(shards: Path, tmp_path: Path) -> None:
    result = train(shards, tmp_path, tiny("checkpoint.every=1"))
    validations = read_metrics(tmp_path, "validation")
    assert [line["step"] for line in validations] == [0, 2, 4] and validations[0]["pairs"] == 16
    assert (result["score_name"], result["score"]) == ("accuracy", validations[-1]["accuracy"])
    embedder, meta = load_embedder(tmp_path)
    assert isinstance(embedder, SimpleShotEmbedder) and meta["facts"]["classes"] == ["bar", "disc", "ring", "square"]
    network, dataset = load_method(tmp_path)[1], ViewDataset(shards, "train", image_size=32)
    assert isinstance(network, SimpleShotNetwork)
    wanted = naive_mean(network, dataset, list(range(32)))
    assert np.abs(embedder.mean.numpy() - wanted).max() < 1e-5 * np.abs(wanted).max()
    held_out = ViewDataset(shards, "val", image_size=32).batch(range(16))
    with torch.no_grad():
        right = network(held_out.images.float() / 255).argmax(1) == held_out.labels
        assert torch.equal(embedder.pooled(held_out.images / 255), network.encoder(held_out.images / 255))
    assert result["score"] == pytest.approx(float(right.double().mean()))


def test_stopping_and_going_on_is_bitwise_the_same(shards: Path, tmp_path: Path) -> None:
    config = tiny("validation.every=0", "schedule.epochs=3")
    whole = train(shards, tmp_path / "whole", config)
    train(shards, tmp_path / "parts", config, stop_after=3)
    second = train(shards, tmp_path / "parts", replace(config, data=replace(config.data, workers=1)))
    assert (whole["step"], second["step"], second["steps_of_this_call"]) == (6, 6, 3)
    ours, theirs = (load_method(tmp_path / name)[1].state_dict() for name in ("whole", "parts"))
    assert "mean" in ours and all(torch.equal(ours[key], theirs[key]) for key in ours)


def test_a_checkpoint_of_another_method_is_refused(shards: Path, tmp_path: Path) -> None:
    train(shards, tmp_path / "run", tiny("validation.every=0", method="rfs"), stop_after=1)
    with pytest.raises(UsageError, match=r"made with other settings: .*method is simpleshot, was rfs"):
        train(shards, tmp_path / "run", tiny("validation.every=0"))
    with pytest.raises(UsageError, match="method is simpleshot, was rfs"):
        train(shards, tmp_path / "new", tiny("validation.every=0"), resume=tmp_path / "run")
    with pytest.raises(UsageError, match="is of method rfs, which has no dense descriptors"):
        load_network(tmp_path / "run")
    with pytest.raises(UsageError, match="rfs has no dense features"):
        protocol = EpisodeConfig(ways=3, queries=2, episodes=1)
        evaluate(find_checkpoint(tmp_path / "run"), shards, EvaluationConfig((protocol,), classifier="local"))


def test_other_classes_are_other_data(shards: Path, tmp_path: Path) -> None:
    settings = ("validation.every=0", "data.batch_size=4")
    train(shards, tmp_path / "run", tiny(*settings, 'data.categories=["bar","disc","ring"]'), stop_after=1)
    assert load_method(tmp_path / "run")[2]["facts"] == {"classes": ["bar", "disc", "ring"]}
    with pytest.raises(UsageError, match=r"data\.categories"):
        train(shards, tmp_path / "run", tiny(*settings))


def test_a_class_that_only_the_held_out_views_have_does_no_harm(tmp_path: Path) -> None:
    write_labelled(tmp_path / "shards", shapes=("bar", "disc"), objects=4, held_out=1)
    rewrite(tmp_path / "shards", lambda rows: [row.update(category="ring") for row in rows if row["split"] == "val"])
    result = train(tmp_path / "shards", tmp_path / "run", tiny())
    assert result["score"] == 0 and math.isfinite(result["loss"])


def test_what_cannot_be_learnt_from_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    nameless = write_labelled(tmp_path / "nameless", shapes=("bar", "disc"), objects=4, unnamed=True)
    lonely = write_labelled(tmp_path / "lonely", shapes=("bar",), objects=8)
    for method in ("simpleshot", "rfs", "supmoco"):
        with pytest.raises(BadInput, match=r"views\.parquet: the views have no category"):
            train(nameless, tmp_path / "run", tiny(method=method))
        with pytest.raises(BadInput, match=r"views\.parquet: has views of one class only \('bar'\)"):
            train(lonely, tmp_path / "run", tiny(method=method))
    assert not (tmp_path / "run" / "config.yaml").exists()


@pytest.mark.parametrize(
    "setting", ["pairs=one_view_twice", "distributed.local_negatives=true", "data.micro_batch=4", "data.batch_size=1"]
)
def test_settings_that_mean_nothing_here_are_refused(setting: str) -> None:
    with pytest.raises(UsageError, match=setting.split("=")[0].replace(".", r"\.")):
        method_of(tiny(setting))


def test_the_papers_settings() -> None:
    epochs = {"paper": 1000, "paper_modelnet": 1000, "paper_co3d": 1000, "paper_shapenet": 500}
    for method in ("simpleshot", "rfs"):
        for preset, wanted in epochs.items():
            config = load_config(preset, method=method)
            optimiser, schedule = config.optimiser, config.schedule
            assert (optimiser.name, optimiser.lr, optimiser.weight_decay) == ("adamw", 1e-3, 1e-4)
            assert (schedule.epochs, schedule.shape, schedule.per) == (wanted, "steps", "epoch")
            assert (schedule.milestones, schedule.factor) == ((0.7, 0.9), 0.1)
            assert (config.method, config.data.batch_size, config.simpleshot.transform) == (method, 256, "cl2n")
            assert config.augmentation == load_config("paper").augmentation


LEARNING = [
    "data.image_size=32", "network.width=0.25", "data.batch_size=32", "data.workers=0", "log.every=50",
    "device=cpu", "checkpoint.every=0", "validation.every=1000", "validation.pairs=96", "optimiser.lr=2e-3",
    "schedule.max_steps=120",
]  # fmt: skip


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_labelled(tmp_path_factory.mktemp("base"), objects=24, held_out=8, views=3)


@pytest.fixture(scope="module")
def unseen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_labelled(tmp_path_factory.mktemp("unseen"), shapes=UNSEEN, objects=16)


@pytest.mark.parametrize(("method", "episodes"), [("simpleshot", 300), ("rfs", 60)])
def test_it_recognises_classes_that_it_has_not_seen(
    base: Path, unseen: Path, tmp_path: Path, method: str, episodes: int
) -> None:
    result = train(base, tmp_path, load_config("nano", None, LEARNING, method=method))
    assert result["score"] > 0.5  # of six classes
    protocol = EpisodeConfig(queries=10, episodes=episodes)
    config = EvaluationConfig(protocols=(protocol,), compare_untrained=True)
    trained, untrained = evaluate(Path(result["checkpoint"]), unseen, config).rows
    assert trained.accuracy - trained.ci95 > 0.2 + 0.02  # chance, and a little
    assert trained.accuracy - trained.ci95 > untrained.accuracy + untrained.ci95
    assert (trained.method, trained.network, untrained.network) == (method, "trained", "untrained")


def test_the_classifier_network_has_a_logit_a_class() -> None:
    network = ClassifierNetwork(0.125, 5)
    assert network(torch.rand(2, 3, 32, 32)).shape == (2, 5)


def test_an_error_does_not_wait_for_the_mean(copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other ranks end at once, and with them the first one: it would be ended before its checkpoint was written."""
    config = tiny("validation.every=0")
    method = method_of(config)
    rows = list(method.order(method.dataset(copy, "train")).batches(Place(), 1))[1]
    damage(copy, ViewDataset(copy, "train", image_size=32).batch(rows[:1]).keys[0])
    monkeypatch.setattr("dope.methods.simpleshot.mean_feature", lambda *_, **__: pytest.fail("goes through all views"))
    with pytest.raises(BadInput, match="max_bad_samples"):
        train(copy, tmp_path / "run", config)
    embedder, meta = load_embedder(tmp_path / "run")
    assert meta["step"] == 1 and isinstance(embedder, SimpleShotEmbedder) and bool(embedder.mean.isnan().all())
