"""SupMoCo: the loss against a loop, which views are keys, what is remembered with which label, damaged views."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from tiny_drawn import draw_views, with_manifest
from tiny_method_runs import better_than_chance, same_after_a_stop, tiny_method
from tiny_views import write_views
from torch import Tensor

from dope.augmentation import Share
from dope.common.errors import UsageError
from dope.config import load_config
from dope.distributed import Ranks
from dope.methods import method_of
from dope.methods.class_keys import ClassKeys, KeyedOrder
from dope.methods.queue import NO_CLASS
from dope.methods.supmoco import nearest_of_others, one_of_each, supmoco_losses
from dope.order import Place, SampleOrder
from dope.state import new_state

ALONE = Ranks(0, 1, torch.device("cpu"))


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three categories of three objects each for training, of two views each, and one held out."""
    return with_manifest(write_views(tmp_path_factory.mktemp("views"), size=32))


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def units(*shape: int, seed: int = 0) -> Tensor:
    values = torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return F.normalize(values, dim=-1)


def test_the_loss_is_that_of_a_loop() -> None:
    q, keys, queue, t = units(4, 6), units(4, 3, 6, seed=1), units(9, 6, seed=2), 0.3
    labels = [0, 1, 7, NO_CLASS]
    key_labels = [[0, 0, 0], [1, 2, 1], [3, 3, 3], [NO_CLASS] * 3]  # of another class: in place of a damaged view
    queue_labels = [0, 1, 1, 2, 0, 0, NO_CLASS, NO_CLASS, 3]
    each, counted = supmoco_losses(
        q, torch.tensor(labels), keys, torch.tensor(key_labels), queue, torch.tensor(queue_labels), t
    )
    for i in range(2):
        positives = [float(q[i] @ keys[i, p]) / t for p in range(3) if key_labels[i][p] == labels[i]]
        positives += [float(q[i] @ queue[j]) / t for j in range(9) if queue_labels[j] == labels[i]]
        mean = sum(positives) / len(positives)
        total = math.exp(mean) + sum(math.exp(float(q[i] @ old) / t) for old in queue)
        assert each[i].item() == pytest.approx(-math.log(math.exp(mean) / total), abs=1e-12)
    assert counted.tolist() == [True, True, False, False], "without a class, and without any positive"
    assert torch.isfinite(each).all()


def test_keys_are_of_the_querys_class_and_the_first_of_another_object() -> None:
    random = np.random.default_rng(0)
    labels = np.array([0] * 7 + [1] * 5 + [2] * 2 + [3])
    objects = np.array([4, 4, 4, 1, 1, 9, 9, 0, 0, 2, 2, 2, 6, 6, 7])
    shuffled = random.permutation(len(labels))
    labels, objects = labels[shuffled], objects[shuffled]
    choice = ClassKeys(labels, objects)
    first: dict[int, Counter[int]] = {row: Counter() for row in range(15)}
    rest: dict[int, Counter[int]] = {row: Counter() for row in range(15)}
    for _ in range(2000):
        keys = choice.draw(np.arange(15), 3, random)
        assert (labels[keys] == labels[:, None]).all()
        for row, (one, *others) in enumerate(keys.tolist()):
            first[row][one] += 1
            rest[row].update(others)
    for row in range(15):
        alike = np.flatnonzero(labels == labels[row]).tolist()
        assert set(rest[row]) == set(alike), "drawn from all of the class"
        assert min(rest[row].values()) > 0.7 * 4000 / len(alike), "evenly"
        others = [other for other in alike if objects[other] != objects[row]]
        if labels[row] == 2:  # one object of two views: the other view of it
            assert set(first[row]) == {other for other in alike if other != row}
        elif labels[row] == 3:  # one view in all
            assert set(first[row]) == {row}
        else:
            assert set(first[row]) == set(others)
    # of class 0, objects 1 and 9 are equally likely for object 4
    row = int(np.flatnonzero(objects == 4)[0])
    of_object = Counter(int(objects[k]) for k in first[row].elements())
    assert of_object[1] / 2000 == pytest.approx(0.5, abs=0.05)


