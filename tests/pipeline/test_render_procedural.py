"""Procedural objects: one series everywhere, whole solids that hang together, of all kinds, in the renderer's frame."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from dope.common import seeds
from pipeline.render.procedural import FACES, KINDS, procedural_object, series
from pipeline.render.procedural.pieces import Dice
from pipeline.render.scene import Model
from pipeline.solids import bodies
from pipeline.solids.mesh import Mesh, area_vectors, merged, shaded, signed_volume

HERE = Path(__file__).parents[2]


def digest(model: Model) -> str:
    parts = [(p.vertices, p.faces, p.normals, np.array(p.colour or (-1, -1, -1))) for p in model.parts]
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for p in parts for array in p)).hexdigest()


def solids(model: Model) -> list[Mesh]:
    """The model's closed surfaces: shaded vertices in one place made one, then what hangs together by faces."""
    found = []
    for part in model.parts:
        points, of = np.unique(np.round(part.vertices, 9), axis=0, return_inverse=True)
        faces = of.reshape(-1)[part.faces]
        label = np.arange(len(points))
        while True:
            low = label[faces].min(1)
            new = label.copy()
            np.minimum.at(new, faces.ravel(), np.repeat(low, 3))
            if np.array_equal(new, label):
                break
            label = new
        for name in np.unique(label[faces[:, 0]]):
            own = faces[label[faces[:, 0]] == name]
            used, index = np.unique(own, return_inverse=True)
            found.append(Mesh(points[used], index.reshape(-1, 3)))
    return found


