"""Farthest point sampling of many point sets at once, on whatever device they lie."""

from __future__ import annotations

import torch
from torch import Tensor

TAKEN = -1.0  # a squared distance below any real one: such a point is never the farthest


@torch.no_grad()
def farthest_points(points: Tensor, valid: Tensor, n: int, start: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Choose `n` points of each set, each the farthest from those chosen before.

    No point is chosen twice, and no invalid point ever. Ties go to the lowest index.

    Args:
        points: (B, N, 2) float.
        valid: (B, N) bool, False for padding.
        n: points to choose of each set.
        start: (B,) in [0, 1), where among its valid points a set begins (uniform draws make the start random); the
            first valid point where None.

    Returns:
        (B, n) long indices and (B, n) bool: False beyond the number of valid points, where the index repeats the first
        choice (0 where a set has no valid point).
    """
    count = valid.sum(1)
    ok = torch.arange(n, device=points.device) < count[:, None]
    index = torch.zeros(len(points), n, dtype=torch.long, device=points.device)
    if points.shape[1] == 0 or n == 0:
        return index, ok
    # padding may hold anything, NaN included; x and y apart keep every pass contiguous
    x, y = points.float().masked_fill(~valid[..., None], 0.0).unbind(-1)
    x, y = x.contiguous(), y.contiguous()
    distance = torch.where(valid, torch.inf, TAKEN)
    dx, dy = torch.empty_like(x), torch.empty_like(y)
    before = torch.zeros_like(count) if start is None else (start * count).long().clamp(max=points.shape[1] - 1)
    chosen = ((valid.cumsum(1) == before[:, None] + 1) & valid).to(torch.uint8).argmax(1, keepdim=True)
    for i in range(n):
        if i > 0:
            chosen = _argmax(distance)
        index[:, i : i + 1] = chosen
        torch.sub(x, x.gather(1, chosen), out=dx)
        torch.sub(y, y.gather(1, chosen), out=dy)
        torch.minimum(distance, dx.mul_(dx).addcmul_(dy, dy), out=distance)
        distance.scatter_(1, chosen, TAKEN)
    return torch.where(ok, index, index[:, :1]), ok


def _argmax(rows: Tensor) -> Tensor:
    """(B, N) to the first place (B, 1) of each row's largest number."""
    if rows.is_cuda:
        return rows.argmax(1, keepdim=True)
    return torch.from_numpy(rows.numpy().argmax(1)[:, None])  # compares many at a time, which PyTorch does not
