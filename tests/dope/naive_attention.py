"""FEAT's attention as it is written down: one member after the other, in float64."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from dope.methods.set_attention import SetAttention

Vector = NDArray[np.float64]


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
