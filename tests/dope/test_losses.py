"""The losses against naive loops in float64, closed forms and numerical gradients."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from dope.losses import contrastive_loss, mask_loss


def make_points(
    pairs: int, points: int, objects: list[int], dimension: int, seed: int = 0, dtype: torch.dtype = torch.float64
) -> dict[str, Tensor]:
    """`points` queries and keys a pair, the keys shuffled, so that a positive is not simply the same row."""
    generator = torch.Generator().manual_seed(seed)
    pair = torch.arange(pairs).repeat_interleave(points)
    order = torch.randperm(pairs * points, generator=generator)
    draw = torch.randn(2, pairs * points, dimension, generator=generator, dtype=dtype)
    queries, keys = F.normalize(draw, dim=-1)
    return {
        "queries": queries,
        "keys": keys,
        "positive": order.argsort(),
        "query_pair": pair,
        "key_pair": pair[order],
        "query_object": torch.tensor(objects)[pair],
        "key_object": torch.tensor(objects)[pair[order]],
    }


def naive_loss(points: dict[str, Tensor], temperature: float, negatives: str) -> list[float]:
    losses = []
    for i, query in enumerate(points["queries"].tolist()):
        positive, logits = int(points["positive"][i]), []
        for j, key in enumerate(points["keys"].tolist()):
            same_pair = points["query_pair"][i] == points["key_pair"][j]
            same_object = points["query_object"][i] == points["key_object"][j]
            is_negative = {
                "both": same_pair or not same_object,
                "second_view": same_pair,
                "other_objects": not same_object,
            }[negatives]
            if j == positive or is_negative:
                logits.append(sum(a * b for a, b in zip(query, key, strict=True)) / temperature)
            if j == positive:
                positive_logit = logits[-1]
        losses.append(math.log(sum(math.exp(x) for x in logits)) - positive_logit)
    return losses


REPEATED, DISTINCT = [4, 7, 4, 9], [4, 7, 5, 9]  # the first has object 4 in two pairs


@pytest.mark.parametrize("negatives", ["both", "other_objects", "second_view"])
@pytest.mark.parametrize("objects", [DISTINCT, REPEATED])
@pytest.mark.parametrize("chunk", [1, 5, 1024])
@pytest.mark.parametrize("temperature", [0.1, 0.02])  # logits up to 10, and up to 50: too large for plain exponentials
def test_contrastive_loss_equals_naive_loop(negatives: str, objects: list[int], chunk: int, temperature: float) -> None:
    points = make_points(4, 4, objects, dimension=6)
    expected = naive_loss(points, temperature, negatives)
    options = {"negatives": negatives, "chunk": chunk, "temperature": temperature}
    assert contrastive_loss(**points, **options).item() == pytest.approx(sum(expected) / 16, rel=1e-12)
    total = contrastive_loss(**points, **options, reduction="sum")
    assert total.item() == pytest.approx(sum(expected), rel=1e-12)
    single = {name: value.float() if value.is_floating_point() else value for name, value in points.items()}
    assert contrastive_loss(**single, **options).item() == pytest.approx(sum(expected) / 16, abs=1e-5)


@pytest.mark.parametrize("temperature", [0.2, 0.02])
@pytest.mark.parametrize("negatives", ["both", "other_objects", "second_view"])
def test_gradients_of_queries_and_keys_are_the_numerical_ones(negatives: str, temperature: float) -> None:
    points = make_points(3, 3, [1, 2, 1], dimension=4)
    queries, keys = points.pop("queries").requires_grad_(), points.pop("keys").requires_grad_()

    def loss(queries: Tensor, keys: Tensor) -> Tensor:
        return contrastive_loss(queries, keys, **points, temperature=temperature, negatives=negatives, chunk=4)

    assert torch.autograd.gradcheck(loss, (queries, keys))
    loss(queries, keys.detach()).backward()
    alone = queries.grad.clone()
    queries.grad = None
    loss(queries, keys).backward()
    torch.testing.assert_close(queries.grad, alone)


def test_gradient_equals_autograd_of_full_cross_entropy() -> None:
    points = make_points(32, 8, list(range(32)), dimension=32, dtype=torch.float32)
    queries, keys = points["queries"].requires_grad_(), points["keys"].requires_grad_()
    F.cross_entropy(queries @ keys.t() / 0.1, points["positive"]).backward()
    expected = queries.grad.clone(), keys.grad.clone()
    queries.grad = keys.grad = None
    contrastive_loss(**points, chunk=100).backward()
    torch.testing.assert_close(queries.grad, expected[0], atol=1e-7, rtol=1e-5)
    torch.testing.assert_close(keys.grad, expected[1], atol=1e-7, rtol=1e-5)


def test_same_point_in_another_pair_of_the_object_is_no_negative() -> None:
    points = make_points(2, 2, [3, 3], dimension=4)
    points["keys"] = points["keys"].clone()
    other = (points["key_pair"] == 1).nonzero()[0, 0]
    points["keys"][other] = points["queries"][0]  # were it a negative of query 0, its loss would grow to log 2 at least
    rows = points["query_pair"] == 0
    first = {n: v[rows] if n in ("queries", "positive", "query_pair", "query_object") else v for n, v in points.items()}
    one = make_points(2, 2, [3, 3], dimension=4)
    same = {n: v[rows] if n in ("queries", "positive", "query_pair", "query_object") else v for n, v in one.items()}
    assert contrastive_loss(**first).item() == contrastive_loss(**same).item()


def test_extreme_similarities_do_not_overflow() -> None:
    points = make_points(2, 2, [0, 1], dimension=4, dtype=torch.float32)
    points["queries"], points["keys"] = points["queries"] * 1e3, points["keys"] * 1e3
    queries = points["queries"].requires_grad_()
    loss = contrastive_loss(**points, temperature=0.01)
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(queries.grad).all()


def test_no_queries_give_zero_loss_and_zero_gradient() -> None:
    points = make_points(2, 2, [0, 1], dimension=4)
    keys = points["keys"].requires_grad_()
    empty = {n: v[:0] for n, v in points.items() if n in ("positive", "query_pair", "query_object")}
    queries = points["queries"][:0].requires_grad_()
    loss = contrastive_loss(queries, keys, key_pair=points["key_pair"], key_object=points["key_object"], **empty)
    loss.backward()
    assert loss.item() == 0 and not keys.grad.any()


def test_half_precision_under_autocast_is_computed_in_float32() -> None:
    points = make_points(4, 4, DISTINCT, dimension=16, dtype=torch.float32)
    expected = contrastive_loss(**points)
    with torch.autocast("cpu", torch.bfloat16):
        assert contrastive_loss(**points).item() == expected.item()
        points["queries"], points["keys"] = points["queries"].bfloat16(), points["keys"].bfloat16()
        assert contrastive_loss(**points).dtype == torch.float32


def test_memory_stays_at_a_chunk_of_similarities() -> None:
    points = make_points(32, 16, list(range(32)), dimension=8, dtype=torch.float32)
    points["queries"].requires_grad_()
    sizes = []

    class Watch(torch.utils._python_dispatch.TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
            result = func(*args, **(kwargs or {}))
            sizes.extend(t.numel() for t in torch.utils._pytree.tree_leaves(result) if isinstance(t, Tensor))
            return result

    with Watch():
        contrastive_loss(**points, chunk=64).backward()
    assert max(sizes) == 64 * 512


def test_mask_loss_closed_form_and_any_coverage_counts() -> None:
    masks = torch.zeros(1, 1, 8, 8, dtype=torch.bool)
    masks[0, 0, 0, 0] = True  # one pixel of sixteen makes the cell object
    logits = torch.tensor([[[[2.0, -1.0], [0.5, 0.0]]]])
    expected = [math.log1p(math.exp(-2.0)), math.log1p(math.exp(-1.0)), math.log1p(math.exp(0.5)), math.log(2.0)]
    assert mask_loss(logits, masks).item() == pytest.approx(sum(expected) / 4, rel=1e-6)
    assert mask_loss(logits.bfloat16(), masks).dtype == torch.float32
