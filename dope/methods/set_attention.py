"""FEAT's set function: one head of attention over the members of a set (Ye et al., CVPR 2020, section 3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dope.augmentation import Share, uniform_rows


@dataclass(frozen=True)
class Kept:
    """What dropout leaves of an attention over sets (..., n, D): factors 0 or 1 / (1 - p).

    Attributes:
        weights: (..., n, n), of the attention weights.
        outputs: (..., n, D), of the output layer.
    """

    weights: Tensor
    outputs: Tensor


class SetAttention(nn.Module):
    """LayerNorm(x + Linear(softmax(Q K^T / sqrt(D)) V)), without a feed-forward part.

    Args:
        dim: D, length of a member.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.query, self.key, self.value = (nn.Linear(dim, dim, bias=False) for _ in range(3))
        self.output, self.norm = nn.Linear(dim, dim), nn.LayerNorm(dim)
        for layer in (self.query, self.key, self.value, self.output):
            nn.init.normal_(layer.weight, std=math.sqrt(2 / (dim + dim)))  # of the output layer: Xavier's, the same

    def forward(self, sets: Tensor, kept: Kept | None = None) -> Tensor:
        """Adapted members (..., n, D) of sets (..., n, D), in training with dropout."""
        scores = self.query(sets) @ self.key(sets).transpose(-1, -2) / math.sqrt(sets.shape[-1])
        weights = scores.softmax(-1)
        if kept is not None:
            weights = weights * kept.weights
        outputs = self.output(weights @ self.value(sets))
        if kept is not None:
            outputs = outputs * kept.outputs
        adapted: Tensor = self.norm(outputs + sets)
        return adapted


def draw_kept(
    shapes: list[tuple[int, ...]], dim: int, p: tuple[float, float], seed: int, device: torch.device, share: Share
) -> list[Kept]:
    """What dropout keeps, as a function of the seed and of an episode's place in the global batch alone.

    Args:
        shapes: of each attention (episodes, ..., n).
        dim: D.
        p: probabilities of dropping an attention weight, and an output.
        seed: of this step.
        device: where it is needed; it is drawn on the CPU.
        share: which part of the global batch this is.
    """
    random = torch.Generator().manual_seed(seed)
    parts = [((*shape, width), q) for shape in shapes for width, q in zip((shape[-1], dim), p, strict=True)]
    columns = [math.prod(shape[1:]) for shape, _ in parts]
    uniform = uniform_rows(shapes[0][0], sum(columns), random, device, share)
    factors = [
        (numbers >= q).float().div_(1 - q).view(shape)
        for numbers, (shape, q) in zip(uniform.split(columns, 1), parts, strict=True)
    ]
    return [Kept(*pair) for pair in zip(factors[::2], factors[1::2], strict=True)]


def centres(attention: SetAttention, embeddings: Tensor, kept: Kept | None = None) -> Tensor:
    """The regulariser's centres (..., ways, D): the mean of what attention makes of each class's own embeddings
    (..., ways, K + Q, D)."""
    return attention(embeddings, kept).mean(-2)


def distance_logits(members: Tensor, centres: Tensor, temperature: float) -> Tensor:
    """-|c - x|^2 / T: (E, N, C) of members x (E, N, D) and centres c (E, C, D)."""
    return -(centres[:, None] - members[:, :, None]).square().sum(-1) / temperature


def episode_losses(
    embeddings: Tensor,
    prototypes: Tensor,
    class_centres: Tensor,
    shots: int,
    temperatures: tuple[float, float],
) -> tuple[Tensor, Tensor, Tensor]:
    """Cross entropy of the queries, that of all views to the regulariser's centres, and the accuracy: (E,) each, means.

    Args:
        embeddings: (E, ways, shots + queries, D).
        prototypes: (E, ways, D), adapted.
        class_centres: (E, ways, D).
        shots: the first so many of each class are shots.
        temperatures: of the queries' logits and of the regulariser's.
    """
    ways, members = embeddings.shape[1:3]
    way = torch.arange(ways, device=embeddings.device)
    queries, of_query = embeddings[:, :, shots:].flatten(1, 2), way.repeat_interleave(members - shots)
    logits = distance_logits(queries, prototypes, temperatures[0])
    accuracy = (logits.argmax(-1) == of_query).float().mean(1)
    of_member = way.repeat_interleave(members)
    to_centres = distance_logits(embeddings.flatten(1, 2), class_centres, temperatures[1])
    return _cross_entropies(logits, of_query), _cross_entropies(to_centres, of_member), accuracy


def _cross_entropies(logits: Tensor, targets: Tensor) -> Tensor:
    """The mean (E,) over N of logits (E, N, C) with targets (N,), the same in all episodes."""
    each = F.cross_entropy(logits.transpose(1, 2), targets.expand(len(logits), -1), reduction="none")
    return each.mean(1)
