"""FEAT: attention over class means, its losses, its episodes, and where it starts from."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import many_ranks_episodes
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tiny_labelled import UNSEEN, damage, rewrite, write_labelled

from dope.augmentation import Share
from dope.checkpoints import load_method
from dope.common.errors import BadInput, UsageError
from dope.config import TrainConfig, load_config
from dope.distributed import Ranks
from dope.lowshot.episodes import EpisodeConfig, sample_episodes
from dope.lowshot.evaluate import EvaluationConfig, evaluate
from dope.methods import feat as feat_module
from dope.methods import load_embedder, method_of
from dope.methods.configs import FeatConfig
from dope.methods.episode_order import EpisodeOrder, population
from dope.methods.feat import Feat, FeatEmbedder, FeatNetwork, OnlineFeat, adapted_nearest
from dope.methods.set_attention import Kept, SetAttention, centres, draw_kept, episode_losses
from dope.order import Place
from dope.run_logging import read_metrics
from dope.state import learning_rate, new_state, set_learning_rate
from dope.trainer import train
from dope.view_index import ViewIndex, read_view_index

ALONE = Ranks(0, 1, torch.device("cpu"))
CPU = torch.device("cpu")
TINY = [
    "network.width=0.125", "data.image_size=32", "data.workers=0", "feat.ways=3", "feat.queries=2", "feat.episodes=4",
    "schedule.epochs=2", "validation.every=1", "checkpoint.every=0", "log.every=1", "device=cpu",
]  # fmt: skip
NAMES = ("bar", "disc", "ring", "square")
Vector = NDArray[np.float64]


def tiny(*overrides: str) -> TrainConfig:
    return load_config("nano", None, [*TINY, *overrides], method="feat")


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_labelled(tmp_path_factory.mktemp("shards"), shapes=NAMES, objects=5, held_out=3)


@pytest.fixture
def copy(shards: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(shards, tmp_path / "copy"))


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


# -- attention and losses


def attention_of(dim: int, seed: int = 0) -> SetAttention:
    torch.manual_seed(seed)
    attention = SetAttention(dim).double()
    torch.nn.init.normal_(attention.norm.weight)
    torch.nn.init.normal_(attention.norm.bias)
    return attention


def naive_attention(attention: SetAttention, members: Vector, kept: tuple[Vector, Vector] | None = None) -> Vector:
    """Member by member."""
    w = {name: parameter.detach().numpy() for name, parameter in attention.named_parameters()}
    n, dim = members.shape
    adapted = np.empty_like(members)
    for i in range(n):
        scores = []
        for j in range(n):
            q, k = w["query.weight"] @ members[i], w["key.weight"] @ members[j]
            scores.append(sum(a * b for a, b in zip(q, k, strict=True)) / math.sqrt(dim))
        weights = [math.exp(score) / sum(map(math.exp, scores)) for score in scores]
        if kept is not None:
            weights = [weight * kept[0][i, j] for j, weight in enumerate(weights)]
        value = sum(weight * (w["value.weight"] @ members[j]) for j, weight in enumerate(weights))
        output = w["output.weight"] @ value + w["output.bias"]
        if kept is not None:
            output = output * kept[1][i]
        x = output + members[i]
        spread = math.sqrt(sum((x - x.mean()) ** 2) / dim + 1e-5)
        adapted[i] = (x - x.mean()) / spread * w["norm.weight"] + w["norm.bias"]
    return adapted


@pytest.mark.parametrize("dropping", [False, True])
def test_attention_is_the_naive_loop(dropping: bool) -> None:
    attention, sets = attention_of(6), torch.randn(2, 4, 6, dtype=torch.float64)
    kept = draw_kept([(2, 4)], 6, (0.3, 0.5), 1, CPU, Share())[0]
    found = attention(sets, Kept(kept.weights.double(), kept.outputs.double()) if dropping else None)
    for e in range(2):
        factors = (kept.weights[e].double().numpy(), kept.outputs[e].double().numpy()) if dropping else None
        assert np.abs(found[e].detach().numpy() - naive_attention(attention, sets[e].numpy(), factors)).max() < 1e-10


def test_attention_has_no_order_and_keeps_sets_apart() -> None:
    attention, sets = attention_of(8), torch.randn(3, 5, 8, dtype=torch.float64)
    found, order = attention(sets), torch.tensor([3, 0, 4, 1, 2])
    assert torch.allclose(attention(sets[:, order]), found[:, order], atol=1e-12)
    assert torch.allclose(attention(sets[1:2]), found[1:2], atol=1e-12)
    other = sets.clone()
    other[0, 2] += 1
    assert not torch.allclose(attention(other)[0, 0], found[0, 0])  # members do see each other


def test_attention_starts_as_the_paper_says() -> None:
    torch.manual_seed(0)
    attention = SetAttention(256)
    names = dict(attention.named_parameters())
    for part in ("query", "key", "value"):
        assert f"{part}.bias" not in names
        assert float(names[f"{part}.weight"].detach().std()) == pytest.approx(math.sqrt(2 / 512), rel=0.02)
    assert names["output.bias"].shape == (256,) and "norm.weight" in names


def test_losses_are_the_naive_loops() -> None:
    random = np.random.default_rng(3)
    attention = attention_of(4)
    embeddings = random.normal(0, 2, (2, 3, 2 + 3, 4))  # two episodes, 3-way 2-shot, three queries
    tensor = torch.from_numpy(embeddings)
    adapted, middles = attention(tensor[:, :, :2].mean(2)), centres(attention, tensor)
    found = [part.tolist() for part in episode_losses(tensor, adapted, middles, 2, (3.0, 5.0))]
    for e in range(2):
        shots = np.array([embeddings[e, way, :2].sum(0) / 2 for way in range(3)])
        prototypes = naive_attention(attention, shots)
        centre = [naive_attention(attention, embeddings[e, way]).sum(0) / 5 for way in range(3)]

        def cross_entropy(x: Vector, points: Any, way: int, temperature: float) -> float:
            logits = [-sum((point - x) ** 2) / temperature for point in points]
            return math.log(sum(map(math.exp, logits))) - logits[way]

        queries = [(embeddings[e, way, 2 + i], way) for way in range(3) for i in range(3)]
        members = [(embeddings[e, way, i], way) for way in range(3) for i in range(5)]
        hits = [int(np.argmin([sum((p - x) ** 2) for p in prototypes])) == way for x, way in queries]
        assert found[0][e] == pytest.approx(np.mean([cross_entropy(x, prototypes, w, 3.0) for x, w in queries]))
        assert found[1][e] == pytest.approx(np.mean([cross_entropy(x, centre, w, 5.0) for x, w in members]))
        assert found[2][e] == pytest.approx(np.mean(hits))


def test_dropout_is_a_function_of_the_seed_and_of_the_episodes_place() -> None:
    shapes = [(4, 5), (4, 5, 16)]
    whole = draw_kept(shapes, 12, (0.1, 0.5), 7, CPU, Share())
    again = draw_kept(shapes, 12, (0.1, 0.5), 7, CPU, Share())
    other = draw_kept(shapes, 12, (0.1, 0.5), 8, CPU, Share())
    halves = [draw_kept([(2, *shape[1:]) for shape in shapes], 12, (0.1, 0.5), 7, CPU, Share(r, 2)) for r in range(2)]
    for i, (width, shape) in enumerate(zip((5, 16), shapes, strict=True)):
        assert whole[i].weights.shape == (*shape, width) and whole[i].outputs.shape == (*shape, 12)
        for name in ("weights", "outputs"):
            ours = getattr(whole[i], name)
            assert torch.equal(ours, getattr(again[i], name)) and not torch.equal(ours, getattr(other[i], name))
            assert torch.equal(ours, torch.cat([getattr(half[i], name) for half in halves]))
    assert set(whole[1].outputs.unique().tolist()) == {0.0, 2.0}
    assert float((whole[1].outputs == 0).float().mean()) == pytest.approx(0.5, abs=0.05)
    assert float((whole[1].weights == 0).float().mean()) == pytest.approx(0.1, abs=0.02)
    nothing = draw_kept(shapes, 12, (0.0, 0.0), 7, CPU, Share())
    assert all(bool((part == 1).all()) for kept in nothing for part in (kept.weights, kept.outputs))


def test_there_is_dropout_in_training_only() -> None:
    online = OnlineFeat(FeatNetwork(0.125), FeatConfig(ways=2, queries=1), compiled=False).eval()
    images = torch.rand(4, 3, 32, 32)
    plain = online(images, 1, Share())
    assert all(torch.equal(a, b) for a, b in zip(plain, online(images, 2, Share()), strict=True))
    assert plain[0].shape == (1, 2, 2, 64) and plain[1].shape == plain[2].shape == (1, 2, 64)
    assert torch.equal(plain[0].flatten(0, 2), online.network(images))  # class by class, the shots first
    assert torch.equal(plain[1], online.network.attention(plain[0][:, :, :1].mean(2)))
    online.train()
    online.network.encoder.eval()
    for i in (1, 2):
        assert not torch.allclose(online(images, 1, Share())[i], plain[i])
        assert not torch.allclose(online(images, 1, Share())[i], online(images, 2, Share())[i])


# -- episodes


def an_index(objects: dict[str, int], views: int = 2) -> ViewIndex:
    """Classes with so many objects each."""
    names = sorted(objects)
    rows = [(c, o) for c, name in enumerate(names) for o in range(objects[name]) for _ in range(views)]
    labels = np.array([c for c, _ in rows])
    numbers = np.array([100 * c + o for c, o in rows])
    order = np.random.default_rng(0).permutation(len(rows))
    nothing = np.array([""] * len(rows))
    zeros = np.zeros(len(rows), np.int64)
    return ViewIndex(
        None, nothing, nothing, nothing, zeros, zeros, labels[order], tuple(names), numbers[order], ""  # type: ignore[arg-type]
    )  # fmt: skip


PLENTY = an_index({"a": 7, "b": 6, "c": 9, "d": 6, "e": 5})
SMALL = FeatConfig(ways=3, shots=2, queries=3, episodes=12)


def test_an_episode_holds_distinct_classes_and_distinct_objects_of_them() -> None:
    order = EpisodeOrder(PLENTY, 4, SMALL, seed=1)
    assert (order.steps_per_epoch, order.n_objects, order.left_out) == (3, 33, ())
    episodes = order.epoch(0)
    assert episodes.shape == (3, 4, 3, 5)
    for episode in episodes.reshape(-1, 3, 5):
        labels = PLENTY.labels[episode]
        assert (labels == labels[:, :1]).all() and len(set(labels[:, 0].tolist())) == 3
        assert len(set(PLENTY.objects[episode].ravel().tolist())) == 15
    assert set(PLENTY.labels[episodes].ravel().tolist()) == set(range(5))
    assert len(set(episodes.ravel().tolist())) > 33  # not always the same view of an object


def test_episodes_are_a_function_of_the_seed_and_of_the_epoch() -> None:
    order = EpisodeOrder(PLENTY, 4, SMALL, seed=1)
    assert np.array_equal(order.epoch(2), EpisodeOrder(PLENTY, 4, SMALL, seed=1).epoch(2))
    assert not np.array_equal(order.epoch(2), order.epoch(3))
    assert not np.array_equal(order.epoch(2), EpisodeOrder(PLENTY, 4, SMALL, seed=2).epoch(2))
    # how many episodes make up a step decides nothing else
    assert np.array_equal(
        order.epoch(2).reshape(12, 3, 5), EpisodeOrder(PLENTY, 2, SMALL, seed=1).epoch(2).reshape(12, 3, 5)
    )


def test_episodes_go_on_at_any_step() -> None:
    order = EpisodeOrder(PLENTY, 4, SMALL, seed=1)
    whole = list(order.batches(Place(), 3))
    assert len(whole) == 9 and all(len(rows) == 4 * 15 for rows in whole)
    place = Place()
    for step in range(9):
        assert list(order.batches(place, 3)) == whole[step:]
        place = order.after(place)
    assert place == Place(3, 0)


@pytest.mark.parametrize("world", [2, 4])
def test_ranks_have_whole_episodes_that_make_up_the_step(world: int) -> None:
    order = EpisodeOrder(PLENTY, 4, SMALL, seed=1)
    shares = [list(order.batches(Place(1, 4), 2, rank=rank, world=world)) for rank in range(world)]
    for step, whole in enumerate(order.batches(Place(1, 4), 2)):
        assert [row for share in shares for row in share[step]] == whole
        assert all(len(share[step]) == 4 // world * 15 for share in shares)


def test_classes_with_too_few_objects_take_no_part(caplog: pytest.LogCaptureFixture) -> None:
    index = an_index({"a": 7, "b": 4, "c": 5, "d": 6, "e": 1})
    order = EpisodeOrder(index, 1, SMALL, seed=0)
    assert order.left_out == ("b", "e") and order.n_objects == 18
    assert set(index.labels[order.epoch(0)].ravel().tolist()) == {0, 2, 3}
    assert "fewer than 5 objects take no part in episodes: b, e" in caplog.text


@pytest.mark.parametrize(
    ("objects", "batch_size", "world", "message"),
    [
        ({"a": 5, "b": 5, "c": 4}, 1, 1, "3 classes with 5 objects each .* 2 of 3 .*--set feat.queries=2 or less"),
        ({"a": 5, "b": 5, "c": 2}, 1, 1, "--set feat.ways=2 or less"),
        ({"a": 9, "b": 1}, 1, 1, "Give shards with more classes"),
        ({"a": 5, "b": 5, "c": 5}, 13, 1, "12 episodes an epoch are less than one step of 13"),
        ({"a": 5, "b": 5, "c": 5}, 3, 2, "3 episodes a step cannot be divided among 2 ranks.*batch_size=2"),
    ],
)
def test_what_cannot_be_drawn_is_said_with_what_could(
    objects: dict[str, int], batch_size: int, world: int, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        EpisodeOrder(an_index(objects), batch_size, SMALL, seed=0).batches(Place(), 1, world=world)


def test_the_population_does_not_depend_on_the_order_of_rows() -> None:
    found = population(PLENTY.labels, PLENTY.objects, PLENTY.classes)
    assert list(found) == ["a", "b", "c", "d", "e"] and [len(objects) for objects in found.values()] == [7, 6, 9, 6, 5]
    for name, objects in found.items():
        for number, rows in objects.items():
            assert {PLENTY.classes[label] for label in PLENTY.labels[rows]} == {name}
            assert PLENTY.objects[rows].tolist() == [int(number)] * 2


# -- training


def step_of(config: TrainConfig, batch: Any) -> tuple[dict[str, float], list[torch.Tensor | None]]:
    method = method_of(config)
    state = new_state(method, ALONE)
    state.network.eval()
    losses = method.losses(method.online(state.network), state.momentum, batch, ALONE)
    losses.backward()
    return losses.report, [p.grad for p in state.network.parameters()]


def test_an_episode_with_a_damaged_view_does_not_count(copy: Path) -> None:
    config = tiny("data.batch_size=2", "feat.balance=0.5")
    method = method_of(config)
    dataset = method.dataset(copy, "train")
    rows = next(iter(method.order(dataset).batches(Place(), 1)))
    place = next(place for place in range(9, 18) if rows[place] not in rows[:9])
    damage(copy, dataset.batch(rows).keys[place])
    batch = dataset.batch(rows)
    assert place in batch.damaged
    prepared = method.prepare(batch, 0)
    assert prepared.complete.tolist() == [True, False]
    report, gradients = step_of(config, prepared)
    first = feat_module.EpisodeBatch(prepared.views.at(slice(0, 9)), torch.tensor([True]))
    wanted, wanted_gradients = step_of(config, first)
    assert report == pytest.approx(wanted, abs=1e-5)
    for ours, theirs in zip(gradients, wanted_gradients, strict=True):
        assert ours is not None and theirs is not None and torch.allclose(ours, theirs, atol=1e-5)
    none, still = step_of(config, replace(prepared, complete=torch.tensor([False, False])))
    assert none["loss"] == 0 and not any(gradient.any() for gradient in still if gradient is not None)


def test_the_loss_is_that_of_the_queries_and_a_share_of_the_regulariser(shards: Path) -> None:
    config = tiny("feat.balance=0.25")
    method = method_of(config)
    dataset = method.dataset(shards, "train")
    batch = method.prepare(dataset.batch(next(iter(method.order(dataset).batches(Place(), 1)))), 0)
    report, _ = step_of(config, batch)
    assert report["loss"] == pytest.approx(report["queries"] + 0.25 * report["regulariser"], abs=1e-6)
    assert report["regulariser"] > 0.1


def test_the_encoder_has_its_own_learning_rate() -> None:
    config = load_config("paper", method="feat")
    small = replace(config, network=replace(config.network, width=0.125))
    state = new_state(method_of(small), ALONE)
    encoder, attention = state.optimiser.param_groups
    counted = sum(len(group["params"]) for group in state.optimiser.param_groups)
    assert counted == len(list(state.network.parameters())) and len(attention["params"]) == 7
    for epoch, share in ((0, 1), (39, 1), (40, 0.5), (80, 0.25), (120, 0.125), (160, 0.0625), (199, 0.0625)):
        set_learning_rate(state.optimiser, learning_rate(small, 100 * epoch, 100), small.optimiser.lr)
        assert attention["lr"] == pytest.approx(2e-3 * share) and encoder["lr"] == pytest.approx(2e-4 * share)
    assert isinstance(state.optimiser, torch.optim.SGD) and encoder["nesterov"] and encoder["momentum"] == 0.9
    assert encoder["weight_decay"] == attention["weight_decay"] == 5e-4


def test_the_papers_settings() -> None:
    temperatures = {"paper": 32, "paper_modelnet": 32, "paper_shapenet": 32, "paper_co3d": 16}
    for preset, temperature in temperatures.items():
        config = load_config(preset, method="feat")
        feat = config.feat
        assert (feat.temperature, feat.centre_temperature, feat.balance) == (temperature, temperature, 0.01)
        assert (feat.ways, feat.shots, feat.queries, feat.episodes) == (5, 1, 15, 100)
        assert (feat.attention_dropout, feat.output_dropout, config.schedule.epochs) == (0.1, 0.5, 200)
        assert config.data.batch_size == 1


@pytest.mark.parametrize(
    "setting",
    ["feat.ways=1", "feat.shots=0", "feat.queries=0", "feat.episodes=0", "feat.temperature=0", "feat.balance=-1",
     "feat.centre_temperature=-2", "feat.output_dropout=1", "feat.attention_dropout=-0.1", "feat.encoder_lr_scale=-1",
     "data.batch_size=0", "pairs=one_view_twice"],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(setting: str) -> None:
    with pytest.raises(UsageError, match=setting.split("=")[0].replace(".", r"\.")):
        method_of(tiny(setting))


def test_stopping_within_an_epoch_and_going_on_is_bitwise_the_same(shards: Path, tmp_path: Path) -> None:
    config = tiny("validation.every=0", "data.batch_size=2", "feat.episodes=6")
    whole = train(shards, tmp_path / "whole", config)
    first = train(shards, tmp_path / "parts", config, stop_after=2)
    assert (first["step"], first["epoch"], whole["step"]) == (2, 0, 6)
    second = train(shards, tmp_path / "parts", replace(config, data=replace(config.data, workers=1)))
    assert second["status"] == "finished"
    ours, theirs = (load_method(tmp_path / name)[1].state_dict() for name in ("whole", "parts"))
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)
    lines = [[line["loss"] for line in read_metrics(tmp_path / name, "step")] for name in ("whole", "parts")]
    assert lines[0] == lines[1] and len(lines[0]) == 6


def test_it_starts_with_the_encoder_of_simpleshot_or_rfs(shards: Path, tmp_path: Path) -> None:
    supervised = ("network.width=0.125", "data.image_size=32", "data.batch_size=4", "data.workers=0", "device=cpu")
    for method in ("simpleshot", "rfs"):
        config = load_config("nano", None, [*supervised, "validation.every=0"], method=method)
        train(shards, tmp_path / method, config, stop_after=2)
        theirs = load_method(tmp_path / method)[1].encoder.state_dict()  # type: ignore[union-attr]
        config = tiny(f"feat.start={tmp_path / method}", "validation.every=0")
        state = new_state(method_of(config), ALONE)
        assert isinstance(state.network, FeatNetwork)
        ours = state.network.encoder.state_dict()
        assert ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours)
        assert any("running_mean" in key and bool(value.any()) for key, value in ours.items())
    result = train(shards, tmp_path / "feat", config, stop_after=1)
    assert load_method(Path(result["checkpoint"]))[0].name == "feat"


def test_what_it_cannot_start_with_is_refused(shards: Path, tmp_path: Path) -> None:
    train(shards, tmp_path / "feat", tiny("validation.every=0"), stop_after=1)
    with pytest.raises(UsageError, match=r"feat\.start=.*step-00000001\.pt: is of method feat.*--method simpleshot"):
        new_state(method_of(tiny(f"feat.start={tmp_path / 'feat'}")), ALONE)
    settings = ("data.image_size=32", "data.batch_size=4", "data.workers=0", "device=cpu", "validation.every=0")
    wide = load_config("nano", None, [*settings, "network.width=0.25"], method="simpleshot")
    train(shards, tmp_path / "wide", wide, stop_after=1)
    with pytest.raises(UsageError, match=r"network\.width 0\.25, this run 0\.125.*--set network\.width=0\.25"):
        new_state(method_of(tiny(f"feat.start={tmp_path / 'wide'}")), ALONE)
    with pytest.raises(BadInput, match="nowhere: no such file or folder"):
        train(shards, tmp_path / "new", tiny(f"feat.start={tmp_path / 'nowhere'}"))
    (tmp_path / "bad.pt").write_bytes(b"no checkpoint")
    with pytest.raises(BadInput, match=r"bad\.pt"):
        new_state(method_of(tiny(f"feat.start={tmp_path / 'bad.pt'}")), ALONE)


def test_shards_without_classes_are_refused(tmp_path: Path) -> None:
    nameless = write_labelled(tmp_path / "shards", shapes=("bar", "disc"), objects=3, unnamed=True)
    with pytest.raises(BadInput, match=r"views\.parquet: the views have no category"):
        train(nameless, tmp_path / "run", tiny())


def test_held_out_episodes_do_not_depend_on_how_the_views_are_batched(shards: Path) -> None:
    method = method_of(tiny())
    network, held_out = new_state(method, ALONE).network, method.dataset(shards, "val")
    results = [
        method.validate(network, [held_out.batch(rows) for rows in batches], ALONE)
        for batches in ([list(range(24))], [list(range(start, 24, 5)) for start in range(5)])
    ]
    assert results[0] == results[1] and results[0]["pairs"] == 24 and network.training
    assert results[0]["chance"] == pytest.approx(1 / 3) and 0 < results[0]["accuracy"] < 1
    assert method.validate(network, [], ALONE)["pairs"] == 0


def test_held_out_views_that_make_no_episode_are_no_error(copy: Path, tmp_path: Path) -> None:
    rewrite(copy, lambda rows: [r.update(split="train") for r in rows if not r["sequence"].startswith("bar")])
    result = train(copy, tmp_path / "run", tiny(), stop_after=1)
    assert result["score"] is None


# -- evaluation


def test_episodes_are_classified_by_the_adapted_means(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(1)
    vectors = random.normal(0, 1, (80, 6)).astype(np.float32)
    groups = {f"c{c}": {f"o{o}": [20 * c + o] for o in range(20)} for c in range(4)}
    drawn = sample_episodes(groups, EpisodeConfig(ways=3, shots=2, queries=4, episodes=11))
    attention = attention_of(6).float().eval()
    found = adapted_nearest(attention, vectors, drawn, CPU)
    exact = attention_of(6)
    for e, way, i in np.ndindex(*drawn.query.shape):
        shots = np.array([vectors[rows].astype(np.float64).sum(0) / 2 for rows in drawn.support[e]])
        distances = [sum((p - vectors[drawn.query[e, way, i]]) ** 2) for p in naive_attention(exact, shots)]
        assert found[e, way, i] == int(np.argmin(distances))
    monkeypatch.setattr(feat_module, "AT_ONCE", 3)
    assert np.array_equal(found, adapted_nearest(attention, vectors, drawn, CPU))


def test_other_protocols_are_classified_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    embedder = FeatEmbedder(FeatNetwork(0.125).eval(), FeatConfig(ways=3), 32)
    assert (embedder.name, embedder.own_classifier) == ("feat", "attention")
    groups = {f"c{c}": {f"o{o}": [10 * c + o] for o in range(10)} for c in range(4)}
    vectors = np.random.default_rng(0).normal(0, 1, (40, 64)).astype(np.float32)
    drawn = sample_episodes(groups, EpisodeConfig(ways=3, shots=1, queries=2, episodes=2))
    assert embedder.classify(vectors, drawn).shape == (2, 3, 2) and not caplog.text
    embedder.classify(vectors, sample_episodes(groups, EpisodeConfig(ways=4, shots=5, queries=2, episodes=2)))
    assert "a FEAT of 3-way 1-shot episodes classifies 4-way 5-shot ones" in caplog.text


def test_loss_gradients_and_score_do_not_depend_on_the_number_of_ranks(shards: Path, tmp_path: Path) -> None:
    """Of SimpleShot as well."""
    root = Path(__file__).parents[2]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(root), "GLOO_SOCKET_IFNAME": "lo"}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    script = str(Path(many_ranks_episodes.__file__))
    arguments = [*command, script, str(shards), str(tmp_path)]
    done = subprocess.run(arguments, env=environment, timeout=200, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in many_ranks_episodes.METHODS:
        alone = many_ranks_episodes.outcome(shards, name, ALONE)
        for rank in range(2):
            found = torch.load(tmp_path / f"{name}-{rank}.pt")
            assert found["report"] == pytest.approx(alone["report"], abs=1e-5) and found["stop"]
            assert found["validation"] == pytest.approx(alone["validation"])
            for key, gradient in alone["gradients"].items():
                assert (found["gradients"][key] - gradient).abs().max() <= 1e-5 * max(1, gradient.abs().max()), key


def test_it_learns_and_recognises_classes_that_it_has_not_seen(tmp_path: Path) -> None:
    base = write_labelled(tmp_path / "base", objects=20, held_out=4, views=3)
    unseen = write_labelled(tmp_path / "unseen", shapes=UNSEEN, objects=16)
    shared = ["data.image_size=32", "network.width=0.25", "data.workers=0", "log.every=1", "device=cpu",
              "checkpoint.every=0", "validation.every=0"]  # fmt: skip
    supervised = [*shared, "data.batch_size=32", "optimiser.lr=2e-3", "schedule.max_steps=100"]
    train(base, tmp_path / "rfs", load_config("nano", None, supervised, method="rfs"))
    episodic = [*shared, "optimiser.lr=0.03", "feat.queries=6", "schedule.max_steps=90", f"feat.start={tmp_path}/rfs"]
    result = train(base, tmp_path / "feat", load_config("nano", None, episodic, method="feat"))
    curve = {name: [line[name] for line in read_metrics(tmp_path / "feat", "step")] for name in ("queries", "accuracy")}
    assert np.mean(curve["queries"][-25:]) < np.mean(curve["queries"][:25]) - 0.1
    assert np.mean(curve["accuracy"][-25:]) > 0.3
    config = EvaluationConfig(protocols=(EpisodeConfig(queries=10, episodes=400),), compare_untrained=True)
    trained, untrained = evaluate(Path(result["checkpoint"]), unseen, config).rows
    assert trained.accuracy - trained.ci95 > 0.2 + 0.02  # chance, and a little
    assert trained.accuracy - trained.ci95 > untrained.accuracy + untrained.ci95
    embedder, meta = load_embedder(Path(result["checkpoint"]))
    assert isinstance(embedder, FeatEmbedder) and len(meta["facts"]["classes"]) == 6


def test_a_step_shows_the_views_of_its_rows(shards: Path) -> None:
    config = tiny("data.batch_size=2")
    method = method_of(config)
    assert isinstance(method, Feat)
    dataset = method.dataset(shards, "train")
    index = read_view_index(shards, "train")
    for rows in islice(method.order(dataset).batches(Place(), 1), 2):
        labels = dataset.batch(rows).labels.view(2, 3, 3)
        assert (labels == labels[..., :1]).all()
        assert labels.flatten().tolist() == index.labels[rows].tolist()
