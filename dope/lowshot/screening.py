"""A cheap bound that says which cells can be a query cell's best match, so that only those are compared in full.

Descriptors of a trained network lie near a subspace of few directions. With B its orthonormal basis (D, d), x1 = B^T x
and x2 = |x - B x1|, every dot product is bounded (Cauchy-Schwarz): q . c <= q1 . c1 + q2 c2. The bound of all pairs of
cells is one matrix product of d + 1 columns in place of D. What may exceed the best match found so far is then computed
in full: the maximum over all cells stays what it is.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

COLUMNS = (16, 32, 64)  # d + 1 that are tried: whole vectors of the processor
_LEFT = (
    0.01  # share of the squared length that may lie outside of the subspace: the bound is then about so much too high
)
_SAMPLE = 8192  # descriptors from which the subspace is found
_SLACK = 2e-5  # of the product of the norms: more than float32 products of unit vectors and of a float32 basis err
_WORTH = 6  # candidates a query cell beyond which whole products are faster
_BOUNDS = 1 << 17  # computed at once: 512 KiB, so that they are searched within the cache


class Screen:
    """A subspace, and the coordinates of descriptors in it.

    Args:
        basis: (D, d), orthonormal.
    """

    def __init__(self, basis: Tensor) -> None:
        self._basis = basis

    @classmethod
    def of(cls, descriptors: Tensor) -> Screen | None:
        """Of some descriptors (N, D); None where no subspace is small enough to be worth it, or on a GPU."""
        if descriptors.device.type != "cpu" or len(descriptors) == 0:
            return None
        some = descriptors[:: max(1, len(descriptors) // _SAMPLE)]
        energies, directions = torch.linalg.eigh(some.T @ some)
        total = float(energies.sum())
        for columns in COLUMNS:
            d = columns - 1
            if 3 * columns > descriptors.shape[1]:
                break
            if float(energies[:-d].sum()) <= _LEFT * total:
                return cls(directions[:, -d:].contiguous())
        return None

    @property
    def columns(self) -> int:
        return self._basis.shape[1] + 1

    def coordinates(self, descriptors: Tensor) -> Tensor:
        """(N, D) to (N, d + 1): coordinates in the subspace, and the distance from it."""
        inside = descriptors @ self._basis
        # subtracted before it is squared: the difference of squared lengths would have no digits left
        outside = torch.addmm(descriptors, inside, self._basis.T, alpha=-1).norm(dim=1, keepdim=True)
        return torch.cat([inside, outside], dim=1)

    def row_maxima(self, queries: Tensor, norms: Tensor, coordinates: Tensor, cells: Tensor) -> Tensor:
        """The greatest dot product (R,) of each query descriptor with any cell.

        Args:
            queries: (R, D).
            norms: (R,) their lengths.
            coordinates: (R, d + 1) of the queries.
            cells: (M, D) of length at most 1.
        """
        of_cells = self.coordinates(cells).T.contiguous().numpy()
        of_queries = coordinates.numpy()
        best = queries.new_empty(len(queries))
        step = max(1, _BOUNDS // len(cells))
        bounds = np.empty((min(step, len(queries)), len(cells)), np.float32)
        for start in range(0, len(queries), step):
            part = slice(start, start + step)
            above = np.matmul(of_queries[part], of_cells, out=bounds[: len(of_queries[part])])
            best[part] = _maxima(queries[part], norms[part], above, cells)
        return best


def _maxima(queries: Tensor, norms: Tensor, bounds: NDArray[np.float32], cells: Tensor) -> Tensor:
    """The greatest dot product (R,) of queries (R, D) with cells (M, D), given `bounds` (R, M) of all of them."""
    likely = torch.from_numpy(bounds.argmax(1))
    best = (queries * cells[likely]).sum(1)
    least = best - _SLACK * norms
    # "not less" keeps NaN
    candidates = np.flatnonzero(~(bounds < least.numpy()[:, None]))
    if len(candidates) > _WORTH * len(bounds):
        return (queries @ cells.T).amax(1)
    rows, places = np.divmod(candidates, bounds.shape[1])
    other = places != likely.numpy()[rows]
    if other.any():
        row, place = torch.from_numpy(rows[other]), torch.from_numpy(places[other])
        exact = (queries[row] * cells[place]).sum(1)
        best.scatter_reduce_(0, row, exact, "amax")
    return best
