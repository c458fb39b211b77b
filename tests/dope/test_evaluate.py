from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from numpy.typing import NDArray
from tiny_views import write_views
from torch import Tensor, nn

from dope.common.errors import BadInput, UsageError
from dope.config import load_config
from dope.lowshot.classifiers import classify, nearest_centroid
from dope.lowshot.embedding import DopeEmbedder
from dope.lowshot.episodes import EpisodeConfig, sample_episodes
from dope.lowshot.evaluate import EvaluationConfig, evaluate, mean_and_ci95
from dope.lowshot.matching import MatchingConfig
from dope.lowshot.results import ResultRow, append_rows, read_rows, results_table
from dope.lowshot.views import ViewShards
from dope.lowshot.work import Work
from dope.methods import method_of
from dope.networks import NetworkConfig, NetworkOutput
from dope.networks.untrained import settle_batchnorm, untrained_network

NETWORK = NetworkConfig(width=0.125, pyramid=16, projector=(24, 12))
PROTOCOL = EpisodeConfig(ways=3, shots=1, queries=3, episodes=20)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_views(tmp_path_factory.mktemp("shards"))


class ColourNetwork(nn.Module):
    """Descriptors are the colours of the stride-4 image; the object is what lies around the image's middle."""

    def forward(self, images: Tensor) -> NetworkOutput:
        colours = nn.functional.avg_pool2d(images, 4)
        mask = torch.full_like(colours[:, :1], -6.0)
        mask[:, :, 4:12, 4:12] = 6.0
        return NetworkOutput(colours - 0.5, mask)

    def project(self, cell_features: Tensor) -> Tensor:
        return cell_features

    def descriptors(self, images: Tensor) -> Tensor:
        features, logits = self(images)
        return nn.functional.normalize(features, dim=1) * logits.sigmoid()


