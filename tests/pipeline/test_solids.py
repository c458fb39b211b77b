"""Bodies: closed, facing outwards, with the volume that geometry says, smooth where they are round."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from pipeline.solids import bodies, outlines
from pipeline.solids.grids import box, loft, sweep
from pipeline.solids.mesh import Mesh, area_vectors, merged, outward, shaded, signed_volume, subdivided, welded
from pipeline.solids.triangulate import triangulate


def is_closed(mesh: Mesh) -> bool:
    """Every edge is run along once in each direction."""
    sides = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]) @ [10**7, 1]
    back = np.concatenate([mesh.faces[:, [1, 0]], mesh.faces[:, [2, 1]], mesh.faces[:, [0, 2]]]) @ [10**7, 1]
    return len(np.unique(sides)) == len(sides) and np.array_equal(np.sort(sides), np.sort(back))


def polygon_area(outline: np.ndarray) -> float:
    x, y = outline.T
    return float(0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


def random_outline(rng: np.random.Generator, count: int) -> np.ndarray:
    angle = np.sort(rng.uniform(0, 2 * np.pi, count))
    return rng.uniform(0.55, 1.0, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


# ---- triangles of polygons


@pytest.mark.parametrize("seed", range(6))
def test_triangles_fill_a_polygon_with_holes_and_use_each_of_its_edges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    outline = random_outline(rng, 40)
    places = [(x, y) for x in (-0.2, 0.0, 0.2) for y in (-0.15, 0.1)][: seed + 1]  # in rows: collinear on purpose
    holes = [outlines.circle(0.06, 7, place)[::-1] for place in places]
    triangles = triangulate(outline, holes)
    points = np.concatenate([outline, *holes])
    a, b, c = points[triangles.T]
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(polygon_area(outline) - sum(polygon_area(hole[::-1]) for hole in holes))
    edges = {tuple(edge) for edge in np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])}
    starts = np.cumsum([0, 40, *(7 for _ in holes)])
    for first, last in pairwise(starts):
        loop = np.arange(first, last)
        assert {tuple(edge) for edge in np.stack([loop, np.roll(loop, -1)], axis=1)} <= edges


def test_points_on_a_straight_side_are_no_trouble() -> None:
    square = outlines.finer(outlines.rectangle(1, 1), 0.12)
    a, b, c = square[triangulate(square).T]
    assert len(square) == 36
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert areas.sum() == pytest.approx(1) and (areas > 0).all()


# ---- bodies


CLOSED = {
    "gear": lambda: bodies.extrude(outlines.gear(14, 1, 0.2), 0.4, holes=[outlines.circle(0.3, 12)], bevel=0.02),
    "round bevel": lambda: bodies.extrude(
        outlines.rounded(outlines.rectangle(1, 2), 0.2), 0.5, bevel=0.1, bevel_steps=3
    ),
    "twisted star": lambda: bodies.extrude(outlines.star(5, 1, 0.5), 2, levels=9, twist_deg=100, top=0.6),
    "profile": lambda: bodies.extrude(outlines.profile("I", 1, 1, 0.2), 2),
    "mirrored": lambda: bodies.extrude(outlines.mirrored([(0.1, -1), (0.6, 0), (0.2, 1)]), 0.3),
    "spring": lambda: bodies.tube([(np.cos(a), np.sin(a), a / 9) for a in np.linspace(0, 20, 90)], 0.1),
    "frame": lambda: bodies.along(
        [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], outlines.circle(0.1, 5), closed=True
    ),
    "pipe": lambda: bodies.pipe(1, 0.7, 2),
    "ring": lambda: bodies.ring(1, 0.3),
    "soft box": lambda: bodies.soft_box((1, 2, 0.5), 0.3),
    "superquadric": lambda: bodies.superquadric((1, 0.5, 0.7), 4, 3),
    "supertoroid": lambda: bodies.supertoroid(1, (0.3, 0.2), 3, 6),
    "demo's box": lambda: welded(box((1, 2, 3))),
    "demo's loft": lambda: outward(welded(loft([(0, 0, 1, 0, 1), (1, 0, 0.5, 0, 1)]))),
    "demo's sweep": lambda: outward(welded(sweep([(0, 0, 0), (0, 0, 1), (0, 1, 2)], 0.2))),
    "mirrored mesh": lambda: bodies.cylinder(1, 1, top=0.5).scaled((1, -2, 1)),
    "subdivided": lambda: subdivided(bodies.block((1, 1, 1), bevel=0.1)),
}


@pytest.mark.parametrize("name", CLOSED)
def test_bodies_are_closed_and_face_outwards(name: str) -> None:
    mesh = CLOSED[name]()
    assert is_closed(mesh)
    assert signed_volume(mesh) > 0
    assert np.linalg.norm(area_vectors(mesh), axis=1).min() > 1e-9


def test_volumes_are_those_of_the_bodies() -> None:
    outline, hole = outlines.gear(12, 1, 0.2), outlines.circle(0.3, 16)
    plate = bodies.extrude(outline, 0.5, holes=[hole])
    assert signed_volume(plate) == pytest.approx(0.5 * (polygon_area(outline) - polygon_area(hole)))
    assert signed_volume(bodies.cylinder(1, 2, top=0.5, segments=400)) == pytest.approx(np.pi * 2 * 1.75 / 3, rel=1e-3)
    assert signed_volume(bodies.ring(1, 0.2, segments=200, sides=100)) == pytest.approx(2 * np.pi**2 * 0.04, rel=2e-3)
    assert signed_volume(bodies.superquadric((1, 2, 3), 2, 2, rows=120, columns=120)) == pytest.approx(
        8 * np.pi, rel=3e-3
    )
    assert signed_volume(bodies.supertoroid(1, (0.3, 0.2), 2, 400, rows=40, columns=300)) == pytest.approx(
        2 * np.pi * 0.6 * 0.4, rel=0.02
    )
    # a mitred square frame: Pappus over its middle line
    frame = bodies.along([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], outlines.rectangle(0.2, 0.1), closed=True)
    assert signed_volume(frame) == pytest.approx(8 * 0.02)


def test_a_bevel_takes_the_edges_and_leaves_the_ends() -> None:
    mesh = bodies.extrude(outlines.rectangle(2, 2), 1, bevel=0.1)
    assert (mesh.low, mesh.high) == (pytest.approx([-1, -1, 0]), pytest.approx([1, 1, 1]))
    slab, slope = 4 * 0.8, 0.1 * (4 + 1.8**2 + 2 * 1.8) / 3  # Heron's frustum
    assert signed_volume(mesh) == pytest.approx(slab + 2 * slope)
    assert np.ptp(mesh.vertices[mesh.vertices[:, 2] == 0], axis=0)[:2] == pytest.approx([1.8, 1.8])


@pytest.mark.parametrize("twist", [-80, 80])
def test_twisted_walls_are_not_ragged(twist: float) -> None:
    mesh = bodies.extrude(outlines.circle(1, 40), 0.8, levels=10, twist_deg=twist)
    vertices, _, _ = shaded(mesh, 25)
    assert len(vertices) == (11 + 2) * 40  # smooth everywhere but round the ends


def test_an_inset_moves_every_side_by_its_distance() -> None:
    for corners in (3, 6, 40):
        outline = outlines.circle(1, corners)
        expected = outline * (1 - 0.1 / np.cos(np.pi / corners))
        assert outlines.inset(outline, 0.1) == pytest.approx(expected)


def test_an_inset_that_would_turn_sides_round_is_made_smaller() -> None:
    outline = outlines.rounded(outlines.rectangle(1, 1), 0.05, 4)
    moved = outlines.inset(outline, 0.2)
    sides, before = np.roll(moved, -1, 0) - moved, np.roll(outline, -1, 0) - outline
    assert ((sides * before).sum(1) > 0).all() and 0 < polygon_area(moved) < polygon_area(outline)


def test_a_closed_path_out_of_the_plane_has_no_seam() -> None:
    angle = np.arange(120) * (2 * np.pi / 120)
    r = 1 + 0.4 * np.cos(3 * angle)  # a trefoil knot
    path = np.stack([r * np.cos(2 * angle), r * np.sin(2 * angle), 0.4 * np.sin(3 * angle)], axis=1)
    mesh = bodies.along(path, outlines.rectangle(0.2, 0.1), closed=True)
    corner = mesh.vertices.reshape(120, 4, 3)[:, 0] - path
    step = np.linalg.norm(np.roll(corner, -1, 0) - corner, axis=1)
    assert step[-1] < 1.2 * step.max(initial=0, where=np.arange(120) < 119)


# ---- shading


def test_edges_are_sharp_and_round_sides_smooth() -> None:
    vertices, faces, normals = shaded(bodies.block((1, 1, 1)))
    assert (len(vertices), len(faces)) == (24, 12)
    assert (np.sort(np.abs(normals), axis=1) == [0, 0, 1]).all()
    vertices, faces, normals = shaded(bodies.cylinder(1, 2, segments=24))
    assert len(vertices) == 4 * 24
    side = np.abs(normals[:, 2]) < 0.5
    assert normals[side][:, :2] == pytest.approx(vertices[side][:, :2], abs=1e-9)
    assert (vertices[~side][:, 2] == np.where(normals[~side][:, 2] > 0, 2, 0)).all()


def test_shading_keeps_the_surface_and_its_normals_are_outward() -> None:
    mesh = merged([bodies.ball((1, 0.5, 0.7)), bodies.ring(2, 0.3).at(z=1)])
    vertices, faces, normals = shaded(mesh)
    assert np.array_equal(vertices[faces], mesh.vertices[mesh.faces])
    assert len(vertices) == len(mesh.vertices)  # nothing is sharp
    assert np.einsum("ij,ij->i", area_vectors(mesh), normals[faces].sum(1)).min() > 0
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)


def test_subdividing_keeps_the_volume() -> None:
    mesh = bodies.cylinder(1, 1, segments=9)
    finer = subdivided(mesh)
    assert len(finer.faces) == 4 * len(mesh.faces) and signed_volume(finer) == pytest.approx(signed_volume(mesh))
