from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from dope.lowshot import screening
from dope.lowshot.encoding import ViewCells
from dope.lowshot.matching import QueryDescriptors, best_similarities
from dope.lowshot.screening import COLUMNS, Screen

DIM = 200


def near_subspace(
    rows: int, seed: int, *, directions: int = 10, outside: float = 0.004, lengths: bool = True
) -> Tensor:
    """Descriptors (rows, DIM) that lie in `directions` directions but for a share of their squared length."""
    basis, _ = torch.linalg.qr(torch.randn(DIM, directions, generator=torch.Generator().manual_seed(0)))
    own = torch.Generator().manual_seed(seed)
    inside = torch.nn.functional.normalize(torch.randn(rows, directions, generator=own) @ basis.T, dim=1)
    rest = torch.nn.functional.normalize(torch.randn(rows, DIM, generator=own), dim=1)
    unit = torch.nn.functional.normalize((1 - outside) ** 0.5 * inside + outside**0.5 * rest, dim=1)
    return unit * torch.rand(rows, 1, generator=own)


def screen_of(descriptors: Tensor) -> Screen:
    screen = Screen.of(descriptors)
    assert screen is not None
    return screen


@pytest.mark.parametrize("outside", [0.0, 0.004])
@pytest.mark.parametrize("other", ["of the subspace", "of full rank", "the same", "one cell"])
def test_the_maximum_is_that_over_all_cells(other: str, outside: float) -> None:
    """Also where the cells lie nowhere near the subspace, which was found for other descriptors."""
    queries = near_subspace(700, 1, outside=outside)
    cells = {
        "of the subspace": near_subspace(900, 2, outside=outside),
        "of full rank": near_subspace(900, 4, directions=DIM),
        "the same": queries[:1].repeat(900, 1),
        "one cell": queries[:1],
    }[other]
    screen = screen_of(queries)
    found = screen.row_maxima(queries, queries.norm(dim=1), screen.coordinates(queries), cells)
    torch.testing.assert_close(found, (queries @ cells.T).amax(1), rtol=0, atol=2e-6)


def test_the_bound_is_one(seed: int = 3) -> None:
    queries, cells = near_subspace(500, seed), near_subspace(400, 4, directions=DIM)
    screen = screen_of(queries)
    bounds = screen.coordinates(queries) @ screen.coordinates(cells).T
    assert (bounds >= queries @ cells.T - 1e-5).all()
    tight = screen.coordinates(queries) @ screen.coordinates(near_subspace(400, 9)).T
    assert float((tight - queries @ near_subspace(400, 9).T).max()) < 0.02  # about what lies outside


def test_only_candidates_are_computed_in_full(monkeypatch: pytest.MonkeyPatch) -> None:
    queries, cells = near_subspace(700, 1), near_subspace(900, 2)
    screen = screen_of(queries)
    products: list[int] = []
    real = np.matmul

    def counted(a: NDArray[np.float32], b: NDArray[np.float32], **more: Any) -> Any:
        products.append(a.shape[1])
        return real(a, b, **more)

    monkeypatch.setattr(screening.np, "matmul", counted)
    screen.row_maxima(queries, queries.norm(dim=1), screen.coordinates(queries), cells)
    assert products and set(products) == {screen.columns} and screen.columns in COLUMNS


def test_the_smallest_subspace_is_taken_and_none_where_there_is_none() -> None:
    assert screen_of(near_subspace(500, 1, directions=10)).columns == 16
    assert screen_of(near_subspace(500, 1, directions=28)).columns == 32
    assert Screen.of(near_subspace(500, 1, directions=150)) is None
    assert Screen.of(near_subspace(500, 1, directions=10)[:, :40]) is None  # too short for it to be worth it
    assert Screen.of(torch.zeros(0, DIM)) is None


def as_cells(descriptors: Tensor) -> ViewCells:
    return ViewCells.of_grid(descriptors.unflatten(0, (30, 30)))


def test_scores_with_and_without_a_subspace_are_the_same() -> None:
    queries = near_subspace(40 * 5, 1).view(40, 5, DIM)
    ready = QueryDescriptors(queries, queries.norm(dim=-1))
    assert ready._screen is not None
    support = as_cells(near_subspace(900, 2))
    rows = np.array([3, 39, 0])
    flat = queries[rows].flatten(0, 1)
    plain = best_similarities(flat, flat.norm(dim=1), support).view(3, 5).sum(1)
    np.testing.assert_allclose(ready.scores(support, rows), plain, atol=1e-5)
    np.testing.assert_allclose(ready.scores(support)[rows], plain, atol=1e-5)


def test_a_nan_is_not_lost() -> None:
    queries = near_subspace(40 * 5, 1).view(40, 5, DIM)
    ready = QueryDescriptors(queries, queries.norm(dim=-1))
    cells = near_subspace(900, 2)
    spoiled = as_cells(cells)
    spoiled.descriptors(0, 900)[7] = torch.nan
    assert not np.isfinite(ready.scores(spoiled)).any()