def test_the_order_is_the_queries_and_then_their_keys_whatever_the_ranks(shards: Path) -> None:
    method = method_of(tiny_method("supmoco", "data.pairs_per_object=2"))
    dataset = method.dataset(shards, "train")
    order = method.order(dataset)
    whole = list(order.batches(Place(), 2))
    assert order.steps_per_epoch == 4 and len(whole) == 8 and all(len(rows) == 4 + 12 for rows in whole)
    halves = [list(order.batches(Place(), 2, rank=rank, world=2)) for rank in (0, 1)]
    for rows, (one, other) in zip(whole, zip(*halves, strict=True), strict=True):
        assert rows == [*one[:2], *other[:2], *one[2:], *other[2:]]
        labels, objects = dataset.index.labels[rows], dataset.index.objects[rows]
        for i in range(4):
            keys = range(4 + 3 * i, 7 + 3 * i)
            assert (labels[list(keys)] == labels[i]).all() and objects[keys[0]] != objects[i]
    place = Place()
    for _ in range(5):
        place = order.after(place)
    assert place == Place(1, 4) and list(order.batches(place, 2)) == whole[5:]
    assert list(method.order(dataset).batches(Place(), 2)) == whole
    with pytest.raises(UsageError, match=r"data.batch_size: 4 samples a step cannot be divided among 3 ranks"):
        order.batches(Place(), 1, rank=0, world=3)


def test_the_same_queries_have_other_keys_in_other_epochs_and_steps() -> None:
    class Constant(SampleOrder):
        def epoch(self, epoch: int) -> NDArray[np.int64]:
            return np.tile(np.arange(10), (2, 1))

    labels, objects = np.zeros(20, int), np.arange(20)
    choice = ClassKeys(labels, objects)
    order = KeyedOrder(Constant(objects, 10), choice, 3, seed=1)
    drawn = [rows[10:] for rows in order.batches(Place(), 2)]
    assert len({tuple(keys) for keys in drawn}) == 4
    assert drawn != [rows[10:] for rows in KeyedOrder(Constant(objects, 10), choice, 3, seed=2).batches(Place(), 2)]


def test_augmentation_is_that_of_the_whole_batch(shards: Path) -> None:
    method = method_of(tiny_method("supmoco"))
    dataset = method.dataset(shards, "train")
    order = method.order(dataset)
    (rows, *_) = order.batches(Place(), 1)
    whole = method.prepare(dataset.batch(rows), 7)
    assert len(whole.queries) == 4 and len(whole.keys) == 12
    parts = []
    for rank in (0, 1):
        (mine, *_) = order.batches(Place(), 1, rank=rank, world=2)
        parts.append(method.prepare(dataset.batch(mine), 7, Share(rank, 2)))
    for name in ("queries", "keys"):
        ours = torch.cat([getattr(part, name).images for part in parts])
        assert torch.equal(ours, getattr(whole, name).images)
        assert torch.cat([getattr(p, name).labels for p in parts]).tolist() == getattr(whole, name).labels.tolist()


def test_one_key_of_each_query_is_remembered_with_its_label(shards: Path) -> None:
    method = method_of(tiny_method("supmoco", "supmoco.queue=10"))
    dataset, state = method.dataset(shards, "train"), new_state(method, ALONE)
    began = state.momentum.queue.keys.clone()
    (rows, *_) = method.order(dataset).batches(Place(), 1)
    batch = method.prepare(dataset.batch(rows), 0)
    keys = state.momentum(batch.keys.images)
    method.losses(method.online(state.network), state.momentum, batch, ALONE).backward()
    assert torch.equal(state.momentum.queue.keys, began), "enqueued only after the step"
    assert all(p.grad is None and not p.requires_grad for p in state.momentum.parameters())
    method.after_step(state.network, state.momentum)
    queue = state.momentum.queue
    for i in range(4):
        assert any(torch.allclose(queue.keys[i], key, atol=1e-6) for key in keys[3 * i : 3 * i + 3])
    assert torch.equal(queue.labels[:4], batch.queries.labels)
    assert (queue.labels[4:] == NO_CLASS).all() and torch.equal(queue.keys[4:], began[4:])


