from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from mesh_writers import BOX, TRIANGLES
from numpy.typing import NDArray

from dope.common.errors import DopeError
from dope.common.seeds import generator
from pipeline.render.load_checks import checked
from pipeline.render.pose import posed, resting_sides
from pipeline.render.scene import Model, Part

pytest.importorskip("scipy", reason="needs the extra `render`")
Floats = NDArray[np.float64]


def model(vertices: Floats = BOX, faces: NDArray[np.int64] = TRIANGLES) -> Model:
    normals = vertices - vertices.mean(axis=0)
    return Model((Part(vertices, faces, normals / np.linalg.norm(normals, axis=1, keepdims=True)),))


def probability(vertices: Floats, direction: tuple[float, float, float]) -> float:
    """That the side that looks into a direction lies below."""
    normals, probabilities = resting_sides(vertices)
    assert probabilities.sum() == pytest.approx(1) and np.allclose(np.linalg.norm(normals, axis=1), 1)
    return float(probabilities[normals @ np.array(direction) > 1 - 1e-6].sum())


def test_a_box_rests_on_each_side_by_its_solid_angle() -> None:
    a, b, c = 0.5, 1.0, 1.5  # a rectangle 2a x 2b seen from c above its middle: 4 atan(ab / (c sqrt(a2 + b2 + c2)))
    root = np.sqrt(a * a + b * b + c * c)
    for direction, expected in (
        ((0, 0, -1), 4 * np.arctan(a * b / (c * root))),
        ((0, 1, 0), 4 * np.arctan(a * c / (b * root))),
        ((1, 0, 0), 4 * np.arctan(b * c / (a * root))),
    ):
        assert probability(BOX + 7, direction) == pytest.approx(expected / (4 * np.pi))


def test_the_centre_of_mass_is_that_of_the_solid_hull() -> None:
    crowd = np.concatenate([BOX, np.random.default_rng(0).uniform(0.01, 0.2, (500, 3))])  # vertices in one corner
    assert probability(crowd, (0, 0, 1)) == pytest.approx(probability(BOX, (0, 0, 1)))


def test_from_a_side_where_it_would_fall_over_it_rolls_on() -> None:
    leaning = BOX + np.outer(BOX[:, 2], (1.5, 0, 0))  # a parallelepiped, its top far beyond its foot
    assert probability(leaning, (0, 0, -1)) == 0 and probability(leaning, (0, 0, 1)) == 0
    normals, probabilities = resting_sides(leaning)
    assert len(normals) == 4 and probabilities.min() > 0.05
    straight = BOX + np.outer(BOX[:, 2], (0.2, 0, 0))
    assert probability(straight, (0, 0, -1)) > 0


def naive_sides(points: Floats) -> dict[tuple[float, ...], float]:
    """What `resting_sides` says, triangle by triangle, of a hull whose sides are all triangles."""
    from scipy.spatial import ConvexHull, Delaunay

    cells = points[Delaunay(points).simplices]
    volumes = np.abs(np.linalg.det(cells[:, 1:] - cells[:, :1]))
    centre = (cells.mean(axis=1) * volumes[:, None]).sum(axis=0) / volumes.sum()
    hull = ConvexHull(points)
    sides = [frozenset(side.tolist()) for side in hull.simplices]

    def next_side(i: int) -> int:
        normal, worst, target = hull.equations[i, :3], 1e-9, i
        for corner in sides[i]:
            a, b = (points[k] for k in sides[i] - {corner})
            outward = np.cross(b - a, normal)
            outward *= -np.sign(outward @ (points[corner] - a)) / np.linalg.norm(outward)
            if outward @ (centre - a) > worst:
                worst = outward @ (centre - a)
                target = next(j for j, side in enumerate(sides) if j != i and sides[i] - {corner} < side)
        return target

    result: dict[tuple[float, ...], float] = {}
    for i, side in enumerate(sides):
        a, b, c = ((v / np.linalg.norm(v)) for v in (points[list(side)] - centre))
        solid = 2 * np.arctan2(abs(a @ np.cross(b, c)), 1 + a @ b + b @ c + c @ a)
        rest = i
        while (following := next_side(rest)) != rest:
            rest = following
        key = tuple(hull.equations[rest, :3].round(6).tolist())
        result[key] = result.get(key, 0) + solid / (4 * np.pi)
    return result


def test_sides_agree_with_a_naive_walk_over_the_hull() -> None:
    for seed in range(5):
        points = np.random.default_rng(seed).normal(size=(30, 3)) * (1, 2, 3)
        normals, probabilities = resting_sides(points)
        expected = naive_sides(points)
        assert len(expected) == len(normals) < 20
        for normal, value in zip(normals, probabilities, strict=True):
            assert value == pytest.approx(expected[tuple(normal.round(6).tolist())], rel=1e-6)


