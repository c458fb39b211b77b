"""VISPE++ with MoCo: the loss against a loop, the queue, and the order of things in a step as MoCo has it."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from tiny_drawn import draw_pairs, with_manifest
from tiny_method_runs import better_than_chance, same_after_a_stop, tiny_method
from tiny_shards import write_shards
from tiny_views import write_views
from torch import Tensor, nn

from dope.common.errors import UsageError
from dope.config import load_config
from dope.distributed import Ranks
from dope.methods import method_of
from dope.methods.pairs import retrieval
from dope.methods.queue import NO_CLASS, KeyEncoder, KeyQueue
from dope.methods.vispe_moco import moco_loss
from dope.networks.batchnorm import batchnorms
from dope.order import Place
from dope.state import new_state
from dope.trainer import train

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


def test_the_loss_is_that_of_a_loop() -> None:
    queries, keys, queue, temperature = units(5, 8), units(5, 8, seed=1), units(7, 8, seed=2), 0.2
    total = 0.0
    for query, key in zip(queries, keys, strict=True):
        own = math.exp(float(query @ key) / temperature)
        others = sum(math.exp(float(query @ old) / temperature) for old in queue)
        total -= math.log(own / (own + others))
    assert moco_loss(queries, keys, queue, temperature).item() == pytest.approx(total / 5, abs=1e-12)


@pytest.mark.parametrize("sizes", [[4, 4, 4], [3, 3, 3, 3], [10, 1, 10], [2, 25]])
def test_the_queue_is_first_in_first_out_and_wraps(sizes: list[int]) -> None:
    size, queue = 10, KeyQueue(10, 2, seed=0)
    began = queue.keys.clone()
    assert (queue.labels == NO_CLASS).all()
    seen: list[int] = []
    for n in sizes:
        new = torch.arange(len(seen), len(seen) + n)
        queue.enqueue(new[:, None].expand(n, 2).float(), new)
        seen += new.tolist()
        places = {int(label): place for place, label in enumerate(queue.labels) if label != NO_CLASS}
        assert sorted(places) == seen[-size:], "the newest are there and nothing else"
        assert all(place == label % size for label, place in places.items()), "each has replaced the oldest"
        known = queue.labels != NO_CLASS
        assert torch.equal(queue.keys[known][:, 0], queue.labels[known].float()), "a label stays with its key"
        assert torch.equal(queue.keys[~known], began[~known])
    assert int(queue.place) == len(seen) % size
    queue.enqueue(torch.zeros(1, 2))
    assert int(queue.labels[len(seen) % size]) == NO_CLASS, "a key without a label takes none over from the one before"


def test_the_queue_begins_with_unit_vectors_of_the_seed() -> None:
    first, again, other = KeyQueue(6, 4, seed=1), KeyQueue(6, 4, seed=1), KeyQueue(6, 4, seed=2)
    assert torch.equal(first.keys, again.keys) and not torch.equal(first.keys, other.keys)
    torch.testing.assert_close(first.keys.norm(dim=1), torch.ones(6))


def test_steps_are_those_of_mocos_algorithm(shards: Path) -> None:
    """Algorithm 1 of MoCo, with the copy moved before it makes keys, against three steps of ours."""
    config = tiny_method("vispe_moco", "moco.queue=6", "momentum=0.7", "optimiser.name=sgd")
    method = method_of(config)
    dataset = method.dataset(shards, "train")
    state = new_state(method, ALONE)
    network, queue = copy.deepcopy(state.network), state.momentum.queue.keys.clone()
    slow = copy.deepcopy(network)
    optimiser = torch.optim.SGD(network.parameters(), 0.05, momentum=0.9, weight_decay=config.optimiser.weight_decay)
    state.optimiser.param_groups[0]["lr"] = 0.05
    for step, rows in zip(range(3), method.order(dataset).batches(Place(), 9), strict=False):
        batch = method.prepare(dataset.batch(rows), step)
        losses = method.losses(method.online(state.network), state.momentum, batch, ALONE, step=step)
        assert not [p for p in state.momentum.parameters() if p.requires_grad]
        state.optimiser.zero_grad()
        losses.backward()
        assert all(p.grad is None for p in state.momentum.parameters())
        state.optimiser.step()
        method.after_step(state.network, state.momentum)

        with torch.no_grad():
            for own, target in zip(slow.parameters(), network.parameters(), strict=True):
                own.mul_(0.7).add_(target, alpha=0.3)
            keys = F.normalize(slow(batch.images2), dim=1)
        queries = F.normalize(network(batch.images1), dim=1)
        logits = torch.cat([(queries * keys).sum(1)[:, None], queries @ queue.T], 1) / config.moco.temperature
        loss = F.cross_entropy(logits, torch.zeros(4, dtype=torch.long))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        assert losses.report["loss"] == pytest.approx(loss.item(), abs=1e-5), step
        for place, key in enumerate(keys, start=4 * step):
            queue[place % 6] = key
        torch.testing.assert_close(state.momentum.queue.keys, queue, atol=1e-5, rtol=0)


def test_a_step_that_is_broken_off_leaves_queue_and_copy(shards: Path) -> None:
    method = method_of(tiny_method("vispe_moco"))
    dataset, state = method.dataset(shards, "train"), new_state(method, ALONE)
    before = {name: value.clone() for name, value in state.momentum.state_dict().items()}
    batch = method.prepare(dataset.batch([0, 1, 2, 3]), 0)
    method.losses(method.online(state.network), state.momentum, batch, ALONE)
    statistics = {f"network.{n}.{b}" for n, m in state.momentum.network.named_modules() if m in batchnorms(
        state.momentum.network) for b, _ in m.named_buffers()}  # fmt: skip
    for name, value in state.momentum.state_dict().items():
        assert name in statistics or torch.equal(value, before[name]), name
    method.after_step(state.network, state.momentum)
    assert not torch.equal(state.momentum.queue.keys, before["queue.keys"])


def test_keys_come_back_in_order_from_their_shuffled_batches() -> None:
    """Three ranks in one process: what each would send is put together by a stand-in."""
    world, images = 3, torch.randn(12, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    encoder = KeyEncoder(nn.Flatten(), KeyQueue(1, 1, 0), 0.9)
    expected = F.normalize(images.flatten(1), dim=1)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(5))

    class AllOf(Ranks):
        def gather(self, tensor: Tensor) -> Tensor:
            if tensor.dim() == 4:
                return images
            assert torch.equal(tensor, expected[order].chunk(world)[self.rank]), "each encodes its part of the shuffled"
            return expected[order]

    for rank in range(world):
        ranks = AllOf(rank, world, torch.device("cpu"))
        keys = encoder.keys_of_all(images.chunk(world)[rank], ranks, shuffle_seed=5)
        assert torch.equal(keys, expected)


@pytest.mark.parametrize("method", ["vispe_moco", "supmoco"])
def test_a_step_tells_how_far_keys_differ(tmp_path: Path, method: str) -> None:
    """A loss of log(1 + queue) may be that of a young network, or of one that maps everything to one vector."""
    shards = write_shards(tmp_path, n_objects=8, size=32) if method == "vispe_moco" else write_views(tmp_path, size=32)
    trained = method_of(tiny_method(method))
    dataset = trained.dataset(shards if method == "vispe_moco" else with_manifest(shards), "train")
    state = new_state(trained, ALONE, {"classes": ["a", "b"]})
    (rows, *_) = trained.order(dataset).batches(Place(), 1)
    batch, found = trained.prepare(dataset.batch(rows), 0), []
    for weight in (None, 0.0):
        if weight is not None:
            state.momentum.network.head[-1].weight.fill_(weight)
        found.append(trained.losses(trained.online(state.network), state.momentum, batch, ALONE).report["spread"])
    assert 0.01 < found[0] <= 1 and found[1] == pytest.approx(0, abs=1e-6)


def test_what_evaluation_sees_is_the_encoder_without_the_head() -> None:
    method = method_of(tiny_method("vispe_moco"))
    network = new_state(method, ALONE).network.eval()
    images = torch.rand(2, 3, 32, 32)
    embedder = method.embedder(network)
    assert (embedder.name, embedder.own_classifier, embedder.has_dense) == ("vispe_moco", "nearest", False)
    torch.testing.assert_close(embedder.pooled(images), network.encoder(images))
    assert embedder.pooled(images).shape == (2, network.encoder.dim) and network(images).shape == (2, 8)


def test_retrieval_counts_pairs_that_find_their_own_second_view() -> None:
    first = torch.eye(4)
    second = torch.eye(4)[[0, 2, 1, 3]]
    result = retrieval(first, second, torch.arange(4))
    assert result == {"retrieval": 0.5, "chance": 0.25, "pairs": 4}
    # the other pair of the same object is no candidate
    assert retrieval(first, second, torch.tensor([0, 1, 1, 3]))["pairs"] == 4
    assert retrieval(first[1:3], second[1:3], torch.tensor([1, 1]))["pairs"] == 0
    same = torch.ones(4, 2) / 2**0.5
    assert retrieval(same, same, torch.arange(4))["retrieval"] == 0.0, "a tie is no hit"
    result = retrieval(torch.eye(3), torch.eye(3)[[0, 0, 2]], torch.tensor([0, 0, 1]))
    assert result["retrieval"] == pytest.approx(2 / 3) and result["chance"] == pytest.approx((0.5 + 0.5 + 1 / 3) / 3)


def test_local_negatives_are_refused() -> None:
    with pytest.raises(UsageError, match=r"distributed.local_negatives: cannot be used by vispe_moco"):
        method_of(tiny_method("vispe_moco", "distributed.local_negatives=true"))


def test_settings_of_other_methods_are_refused(shards: Path, tmp_path: Path) -> None:
    for method, setting, instead in (
        ("vispe_moco", "loss.temperature=0.5", "Did you mean moco.temperature?"),
        ("vispe_moco", "supmoco.queue=8", "Did you mean moco.queue?"),
        ("vispe", "loss.negatives=second_view", "Leave out loss.negatives"),
        ("vispe", "network.predict_mask=false", "Leave out network.predict_mask"),
        ("dope", "moco.temperature=0.5", "Did you mean loss.temperature?"),
    ):
        with pytest.raises(UsageError, match=rf"^{setting.split('=')[0]}: is not read by {method}\. .*") as error:
            train(shards, tmp_path / method, tiny_method(method, setting))
        assert instead in str(error.value)
        assert not (tmp_path / method / "config.yaml").exists()


def test_settings_that_make_no_sense_are_refused() -> None:
    for wrong in ("moco.queue=0", "moco.temperature=0", "moco.head=[0, 8]"):
        with pytest.raises(UsageError, match=f"^{wrong.split('=')[0]}: "):
            load_config("nano", None, [wrong], method="vispe_moco")


def test_presets_are_the_papers() -> None:
    paper, abc = (load_config(name, method="vispe_moco") for name in ("paper_shapenet", "paper_abc"))
    assert (paper.moco.queue, paper.moco.head, paper.moco.temperature, paper.momentum) == (
        4096,
        (1024, 128),
        0.2,
        0.999,
    )
    assert (paper.optimiser.name, paper.optimiser.lr, paper.optimiser.weight_decay) == ("adamw", 1e-4, 1e-2)
    assert (paper.schedule.epochs, paper.data.batch_size) == (3500, 256)
    assert abc.moco.queue == 16384 and abc.schedule == paper.schedule


def test_a_run_that_was_stopped_ends_with_the_same_weights_and_queue(shards: Path, tmp_path: Path) -> None:
    same_after_a_stop(shards, tmp_path, tiny_method("vispe_moco", "moco.queue=10"))


@pytest.mark.timeout(240)
def test_it_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shards = draw_pairs(tmp_path / "shards", monkeypatch, objects=64, held_out=64)
    better_than_chance(shards, tmp_path / "run", "vispe_moco", "optimiser.lr=3e-3")