class ColouredViews(ViewShards):
    """Every category has a colour of its own, with noise."""

    def image(self, index: int) -> NDArray[np.uint8]:
        category = int(self.columns["category"][index][-1])
        image = np.full((64, 64, 3), 40, np.float32)
        image[..., category] = 200
        noise = np.random.default_rng(index).normal(0, 25, image.shape)
        return np.clip(image + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("classifier", ["local", "centroid", "nearest", "logistic"])
def test_what_is_told_apart_by_colour_is_recognised_by_colour(shards: Path, classifier: str) -> None:
    views = ColouredViews(shards)
    drawn = sample_episodes(views.population(views.select()), PROTOCOL)
    work = Work(views, MatchingConfig(points=6), torch.device("cpu"), batch=5, memory_gib=1.0)
    embedder = DopeEmbedder(ColourNetwork(), None)  # type: ignore[arg-type]
    (predicted,) = classify(classifier, embedder, [drawn], work)
    np.testing.assert_array_equal(predicted, np.broadcast_to(np.arange(3)[None, :, None], predicted.shape))
    assert work.encoded == len(np.unique(np.concatenate([drawn.query.ravel(), drawn.support.ravel()])))


def test_centroid_is_the_class_mean_by_cosine() -> None:
    population = {f"c{c}": {f"o{o}": [c * 4 + o] for o in range(4)} for c in range(3)}
    drawn = sample_episodes(population, EpisodeConfig(ways=3, shots=2, queries=2, episodes=9))
    vectors = np.random.default_rng(0).normal(size=(12, 5)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    predicted = nearest_centroid(vectors, drawn)
    for e, way, i in np.ndindex(*drawn.query.shape):
        query = vectors[drawn.query[e, way, i]]
        means = [vectors[drawn.support[e, w]].mean(0) for w in range(3)]
        cosines = [query @ mean / np.linalg.norm(mean) for mean in means]
        assert predicted[e, way, i] == int(np.argmax(cosines))


def test_mean_and_interval_in_closed_form() -> None:
    mean, ci95 = mean_and_ci95(np.array([0.0, 1.0, 0.0, 1.0]))
    assert mean == 0.5 and ci95 == pytest.approx(1.96 * 0.5 / 2)


def test_a_row_says_what_was_measured(shards: Path) -> None:
    protocol = replace(PROTOCOL, ways=9, queries=15, fit=True)
    result = evaluate(None, shards, EvaluationConfig(protocols=(protocol,), split="train"), network=NETWORK)
    (row,) = result.rows
    assert (row.ways, row.queries, row.asked_ways, row.asked_queries) == (3, 2, 9, 15)
    assert (row.n_classes, row.n_objects, row.n_views, row.split) == (3, 9, 18, "train")
    assert (row.network, row.checkpoint, row.chance) == ("untrained", None, 1 / 3)
    assert row.accuracy == result.accuracies[0].mean() and len(result.accuracies[0]) == 20


def test_instances_are_counted_as_classes(shards: Path) -> None:
    protocol = EpisodeConfig(ways=5, queries=1, episodes=5, classes="instance")
    (row,) = evaluate(None, shards, EvaluationConfig(protocols=(protocol,)), network=NETWORK).rows
    assert (row.n_classes, row.n_objects, row.n_views) == (12, 12, 24)


def test_categories_can_be_chosen_and_unknown_ones_are_explained(shards: Path) -> None:
    config = EvaluationConfig(protocols=(replace(PROTOCOL, ways=2),), categories=("shape0", "shape2"))
    assert evaluate(None, shards, config, network=NETWORK).rows[0].n_classes == 2
    with pytest.raises(UsageError, match="did you mean 'shape1'"):
        evaluate(None, shards, replace(config, categories=("shpe1",)), network=NETWORK)
    with pytest.raises(UsageError, match="no protocol"):
        evaluate(None, shards, EvaluationConfig(protocols=()), network=NETWORK)


def test_a_checkpoint_is_compared_with_random_weights_in_the_same_episodes(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = tmp_path / "step-00000003.pt"
    settings = replace(load_config("nano", None, ["data.image_size=32"]), network=NETWORK)
    meta = {"path": str(checkpoint), "sha256": "ab", "step": 3, "config_hash": "cd", "facts": {}, "config": {}}
    meta["dataset"] = "ef"
    loaded = []

    def load(path: Path, device: object) -> tuple[object, nn.Module, dict[str, object]]:
        loaded.append(path)
        return method_of(settings), untrained_network(NETWORK, seed=5), dict(meta)

    monkeypatch.setattr("dope.checkpoints.load_method", load)
    config = EvaluationConfig(protocols=(PROTOCOL,), compare_untrained=True)
    trained, untrained = evaluate(checkpoint, shards, config).rows
    assert loaded == [checkpoint]
    assert (trained.network, trained.checkpoint_sha256, trained.step) == ("trained", "ab", 3)
    assert (untrained.network, untrained.checkpoint_sha256, untrained.step) == ("untrained", None, None)
    alone = evaluate(None, shards, EvaluationConfig(protocols=(PROTOCOL,), image_size=32), network=NETWORK).rows[0]
    assert untrained.accuracy == alone.accuracy  # the same random weights, episodes and image size


def test_untrained_weights_are_a_function_of_the_seed_and_leave_the_global_state_alone() -> None:
    torch.manual_seed(1)
    expected = torch.rand(1)
    torch.manual_seed(1)
    first, same, other = (untrained_network(NETWORK, seed) for seed in (0, 0, 1))
    assert torch.equal(torch.rand(1), expected)
    weights = [network.state_dict()["backbone.conv1.weight"] for network in (first, same, other)]
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])
    assert not first.training


def test_settling_gives_batchnorm_the_statistics_of_the_images() -> None:
    network = untrained_network(NETWORK, seed=0)
    images = torch.rand(8, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    settle_batchnorm(network, [images])
    x = network.backbone.conv1(images)
    torch.testing.assert_close(network.backbone.bn1.running_mean, x.mean((0, 2, 3)), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(network.backbone.bn1.running_var, x.var((0, 2, 3)), rtol=1e-4, atol=1e-5)
    assert network.backbone.bn1.momentum == 0.1 and not network.backbone.bn1.training
    soft = network.masks(images).detach()
    assert 0.05 < float(soft.mean()) < 0.95 and float(soft.std()) > 1e-3  # neither saturated nor constant


def test_views_without_categories_are_explained(tmp_path: Path) -> None:
    folder = write_views(tmp_path, objects=2, with_category=False)
    with pytest.raises(UsageError, match="--classes instance"):
        evaluate(None, folder, EvaluationConfig(protocols=(PROTOCOL,)), network=NETWORK)
    instances = replace(PROTOCOL, classes="instance", queries=1)
    (row,) = evaluate(None, folder, EvaluationConfig(protocols=(instances,)), network=NETWORK).rows
    assert row.n_classes == 6


def test_bad_shards_are_named(tmp_path: Path, shards: Path) -> None:
    with pytest.raises(BadInput, match="no such folder"):
        ViewShards(tmp_path / "absent")
    with pytest.raises(BadInput, match=r"views\.parquet"):
        ViewShards(tmp_path)
    (tmp_path / "views.parquet").write_bytes(b"PAR1 nonsense")
    with pytest.raises(BadInput, match="cannot be read"):
        ViewShards(tmp_path)
    table = pq.read_table(shards / "views.parquet")
    pq.write_table(table.drop_columns(["offset"]), tmp_path / "views.parquet")
    with pytest.raises(BadInput, match="lacks the columns offset"):
        ViewShards(tmp_path)
    pq.write_table(table.slice(0, 0), tmp_path / "views.parquet")
    with pytest.raises(BadInput, match="has no views"):
        ViewShards(tmp_path)
    pq.write_table(table, tmp_path / "views.parquet")
    with pytest.raises(BadInput, match=r"views-000000\.tar"):
        ViewShards(tmp_path).read(0)
    with pytest.raises(UsageError, match="no views of split 'test'"):
        ViewShards(shards).select("test")
    with pytest.raises(UsageError, match="did you mean 'shape1_object2'"):
        ViewShards(shards).of_sequence("shape1object2")


def test_a_view_is_read_as_it_was_written(shards: Path) -> None:
    views = ViewShards(shards)
    view = views.read(9)
    assert view.info == {"sequence": "shape1_object0", "frame": 1}
    assert view.image.shape == (64, 64, 3) and view.mask.dtype == np.bool_
    assert view.mask.mean() == pytest.approx(views.columns["mask_share"][9])
    small = next(views.batches([9, 3], 2, image_size=32))
    assert small.shape == (2, 32, 32, 3)
    np.testing.assert_allclose(small[0].mean((0, 1)), view.image.mean((0, 1)), atol=1)
    batches = list(views.batches(list(range(24)), 5))
    assert [len(batch) for batch in batches] == [5, 5, 5, 5, 4]
    np.testing.assert_array_equal(np.concatenate(batches)[9], view.image)


def test_the_fingerprint_changes_with_a_shards_hash(tmp_path: Path) -> None:
    folder = write_views(tmp_path, categories=1, objects=1)
    without = ViewShards(folder).fingerprint
    manifest = folder / "dataset.json"
    seen = {without}
    for digest in ("1", "2"):
        manifest.write_text(
            json.dumps({"shards": {"views-000000.tar": {"sha256": digest}, "train-0.tar": {"sha256": digest}}})
        )
        seen.add(ViewShards(folder).fingerprint)
    assert len(seen) == 3
    manifest.write_text(json.dumps({"shards": {"views-000000.tar": {"sha256": "2"}, "train-0.tar": {"sha256": "9"}}}))
    assert ViewShards(folder).fingerprint in seen  # training pairs are not what is evaluated


def row(**changes: object) -> ResultRow:
    base = ResultRow(
        network="trained", classifier="local", classes="category", ways=5, shots=1, shot_mode="several_instances",
        queries=15, episodes=2500, seed=0, accuracy=0.6276, ci95=0.0041, chance=0.2, n_classes=10, n_objects=300,
        n_views=3000, asked_ways=5, asked_queries=15, split="all", dataset="d", checkpoint="step-1.pt",
        checkpoint_sha256="s", step=1, config_hash="c", evaluation_hash="e",
    )  # fmt: skip
    return replace(base, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("suffix", [".parquet", ".json"])
def test_rows_are_appended_and_a_repeated_measurement_replaced(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"results{suffix}"
    append_rows(path, [row(), row(network="untrained", checkpoint=None, checkpoint_sha256=None, step=None)])
    rows = append_rows(path, [row(shots=5), row(accuracy=0.7)])
    assert read_rows(path) == rows
    assert [(r.shots, r.network, r.accuracy) for r in rows] == [
        (1, "trained", 0.7),
        (1, "untrained", 0.6276),
        (5, "trained", 0.6276),
    ]
    first = path.read_bytes()
    append_rows(path, [])
    assert path.read_bytes() == first


def test_files_that_are_no_results_are_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"\.parquet or \.json"):
        append_rows(tmp_path / "results.csv", [row()])
    with pytest.raises(BadInput, match="no such file"):
        read_rows(tmp_path / "results.parquet")
    (tmp_path / "broken.parquet").write_bytes(b"nonsense")
    with pytest.raises(BadInput, match=r"broken\.parquet"):
        read_rows(tmp_path / "broken.parquet")
    pq.write_table(pa.table({"accuracy": [0.5]}), tmp_path / "other.parquet")
    with pytest.raises(BadInput, match="result rows"):
        append_rows(tmp_path / "other.parquet", [row()])
    (tmp_path / "other.json").write_text(json.dumps({"a": 1}))
    with pytest.raises(BadInput, match="result rows"):
        read_rows(tmp_path / "other.json")


def test_the_table_fits_a_terminal_and_shows_accuracy_beside_chance() -> None:
    from rich.console import Console

    def shown(*rows: ResultRow) -> str:
        console = Console(width=80, record=True, file=io.StringIO())
        console.print(results_table(rows))
        return console.export_text()

    text = shown(row(), row(network="untrained", step=None, shots=5))
    assert "62.76 ± 0.41" in text and "20.0" in text and "5-way 1-shot" in text and "trained, step 1" in text
    assert "10 categories, 3000 views (all), local matching, 15 queries a class, 2,500 episodes" in " ".join(
        text.split()
    )
    reduced = shown(row(ways=3, shots=5, shot_mode="one_instance"))
    assert "of one object" in reduced and "5-way)" in reduced
    named = shown(row(method="a[1].py:f"), row(method="[b].py:f"), row(table="[x]", table_split=0))
    assert "a[1].py:f" in named and "[b].py:f" in named and "[x]" in named
    several = shown(row(), row(classes="instance", n_classes=30))
    assert "30 objects" in several and "10 categories" in several
