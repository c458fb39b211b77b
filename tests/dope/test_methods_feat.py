"""FEAT: what a step learns from, where it starts, how it is validated and how it classifies."""

from __future__ import annotations

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
from naive_attention import attention_of, naive_attention
from tiny_labelled import UNSEEN, damage, rewrite, write_labelled

from dope.checkpoints import load_method
from dope.common.errors import BadInput, UsageError
from dope.config import TrainConfig, load_config
from dope.distributed import Ranks
from dope.lowshot.episodes import EpisodeConfig, sample_episodes
from dope.lowshot.evaluate import EvaluationConfig, evaluate
from dope.methods import feat as feat_module
from dope.methods import load_embedder, method_of
from dope.methods.configs import FeatConfig
from dope.methods.feat import Feat, FeatEmbedder, FeatNetwork, adapted_nearest
from dope.order import Place
from dope.run_logging import read_metrics
from dope.state import learning_rate, new_state, set_learning_rate
from dope.trainer import train
from dope.view_index import read_view_index

ALONE = Ranks(0, 1, torch.device("cpu"))
CPU = torch.device("cpu")
TINY = [
    "network.width=0.125", "data.image_size=32", "data.workers=0", "feat.ways=3", "feat.queries=2", "feat.episodes=4",
    "schedule.epochs=2", "validation.every=1", "checkpoint.every=0", "log.every=1", "device=cpu",
]  # fmt: skip
NAMES = ("bar", "disc", "ring", "square")


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


def begun(config: TrainConfig) -> FeatNetwork:
    """The network of a run before its first step."""
    method = method_of(config)
    network = new_state(method, ALONE).network
    method.start(network, {})
    assert isinstance(network, FeatNetwork)
    return network


def test_the_regulariser_of_one_shot_is_told_where_there_are_more(caplog: pytest.LogCaptureFixture) -> None:
    begun(tiny())
    begun(tiny("feat.shots=5", "feat.balance=0.1", "feat.centre_temperature=16"))
    assert "feat.balance" not in caplog.text
    begun(tiny("feat.shots=5"))
    assert "for 5 it is 0.1, feat.centre_temperature 16" in caplog.text


def test_it_starts_with_the_encoder_of_simpleshot_or_rfs(shards: Path, tmp_path: Path) -> None:
    supervised = ("network.width=0.125", "data.image_size=32", "data.batch_size=4", "data.workers=0", "device=cpu")
    for method in ("simpleshot", "rfs"):
        config = load_config("nano", None, [*supervised, "validation.every=0"], method=method)
        train(shards, tmp_path / method, config, stop_after=2)
        theirs = load_method(tmp_path / method)[1].encoder.state_dict()  # type: ignore[union-attr]
        config = tiny(f"feat.start={tmp_path / method}", "validation.every=0")
        ours = begun(config).encoder.state_dict()
        assert ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours)
        assert any("running_mean" in key and bool(value.any()) for key, value in ours.items())
    result = train(shards, tmp_path / "feat", config, stop_after=1)
    assert load_method(Path(result["checkpoint"]))[0].name == "feat"
    shutil.rmtree(tmp_path / "rfs")  # what it began with is needed only once
    assert train(shards, tmp_path / "feat", config, stop_after=1)["step"] == 2


def test_what_it_cannot_start_with_is_refused(shards: Path, tmp_path: Path) -> None:
    train(shards, tmp_path / "feat", tiny("validation.every=0"), stop_after=1)
    with pytest.raises(UsageError, match=r"feat\.start=.*step-00000001\.pt: is of method feat.*--method simpleshot"):
        begun(tiny(f"feat.start={tmp_path / 'feat'}"))
    settings = ("data.image_size=32", "data.batch_size=4", "data.workers=0", "device=cpu", "validation.every=0")
    wide = load_config("nano", None, [*settings, "network.width=0.25"], method="simpleshot")
    train(shards, tmp_path / "wide", wide, stop_after=1)
    with pytest.raises(UsageError, match=r"network\.width 0\.25, this run 0\.125.*--set network\.width=0\.25"):
        begun(tiny(f"feat.start={tmp_path / 'wide'}"))
    with pytest.raises(BadInput, match="nowhere: no such file or folder"):
        train(shards, tmp_path / "new", tiny(f"feat.start={tmp_path / 'nowhere'}"))
    (tmp_path / "bad.pt").write_bytes(b"no checkpoint")
    with pytest.raises(BadInput, match=r"bad\.pt"):
        begun(tiny(f"feat.start={tmp_path / 'bad.pt'}"))


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