def test_which_key_is_remembered_is_drawn() -> None:
    keys, labels = torch.arange(3000.0)[:, None], torch.arange(3000) // 3
    chosen, of = one_of_each(keys, labels, 3, seed=1)
    assert torch.equal(chosen[:, 0].long() // 3, torch.arange(1000)) and torch.equal(of, torch.arange(1000))
    assert (chosen[:, 0].long() % 3).bincount().tolist() == pytest.approx([333] * 3, abs=60)
    assert torch.equal(one_of_each(keys, labels, 3, seed=1)[0], chosen)
    assert not torch.equal(one_of_each(keys, labels, 3, seed=2)[0], chosen)


def test_views_without_a_class_have_no_part_in_the_loss(shards: Path) -> None:
    """As where a rank's whole share is damaged, which stops the run only after the losses are computed."""
    method = method_of(tiny_method("supmoco"))
    dataset, state = method.dataset(shards, "train"), new_state(method, ALONE)
    (rows, *_) = method.order(dataset).batches(Place(), 1)
    loaded = dataset.batch(rows)
    none = replace(loaded, labels=torch.full_like(loaded.labels, -1))
    losses = method.losses(method.online(state.network), state.momentum, method.prepare(none, 0), ALONE)
    losses.backward()
    assert losses.report["loss"] == 0
    assert all(p.grad is None or (p.grad == 0).all() for p in state.network.parameters())
    state.network.eval(), state.momentum.eval()
    online = method.online(state.network)
    some = loaded.labels.clone()
    some[0], some[4:7] = -1, -1
    prepared = method.prepare(replace(loaded, labels=some), 0)
    report = method.losses(online, state.momentum, prepared, ALONE).report
    whole = method.prepare(loaded, 0)
    queries = online(whole.queries.images)[0]
    keys = state.momentum(whole.keys.images).view(4, 3, -1)
    queue = state.momentum.queue
    each, _ = supmoco_losses(
        queries, loaded.labels[:4], keys, loaded.labels[4:].view(4, 3), queue.keys, queue.labels, 0.07
    )
    assert report["loss"] == pytest.approx(each[1:].mean().item(), rel=1e-4), "the mean over those that have a class"


def test_accuracy_counts_views_whose_neighbour_of_another_object_is_of_the_class() -> None:
    vectors = F.normalize(torch.tensor([[1.0, 0], [1, 0.01], [1, 0.1], [0, 1], [0.1, 1], [0.75, 1]]), dim=1)
    labels, objects = torch.tensor([0, 0, 0, 1, 1, 0]), torch.tensor([0, 0, 1, 2, 3, 4])
    found = nearest_of_others(vectors, labels, objects)
    # the last view lies nearer to class 1
    assert found["pairs"] == 6 and found["accuracy"] == pytest.approx(5 / 6)
    assert found["chance"] == pytest.approx((2 / 4 + 2 / 4 + 3 / 5 + 1 / 5 + 1 / 5 + 3 / 5) / 6)
    alone = nearest_of_others(vectors, labels, torch.tensor([0, 0, 0, 1, 2, 0]))
    assert alone["pairs"] == 2, "a class of one object has no neighbour to find"
    assert nearest_of_others(vectors, labels, torch.zeros(6, dtype=torch.long))["pairs"] == 0
    same = torch.ones(4, 1)
    assert nearest_of_others(same, torch.tensor([0, 0, 1, 1]), torch.arange(4))["accuracy"] == 0, "a tie is no hit"


def test_what_evaluation_sees_is_the_encoder_without_the_head() -> None:
    method = method_of(tiny_method("supmoco"))
    network = new_state(method, ALONE).network.eval()
    embedder, images = method.embedder(network), torch.rand(2, 3, 32, 32)
    assert (embedder.name, embedder.own_classifier) == ("supmoco", "logistic")
    torch.testing.assert_close(embedder.pooled(images), network.encoder(images))
    assert [m.out_features for m in network.head if hasattr(m, "out_features")] == [network.encoder.dim, 8]


def test_presets_are_the_papers() -> None:
    config = load_config("paper", method="supmoco")
    settings = config.supmoco
    assert (settings.keys, settings.queue, settings.temperature, settings.head) == (3, 4096, 0.07, 128)
    assert (config.optimiser.name, config.optimiser.lr, config.optimiser.momentum) == ("sgd", 0.05, 0.9)
    assert (config.optimiser.weight_decay, config.schedule.epochs, config.data.batch_size) == (1e-4, 2000, 256)
    assert (config.momentum, config.schedule.shape) == (0.999, "cosine")


def test_settings_that_make_no_sense_are_refused() -> None:
    for wrong in ("supmoco.keys=0", "supmoco.queue=0", "supmoco.temperature=0", "supmoco.head=0"):
        with pytest.raises(UsageError, match=f"^{wrong.split('=')[0]}: "):
            load_config("nano", None, [wrong], method="supmoco")
    with pytest.raises(UsageError, match=r"distributed.local_negatives: cannot be used by supmoco"):
        method_of(tiny_method("supmoco", "distributed.local_negatives=true"))


def test_a_run_that_was_stopped_ends_with_the_same_weights_and_queue(shards: Path, tmp_path: Path) -> None:
    same_after_a_stop(shards, tmp_path, tiny_method("supmoco", "supmoco.queue=10"))


@pytest.mark.timeout(240)
def test_it_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shards = draw_views(tmp_path / "views", monkeypatch, categories=8, objects=6, held_out=6)
    better_than_chance(shards, tmp_path / "run", "supmoco", "schedule.max_steps=60")
