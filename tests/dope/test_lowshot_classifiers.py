"""Embedders of all kinds under all classifiers, and features that no result may come from."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tiny_views import write_views
from torch import Tensor

from dope.augmentation import AugmentationConfig
from dope.common.errors import DopeError, UsageError
from dope.lowshot.classifiers import logistic, nearest_vector
from dope.lowshot.embedding import Embedder
from dope.lowshot.encoding import ViewCells
from dope.lowshot.episodes import EpisodeConfig, Episodes, sample_episodes
from dope.lowshot.evaluate import EvaluationConfig, evaluate_embedders
from dope.lowshot.subjects import Subject, encoder_subject
from dope.lowshot.support_copies import SupportCopies
from dope.lowshot.views import ViewShards
from dope.lowshot.work import Work

PROTOCOL = EpisodeConfig(ways=3, shots=2, queries=2, episodes=6)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_views(tmp_path_factory.mktemp("shards"), size=32)


class MeanColour(Embedder):
    """The mean colour of a view, with a classifier of its own that is always wrong by one way."""

    name, own_classifier, image_size = "mean_colour", "cl2n", 32

    def pooled(self, images: Tensor) -> Tensor:
        return images.mean((2, 3)) - 0.5

    def classify(self, vectors: NDArray[np.float32], episodes: Episodes) -> NDArray[np.int64]:
        assert np.abs(vectors[np.unique(episodes.query)]).sum(1).min() > 0  # of every view that is needed
        ways = np.arange(episodes.config.ways)[None, :, None]
        return np.broadcast_to((ways + 1) % episodes.config.ways, episodes.query.shape)


class Dense(MeanColour):
    """Every cell's colour; `spoiled` cells of the views whose mean colour is the greatest are NaN."""

    name, own_classifier, has_dense = "colours", "local", True
    spoiled = slice(0, 0)

    def cells(self, images: Tensor) -> list[ViewCells]:
        grids = torch.nn.functional.avg_pool2d(images, 8).permute(0, 2, 3, 1) - 0.5
        found = []
        for grid in grids:
            flat = torch.nn.functional.normalize(grid.reshape(16, 3), dim=1)
            flat[self.spoiled] = torch.nan
            norms = np.linspace(1, 0.5, 16).astype(np.float32)
            described = flat[:4] * torch.from_numpy(norms[:4])[:, None]
            found.append(
                ViewCells(
                    (4, 4), np.arange(16), norms, described, flat[4:], lambda f, n: f * torch.from_numpy(n)[:, None]
                )
            )
        return found


def subject(embedder: Embedder, **more: Any) -> Subject:
    return encoder_subject(embedder, label="mine", sha256=None, config_hash="h")._replace(**more)


def run(embedder: Embedder, shards: Path, classifier: str = "auto", **changes: Any) -> Any:
    config = EvaluationConfig(protocols=(PROTOCOL,), classifier=classifier, **changes)  # type: ignore[arg-type]
    return evaluate_embedders([subject(embedder)], shards, config)


def test_auto_is_the_embedders_own_and_any_other_can_be_chosen(shards: Path) -> None:
    (own,) = run(MeanColour(), shards).rows
    assert (own.classifier, own.accuracy, own.method, own.checkpoint) == ("cl2n", 0.0, "mean_colour", "mine")
    rows = {name: run(MeanColour(), shards, name).rows[0] for name in ("centroid", "nearest", "logistic")}
    assert all(row.classifier == name and row.accuracy > 0 for name, row in rows.items())
    assert run(Dense(), shards).rows[0].classifier == "local"


def test_local_matching_of_pooled_features_is_refused(shards: Path) -> None:
    with pytest.raises(UsageError, match="--classifier local: mean_colour has no dense features"):
        run(MeanColour(), shards, "local")
    with pytest.raises(UsageError, match="has no dense features"):
        MeanColour().cells(torch.zeros(1, 3, 32, 32))


def test_several_embedders_see_the_same_episodes(shards: Path) -> None:
    config = EvaluationConfig(protocols=(PROTOCOL,), classifier="nearest")
    plain: Any = (MeanColour(), subject(MeanColour()).columns)  # a pair is enough
    rows = evaluate_embedders([subject(MeanColour()), plain, subject(Dense())], shards, config).rows
    assert rows[0] == rows[1] and rows[2].method == "colours" and rows[2].accuracy == rows[0].accuracy


