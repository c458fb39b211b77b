"""The two losses: contrast of descriptors between views, and the object's mask (DOPE, section 3)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

Negatives = Literal["both", "other_objects", "second_view"]
SMALL_LOGIT = 40.0  # sums of the exponentials of such logits neither overflow nor vanish in float32
Excluded = Callable[[slice], Tensor]  # queries of a chunk -> (chunk, K) bool: keys that are no negatives


def contrastive_loss(
    queries: Tensor,
    keys: Tensor,
    positive: Tensor,
    query_pair: Tensor,
    key_pair: Tensor,
    query_object: Tensor,
    key_object: Tensor,
    *,
    temperature: float = 0.1,
    negatives: Negatives = "both",
    chunk: int = 512,
    reduction: Literal["mean", "sum"] = "mean",
) -> Tensor:
    """Cross entropy of each query's positive key against its negative keys (InfoNCE, positive in the denominator).

    Negatives "second_view" are the other keys of the query's own pair, "other_objects" the keys of other objects. Keys
    of the same object but of another pair are never negatives: they may show the very same point.
    Half precision inputs are computed in float32. Without queries the loss is 0.

    Args:
        queries: (Q, D) descriptors of view 1.
        keys: (K, D) descriptors of view 2.
        positive: (Q,) long, the key that shows the query's point.
        query_pair, key_pair: (Q,) and (K,), numbers of the view pairs.
        query_object, key_object: (Q,) and (K,), numbers of the objects.
        temperature: similarities are divided by it.
        negatives: which keys stand against the positive.
        chunk: queries at a time; at most chunk x K similarities exist at once, and the backward pass stores none.
        reduction: "mean" or "sum" over queries.
    """
    if len(queries) == 0:
        return (queries.sum() + keys.sum() * 0).float()
    if queries.dtype in (torch.float16, torch.bfloat16) or keys.dtype in (torch.float16, torch.bfloat16):
        queries, keys = queries.float(), keys.float()

    def excluded(rows: slice) -> Tensor:
        same_object = query_object[rows, None] == key_object
        if negatives == "other_objects":
            return same_object
        other_pair = query_pair[rows, None] != key_pair
        return other_pair if negatives == "second_view" else other_pair & same_object

    repeats = _repeats(query_object, key_object, query_pair, key_pair)
    small = _largest_logit(queries, keys, temperature) < SMALL_LOGIT
    # both are asked at once, which on a GPU means to wait once
    repeats_objects, small_logits = torch.stack([repeats, small]).tolist()
    needed = negatives != "both" or repeats_objects
    with torch.autocast(queries.device.type, enabled=False):
        total = _ChunkedCrossEntropy.apply(
            queries,
            keys,
            positive,
            excluded if needed else None,
            temperature,
            chunk,
            small_logits,
            torch.is_grad_enabled(),
        )
    return total / len(queries) if reduction == "mean" else total


def mask_loss(mask_logits: Tensor, masks: Tensor) -> Tensor:
    """Mean binary cross entropy of `mask_logits` (B, 1, h, w) against `masks` (B, 1, H, W) bool shrunk by area.

    A cell counts as object if the mask covers any of it.
    """
    target = F.adaptive_max_pool2d(masks.float(), mask_logits.shape[-2:])
    return F.binary_cross_entropy_with_logits(mask_logits.float(), target)


@torch.no_grad()
def _largest_logit(queries: Tensor, keys: Tensor, temperature: float) -> Tensor:
    """A bound, scalar, on the absolute values of all logits."""
    return queries.square().sum(1).amax().mul(keys.square().sum(1).amax()).sqrt() / temperature


def _repeats(query_object: Tensor, key_object: Tensor, query_pair: Tensor, key_pair: Tensor) -> Tensor:
    """Scalar bool: whether any object appears in more than one pair (then a few similarities must be left out)."""
    pairs = torch.cat([query_pair, key_pair])
    objects, index = torch.unique(torch.cat([query_object, key_object]), return_inverse=True)
    first = pairs.new_zeros(len(objects)).scatter_reduce(0, index, pairs, "amin", include_self=False)
    last = pairs.new_zeros(len(objects)).scatter_reduce(0, index, pairs, "amax", include_self=False)
    return (first != last).any()


class _ChunkedCrossEntropy(torch.autograd.Function):
    """Sum over queries of logsumexp(q . keys / T) - q . positive / T, gradients computed along with the loss.

    The gradients (the size of the inputs) are all that is kept for the backward pass: the similarities of a chunk are
    turned into unnormalised probabilities in place, used, and overwritten by the next chunk's.
    """

    @staticmethod
    def forward(
        ctx: Any,
        queries: Tensor,
        keys: Tensor,
        positive: Tensor,
        excluded: Excluded | None,
        temperature: float,
        chunk: int,
        small_logits: bool,
        with_gradient: bool,
    ) -> Tensor:
        query_gradient = torch.empty_like(queries) if with_gradient and ctx.needs_input_grad[0] else None
        key_gradient = torch.zeros_like(keys) if with_gradient and ctx.needs_input_grad[1] else None
        buffer = queries.new_empty(min(chunk, len(queries)), len(keys))
        losses = []
        for start in range(0, len(queries), chunk):
            rows = slice(start, start + chunk)
            scaled = queries[rows] / temperature
            own = positive[rows, None]
            weights = torch.mm(scaled, keys.t(), out=buffer[: len(scaled)])  # logits first, exp(logit - top) later
            positive_logit = weights.gather(1, own)
            if excluded is not None:
                weights.masked_fill_(excluded(rows), -torch.inf).scatter_(1, own, positive_logit)
            top = positive_logit.new_zeros(()) if small_logits else weights.amax(1, keepdim=True)
            total = (weights if small_logits else weights.sub_(top)).exp_().sum(1, keepdim=True)
            losses.append((total.log() + top - positive_logit).sum())
            # (softmax - one-hot) times the other side; dividing the small products spares a pass over the weights
            if query_gradient is not None:
                gradient = torch.mm(weights, keys, out=query_gradient[rows])
                gradient.div_(total).sub_(keys[own[:, 0]]).div_(temperature)
            if key_gradient is not None:
                key_gradient.addmm_(weights.t(), scaled / total)
                key_gradient.index_add_(0, own[:, 0], scaled, alpha=-1)
        ctx.save_for_backward(query_gradient, key_gradient)
        return torch.stack(losses).sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor | None, ...]:
        (upstream,) = outputs
        gradients = [None if gradient is None else gradient * upstream for gradient in ctx.saved_tensors]
        return *gradients, *[None] * 6