@pytest.mark.parametrize("pose", ["stable", "upright"])
def test_posed_objects_have_one_size_and_stand_in_the_middle(pose: str) -> None:
    for seed in range(20):
        (part,) = posed(model(BOX * 40 + 9), up="z", pose=pose, rng=generator(seed)).parts
        v = part.vertices
        assert np.abs(v).max() == pytest.approx(0.5, abs=1e-12)
        assert np.allclose(v.min(axis=0) + v.max(axis=0), 0, atol=1e-12)
        assert part.normals is not None
        centred = v - v.mean(axis=0)  # the normals of this model point from its middle to the vertices
        assert np.allclose(part.normals, centred / np.linalg.norm(centred, axis=1, keepdims=True)), "turned alike"
        corners = v[part.faces]
        outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (outwards * corners.mean(axis=1)).sum(axis=1).min() > 0, "never mirrored"
        assert (v[:, 2] < v[:, 2].min() + 1e-9).sum() == 4, "on a side"


def test_stable_poses_are_drawn_by_their_probability() -> None:
    heights = []
    for seed in range(400):
        v = posed(model(), up="z", pose="stable", rng=generator("pose", seed)).vertices()
        edges = np.linalg.norm(v[1] - v[0])  # the box's side of 1
        heights.append(round(float(np.ptp(v[:, 2]) / edges)))
    shares = [heights.count(height) / 400 for height in (1, 2, 3)]
    expected = [2 * probability(BOX, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    assert np.allclose(shares, expected, atol=0.08)


def test_up_axes_and_the_turn() -> None:
    tip = np.concatenate([BOX, [[0.5, 1, 9]]])
    for up, axes in (("z", [0, 1, 2]), ("y", [1, 2, 0]), ("x", [2, 0, 1])):  # cyclic: no mirror
        vertices = posed(model(tip[:, axes]), up=up, pose="upright", rng=generator(1)).vertices()
        assert vertices[8, 2] == pytest.approx(0.5), "the tip points up"
        edges = vertices[[1, 2, 4]] - vertices[0]
        assert np.linalg.det(edges) > 0, "no mirror"
    turns = [posed(model(), up="z", pose="upright", rng=generator(seed)).vertices() for seed in range(200)]
    angles = [np.arctan2(*(v[1] - v[0])[1::-1]) for v in turns]  # of the box's first edge
    assert abs(np.exp(1j * np.array(angles)).mean()) < 0.2 and np.ptp(angles) > 6, "all round"


def test_sheets_and_rods_lie_flat(tmp_path: Path) -> None:
    square = np.array([[0, 0, 0], [1, 0, 0.5], [1, 1, 0.5], [0, 1, 0.0]])
    flat = Model(tuple(checked([Part(square, np.array([[0, 1, 2], [0, 2, 3]]))], tmp_path / "x.obj", 9)))
    for vertices in (square, square + 1e-9 * np.random.default_rng(0).normal(size=(4, 3))):
        assert probability(vertices, (-0.5 / 1.25**0.5, 0, 1 / 1.25**0.5)) == pytest.approx(0.5)
    for seed in range(4):
        lying = posed(flat, up="z", pose="stable", rng=generator(seed)).vertices()
        assert np.ptp(lying[:, 2]) < 1e-9
    line = np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2.0]])
    normals, _ = resting_sides(line)
    assert np.allclose(normals @ np.ones(3), 0), "a rod lies on its side"


def test_large_and_round_hulls_are_thinned_out() -> None:
    points = np.random.default_rng(0).normal(size=(20000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    normals, probabilities = resting_sides(points)
    assert 100 < len(normals) <= 1000 and probabilities.max() < 0.05
    box = np.concatenate([BOX, np.random.default_rng(0).uniform(size=(20000, 3))])
    assert probability(box, (0, 0, -1)) == pytest.approx(probability(BOX, (0, 0, -1)), rel=1e-5)


def test_a_pose_is_a_function_of_model_and_seed() -> None:
    first = posed(model(), up="z", pose="stable", rng=generator(3))
    posed(model(BOX * 2), up="y", pose="stable", rng=generator(4))
    again = posed(model(), up="z", pose="stable", rng=generator(3))
    assert first.vertices().tobytes() == again.vertices().tobytes()
    other = posed(model(), up="z", pose="stable", rng=generator(5))
    assert not np.allclose(first.vertices(), other.vertices())


def test_without_scipy_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy.spatial", None)
    with pytest.raises(DopeError, match=r"pip install 'dope-descriptors\[render\]'"):
        resting_sides(BOX)
