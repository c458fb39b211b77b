"""What kinds of objects are written with: dice, pieces with a role, rows and rings of equal parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from pipeline.solids.mesh import Mesh

T = TypeVar("T")


@dataclass(frozen=True)
class Piece:
    """A closed mesh and what it is to the object: pieces of one role get one colour."""

    mesh: Mesh
    role: str = "body"


class Dice:
    """Random numbers, as the recipes of objects want them."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def real(self, low: float, high: float) -> float:
        """Uniform."""
        return float(self.rng.uniform(low, high))

    def log(self, low: float, high: float) -> float:
        """Uniform in the logarithm: for sizes and ratios."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def whole(self, low: int, high: int) -> int:
        """An integer, both ends included."""
        return int(self.rng.integers(low, high + 1))

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def pick(self, choices: Sequence[T]) -> T:
        return choices[int(self.rng.integers(len(choices)))]


def pieces(role: str, *meshes: Mesh) -> list[Piece]:
    """Meshes of one role."""
    return [Piece(mesh, role) for mesh in meshes]


def around(mesh: Mesh, count: int, start_deg: float = 0.0, span_deg: float = 360.0) -> list[Mesh]:
    """Copies at even angles about z; a span below 360 degrees has one at both its ends."""
    step = span_deg / count if span_deg >= 360 else span_deg / max(count - 1, 1)
    return [mesh.turned(2, start_deg + k * step) for k in range(count)]


def in_row(mesh: Mesh, count: int, step: tuple[float, float, float]) -> list[Mesh]:
    """Copies in a row whose middle is where the mesh was."""
    return [mesh.at(*(np.array(step) * (k - 0.5 * (count - 1)))) for k in range(count)]


def in_grid(mesh: Mesh, columns: int, rows: int, dx: float, dy: float) -> list[Mesh]:
    """Copies in rows and columns along x and y, centred where the mesh was."""
    return [copy for row in in_row(mesh, rows, (0, dy, 0)) for copy in in_row(row, columns, (dx, 0, 0))]


def both(mesh: Mesh, axis: int = 0) -> list[Mesh]:
    """A mesh and its mirror image across the plane through the origin at right angles to an axis."""
    factors = np.ones(3)
    factors[axis] = -1
    return [mesh, mesh.scaled(factors)]


def corners(mesh: Mesh) -> list[Mesh]:
    """A mesh and its mirror images in the other three quarters about z."""
    return [copy for half in both(mesh, 0) for copy in both(half, 1)]