def drawn_vectors(shots: int = 2) -> tuple[Episodes, NDArray[np.float32]]:
    population = {f"c{c}": {f"o{o}": [c * 5 + o] for o in range(5)} for c in range(4)}
    drawn = sample_episodes(population, EpisodeConfig(ways=3, shots=shots, queries=2, episodes=9))
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(20, 6)) + 1.5 * np.repeat(rng.normal(size=(4, 6)), 5, axis=0)
    return drawn, (vectors * rng.uniform(0.1, 9, (20, 1))).astype(np.float32)


def test_the_nearest_shot_is_that_of_the_greatest_cosine() -> None:
    drawn, vectors = drawn_vectors()
    predicted = nearest_vector(vectors, drawn)
    for e, way, i in np.ndindex(*drawn.query.shape):
        query = vectors[drawn.query[e, way, i]]
        cosines = [max(query @ vectors[s] / np.linalg.norm(vectors[s]) for s in drawn.support[e, w]) for w in range(3)]
        assert predicted[e, way, i] == int(np.argmax(cosines))


def test_logistic_regression_is_the_minimum_of_its_loss() -> None:
    """Predictions agree with a model fitted by plain gradient descent: sum of cross entropies + |W|^2 / 2."""
    drawn, vectors = drawn_vectors()
    predicted = logistic(vectors, drawn)
    units = torch.nn.functional.normalize(torch.from_numpy(vectors).double(), dim=1)
    for e in range(3):
        x, y = units[drawn.support[e].ravel()], torch.arange(3).repeat_interleave(2)
        weight, bias = torch.zeros(3, 6, dtype=torch.double), torch.zeros(3, dtype=torch.double)
        weight.requires_grad_(), bias.requires_grad_()
        optimiser = torch.optim.LBFGS([weight, bias], max_iter=500, tolerance_grad=1e-9)

        def loss(x: Tensor = x, y: Tensor = y, w: Tensor = weight, b: Tensor = bias, o: Any = optimiser) -> Tensor:
            o.zero_grad()
            value = torch.nn.functional.cross_entropy(x @ w.T + b, y, reduction="sum") + w.square().sum() / 2
            value.backward()
            return value

        optimiser.step(loss)  # type: ignore[arg-type]
        expected = (units[drawn.query[e]] @ weight.T + bias).argmax(-1)
        np.testing.assert_array_equal(predicted[e], expected.detach().numpy())


def test_copies_of_the_shots_are_learnt_from() -> None:
    drawn, vectors = drawn_vectors(shots=1)
    same = np.repeat(vectors[:, None], 2, axis=1)
    others = np.repeat(vectors[[(i + 5) % 20 for i in range(20)], None], 30, axis=1)  # of the next class
    assert (logistic(vectors, drawn) == logistic(vectors, drawn, copies=same)).mean() > 0.9
    assert (logistic(vectors, drawn) != logistic(vectors, drawn, copies=others)).any()


def copies_of(shards: Path, batch: int, count: int = 2, **changes: Any) -> NDArray[np.float32]:
    views = ViewShards(shards)
    drawn = sample_episodes(views.population(views.select()), PROTOCOL)
    work = Work(views, EvaluationConfig().matching, torch.device("cpu"), batch)
    vectors = SupportCopies(count, **changes).vectors(MeanColour(), [drawn], work)
    shots = np.unique(drawn.support)
    assert (vectors[np.setdiff1d(np.arange(len(views)), shots)] == 0).all()
    return vectors[shots]


def test_a_copy_is_a_function_of_view_number_and_seed(shards: Path) -> None:
    first = copies_of(shards, 16)
    np.testing.assert_array_equal(first, copies_of(shards, 1))
    np.testing.assert_array_equal(first[:, :1], copies_of(shards, 5, count=1))
    assert (first[:, 0] != first[:, 1]).any(1).all()
    assert (copies_of(shards, 16, seed=1) != first).any()
    still = AugmentationConfig(colour_p=0, flip_p=0, single_background_p=0)
    plain = copies_of(shards, 16, augmentation=still)
    np.testing.assert_allclose(plain[:, 0], plain[:, 1])  # nothing is left to differ in