def crossings(starts: np.ndarray, stops: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """How many triangles (F, 3, 3) each segment (N, 3) crosses (Möller and Trumbore)."""
    d, e1, e2 = (stops - starts)[:, None], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p, s = np.cross(d, e2), starts[:, None] - triangles[:, 0]
    q = np.cross(s, e1)
    with np.errstate(divide="ignore", invalid="ignore"):
        det = (p * e1).sum(-1)
        u, v, t = (s * p).sum(-1) / det, (q * d).sum(-1) / det, (q * e2).sum(-1) / det
        return ((u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)).sum(1)


def meet(one: Mesh, two: Mesh) -> bool:
    """Whether the surfaces of two solids cross, or one lies in the other."""
    low, high = np.maximum(one.low, two.low) - 1e-9, np.minimum(one.high, two.high) + 1e-9
    if (low > high).any():
        return False
    for a, b in ((one, two), (two, one)):
        triangles = b.vertices[b.faces]
        near = triangles[((triangles.max(1) >= low) & (triangles.min(1) <= high)).all(1)]
        starts, stops = a.vertices[a.faces].reshape(-1, 3), a.vertices[np.roll(a.faces, -1, axis=1)].reshape(-1, 3)
        inside = ((np.maximum(starts, stops) >= low) & (np.minimum(starts, stops) <= high)).all(1)
        starts, stops = starts[inside], stops[inside]
        if any(crossings(starts[k : k + 300], stops[k : k + 300], near).any() for k in range(0, len(starts), 300)):
            return True
        if crossings(a.vertices[:1], a.vertices[:1] + np.array([3.01, 0.17, 0.23]), triangles)[0] % 2:
            return True
    return False


def hang_together(found: list[Mesh]) -> bool:
    left, reached = set(range(1, len(found))), [0]
    while reached:
        here = reached.pop()
        new = {other for other in left if meet(found[here], found[other])}
        left -= new
        reached += new
    return not left


def made(kind: str, number: int) -> Model:
    """An object of a kind that comes out right."""
    for attempt in range(9):
        dice = Dice(seeds.generator("test", kind, number, attempt))
        model = series._model(dice, KINDS[kind][0](dice))
        if model is not None:
            return model
    raise AssertionError(f"{kind} never comes out right")


def test_an_object_is_a_function_of_its_number_and_the_seed_in_every_process() -> None:
    numbers = [3, 17, 40, 141]
    here = [digest(procedural_object(number, 5)) for number in reversed(numbers)][::-1]
    assert len({*here, digest(procedural_object(3, 6))}) == 5
    code = (
        "from tests.pipeline.test_render_procedural import digest, procedural_object\n"
        f"print(*(digest(procedural_object(number, 5)) for number in {numbers}))"
    )
    env = {**os.environ, "PYTHONHASHSEED": "7", "PYTHONPATH": str(HERE)}
    there = subprocess.run([sys.executable, "-c", code], env=env, cwd=HERE, capture_output=True, text=True, check=True)
    assert there.stdout.split() == here


@pytest.mark.parametrize("kind", KINDS)
def test_objects_of_every_kind_are_whole_solids_that_hang_together(kind: str) -> None:
    for number in range(2):
        model = made(kind, number)
        assert FACES[0] <= model.n_faces <= FACES[1]
        points = model.vertices()
        assert points.max(0) == pytest.approx(-points.min(0)) and np.abs(points).max() == pytest.approx(0.5)
        for part in model.parts:
            assert part.normals is not None and part.normals.shape == part.vertices.shape
            assert np.linalg.norm(part.normals, axis=1) == pytest.approx(1)
            areas = area_vectors(Mesh(part.vertices, part.faces))
            assert np.linalg.norm(areas, axis=1).min() > 5e-10
            # smoothing never turns a normal far from its faces, bar a few slivers
            cosine = np.einsum(
                "ij,ikj->ik", areas / np.linalg.norm(areas, axis=1, keepdims=True), part.normals[part.faces]
            )
            assert (cosine.min(1) < 0.3).mean() < 0.01
        found = solids(model)
        for solid in found:
            a, b, c = solid.faces.T
            sides = np.concatenate([a * 10**6 + b, b * 10**6 + c, c * 10**6 + a])
            back = np.concatenate([b * 10**6 + a, c * 10**6 + b, a * 10**6 + c])
            assert np.array_equal(np.sort(sides), np.sort(back)), "a surface that is not closed"
            assert signed_volume(solid) > 0, "faces that look inwards"
        assert hang_together(found)


def test_the_test_for_what_hangs_together_sees_gaps() -> None:
    plate = bodies.block((1, 1, 0.1))
    assert hang_together([plate, bodies.cylinder(0.2, 1).at(z=0.09)])
    assert hang_together([bodies.ball(1), bodies.ball(0.5)])  # one in the other
    assert not hang_together([plate, bodies.cylinder(0.2, 1).at(z=0.101)])
    assert not hang_together([bodies.ring(1, 0.2), bodies.ball(0.7)])


def test_what_does_not_come_out_right_is_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = iter(
        [bodies.superquadric((1, 1, 1), 2, 2, rows=80, columns=80), bodies.block((1, 1, 1e-12)), bodies.ball(1)]
    )
    asked: Counter[str] = Counter()

    def kind(d: Dice) -> list[series.Piece]:
        asked["times"] += 1
        return [series.Piece(next(sizes))]

    monkeypatch.setattr(series, "KINDS", {"only": (kind, 1.0)})
    assert procedural_object(0, 0).n_faces == len(bodies.ball(1).faces)
    assert asked["times"] == 3


def test_inside_out_pieces_are_turned() -> None:
    inner = bodies.ball(1)
    dice = Dice(seeds.generator("test"))
    model = series._model(dice, [series.Piece(Mesh(inner.vertices, inner.faces[:, ::-1]))])
    assert model is not None and signed_volume(Mesh(model.parts[0].vertices, model.parts[0].faces)) > 0


def test_simple_objects_get_more_faces_and_stay_the_same() -> None:
    model = series._model(Dice(seeds.generator("test")), [series.Piece(bodies.block((1, 1, 1)))])
    assert model is not None and model.n_faces == 12 * 4**3
    vertices, faces, _ = shaded(merged([bodies.block((1, 1, 1))]))
    assert (
        len(np.unique(np.round(np.concatenate([p.normals for p in model.parts if p.normals is not None]), 6), axis=0))
        == 6
    )
    assert len(vertices) == 24 and len(faces) == 12


def test_some_objects_have_colours_and_most_leave_them_to_the_renderer() -> None:
    models = [procedural_object(number, 1) for number in range(60)]
    share = np.mean([model.has_look for model in models])
    assert 0.08 < share < 0.45
    for model in models:
        if model.has_look:
            assert len(model.parts) > 1 and all(part.colour is not None for part in model.parts)
            assert all(0 <= value <= 1 for part in model.parts if part.colour for value in part.colour)
        else:
            assert len(model.parts) == 1


def test_a_series_draws_all_kinds() -> None:
    drawn = Counter(series._kind(Dice(seeds.generator("procedural", 0, number, 0))) for number in range(1500))
    assert len(drawn) == len(KINDS)
    weights = dict(KINDS.values())
    scale = 1500 / sum(weights.values())
    assert all(0.4 * weights[kind] * scale < count < 2 * weights[kind] * scale for kind, count in drawn.items())
