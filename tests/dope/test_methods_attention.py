"""FEAT's attention over the members of a set, its losses and its dropout, against naive loops."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from naive_attention import Vector, attention_of, naive_attention

from dope.augmentation import Share
from dope.methods.configs import FeatConfig
from dope.methods.feat import FeatNetwork, OnlineFeat
from dope.methods.set_attention import Kept, SetAttention, centres, draw_kept, episode_losses

CPU = torch.device("cpu")


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