def test_support_copies_are_a_column_and_no_part_of_the_protocol(shards: Path) -> None:
    (one,), (five,) = (run(MeanColour(), shards, "logistic", support_copies=n).rows for n in (1, 5))
    assert (one.support_copies, five.support_copies) == (1, 5) and one.accuracy != five.accuracy
    assert one.evaluation_hash == five.evaluation_hash
    assert five.classifier == "logistic" and five.classifier_in_words == "logistic, 5 copies a shot"


class Broken(MeanColour):
    """Features that are not finite for some views."""

    def __init__(self, value: float) -> None:
        self.value = value

    def pooled(self, images: Tensor) -> Tensor:
        vectors = super().pooled(images)
        vectors[-1, 1] = self.value
        return vectors


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("classifier", ["auto", "centroid", "nearest", "logistic"])
def test_pooled_features_that_are_not_finite_name_the_view(shards: Path, value: float, classifier: str) -> None:
    with pytest.raises(DopeError, match=r"--encoder mine: the features of view shape\d_object\d-00000\d .*NaN"):
        run(Broken(value), shards, classifier)


@pytest.mark.parametrize("spoiled", [slice(2, 3), slice(15, 16)])  # one is known at once, one is projected late
@pytest.mark.parametrize("memory_gib", [4.0, 0.0])
def test_dense_features_that_are_not_finite_name_the_view(shards: Path, spoiled: slice, memory_gib: float) -> None:
    embedder = Dense()
    embedder.spoiled = spoiled
    with pytest.raises(DopeError, match=r"--encoder mine: the features of view shape\d_object\d-00000\d .*NaN"):
        run(embedder, shards, memory_gib=memory_gib, spill="always")


def test_an_embedder_that_wants_masks_gets_those_of_the_views(shards: Path) -> None:
    views, seen = ViewShards(shards), []

    class Masked(MeanColour):
        wants_masks = True

        def pooled(self, images: Tensor, masks: Tensor | None = None) -> Tensor:
            assert masks is not None and masks.shape == (len(images), 32, 32) and masks.dtype == torch.bool
            seen.append(float(masks.float().mean()))
            return super().pooled(images)

    run(Masked(), shards, "nearest")
    shares = views.columns["mask_share"] if "mask_share" in views.columns else [views.mask(i).mean() for i in range(24)]
    assert min(shares) <= min(seen) and max(seen) <= max(shares)
    with pytest.raises(UsageError, match="--support-copies"):
        run(Masked(), shards, "logistic", support_copies=2)


def test_views_with_empty_masks_are_evaluated_and_copied(tmp_path: Path) -> None:
    shards = write_views(tmp_path, size=32)

    class NoMasks(ViewShards):
        def mask(self, index: int) -> NDArray[np.bool_]:
            return np.zeros((32, 32), np.bool_)

    views = NoMasks(shards)
    config = EvaluationConfig(protocols=(PROTOCOL,), classifier="logistic", support_copies=3)
    (row,) = evaluate_embedders([subject(MeanColour())], views, config).rows  # type: ignore[arg-type]
    assert np.isfinite(row.accuracy)


def test_rows_hold_what_the_columns_say(shards: Path) -> None:
    (row,) = run(MeanColour(), shards).rows
    assert {field.name for field in dataclasses.fields(row)} >= {"method", "run", "table", "table_split", "part"}
    assert (row.run, row.table, row.table_split, row.part) == ("", "", -1, "all")


def test_views_that_look_the_same_get_other_copies(shards: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the copies of all shots would share what is drawn."""
    first = ViewShards(shards)
    image, mask = first.image(0), first.mask(0)
    monkeypatch.setattr(ViewShards, "image", lambda self, index: image)
    monkeypatch.setattr(ViewShards, "mask", lambda self, index: mask)
    copies = copies_of(shards, 16, count=1)[:, 0]
    assert len(np.unique(copies.round(5), axis=0)) > len(copies) // 2
