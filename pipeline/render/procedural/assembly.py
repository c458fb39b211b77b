"""The open end of the series: a core with features on it, put there by symmetry, which carry features themselves."""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Floats
from pipeline.render.procedural import profiles
from pipeline.render.procedural.pieces import Dice, Piece, in_row, pieces
from pipeline.solids import outlines
from pipeline.solids.bodies import ball, block, cylinder, extrude, pipe, ring, soft_box, superquadric, tube, turned_body
from pipeline.solids.mesh import Mesh


def assembly(d: Dice) -> list[Piece]:
    """Machine-like parts: housings with ports, flanged bodies, manifolds, fixtures, heads with levers."""
    core = _core(d)
    found = pieces("core", core)
    for step in range(d.whole(1, 4)):
        found += [Piece(mesh, f"feature {step}") for mesh in _features(d, core, depth=0)]
    return found


def _core(d: Dice) -> Mesh:
    """A body about the z axis without an opening at its top or sides."""
    kind = d.pick(("block", "cylinder", "outline", "turned", "soft", "bar", "super"))
    w, length, high = d.log(0.4, 1.8), d.log(0.4, 1.8), d.log(0.15, 2.4)
    if kind == "block":
        return block((w, length, high), bevel=d.pick((0.0, 0.05)))
    if kind == "cylinder":
        return cylinder(0.5 * w, high, segments=d.pick((36, 36, 6, 8)), bevel=0.03, top=d.pick((1.0, d.real(0.6, 1.0))))
    if kind == "outline":
        return extrude(profiles.compact_outline(d, 0.6), high, bevel=0.02)
    if kind == "turned":
        return turned_body(profiles.closed_profile(profiles.turned_side(d, high, 0.5 * w), 0.02), 36)
    if kind == "soft":
        return soft_box((w, length, high), d.real(0.1, 0.45))
    if kind == "bar":
        return (
            cylinder(0.5 * min(w, high), 2 * length, segments=28, bevel=0.03)
            .at(z=-length)
            .turned(1, 90)
            .at(z=0.5 * min(w, high))
        )
    return superquadric((0.5 * w, 0.5 * length, 0.5 * high), 4, 3, rows=18, columns=32).at(z=0.5 * high)


def _features(d: Dice, core: Mesh, depth: int) -> list[Mesh]:
    low, high = core.low, core.high
    size = high - low
    middle = 0.5 * (low + high)
    where = d.pick(("top", "top", "sides", "sides", "round", "foot", "through", "row"))
    if where == "through":
        axis = d.pick((0, 1))
        r = d.real(0.12, 0.4) * min(size[1 - axis], size[2])
        long = float(size[axis]) * d.real(1.15, 2.2)
        bar = cylinder(r, long, segments=d.pick((24, 24, 6)), bevel=0.05 * r).at(z=-0.5 * long)
        cap = cylinder(r * d.real(1.2, 1.8), 0.2 * r + 0.03, segments=24, bevel=0.02).at(z=0.5 * long - 0.02)
        both_ends = [bar, cap, cap.scaled((1, 1, -1))] if d.chance(0.6) else [bar]
        turn = 90 if axis == 0 else -90
        return [m.turned(1 - axis, turn).at(*middle) for m in both_ends]
    if where == "foot":
        t = d.real(0.05, 0.2) * float(size.min()) + 0.03
        grow = d.real(1.15, 1.8)
        shape = d.pick(
            (
                outlines.rounded(outlines.rectangle(grow * size[0], grow * size[1]), 0.1 * float(size[:2].min()), 4),
                outlines.circle(0.5 * grow * float(size[:2].max()), 36),
            )
        )
        return [extrude(shape, t, bevel=0.1 * t).at(middle[0], middle[1], low[2] - 0.7 * t)]
    if where == "top":
        scale = d.real(0.25, 0.8) * float(size[:2].min())
        made = _feature(d, scale, depth)
        spots = [0.0]
        if d.chance(0.4):
            made = [m.scaled(0.45) for m in made]
            spots = [-0.27 * float(size[0]), 0.27 * float(size[0])]
        return _set_on(core, made, [(middle[0] + x, middle[1]) for x in spots])
    if where == "row":
        n = d.whole(2, 5)
        pitch = 0.85 * float(size[0]) / n
        made = _feature(d, min(0.7 * pitch, 0.6 * float(size[1])), 1)
        return _set_on(core, made, [(middle[0] + pitch * (k - 0.5 * (n - 1)), middle[1]) for k in range(n)])
    level = d.real(0.3, 0.7) * float(size[2])
    scale = d.real(0.25, 0.75) * min(float(size[1]), float(size[2]), 2 * level)
    made = _feature(d, scale, depth)
    if where == "round":
        n = d.whole(3, 8)
        made = [m.scaled(min(1.0, 2.2 / n)) for m in made]
        directions = [360.0 * k / n for k in range(n)]
    else:
        directions = [0.0, 180.0] if d.chance(0.7) else [d.pick((0.0, 90.0))]
    found: list[Mesh] = []
    for degrees in directions:
        outwards = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.0])
        place = _hit(core, np.array([middle[0], middle[1], low[2] + level]) + 5 * outwards, -outwards)
        if place is not None:
            found += [m.turned(1, 90).turned(2, degrees).at(*place) for m in made]
    return found


def _set_on(core: Mesh, made: list[Mesh], places: list[tuple[float, float]]) -> list[Mesh]:
    """Copies of a feature on the core's upper side at positions (x, y); none where there is nothing to stand on."""
    found = []
    for x, y in places:
        place = _hit(core, np.array([x, y, float(core.high[2]) + 1]), np.array([0.0, 0, -1]))
        if place is not None:
            found += [m.at(*place) for m in made]
    return found


def _feature(d: Dice, size: float, depth: int) -> list[Mesh]:
    """What stands on a core, along z from just below 0, about as wide as `size`."""
    r = 0.5 * size
    kind = d.pick(
        ("stud", "block", "dome", "port", "port", "lever", "knob", "fin", "eye", "bolt", "cone", "core", "disc", "grip")
    )
    sink = -0.25 * r
    if kind == "core" and depth == 0:
        core = _core(d)
        small = core.scaled(size / float((core.high - core.low)[:2].max()))
        base = small.at(z=sink - float(small.low[2]))
        more = _features(d, base, depth + 1)
        return [base, *more]
    if kind in ("stud", "core"):
        return [cylinder(r, d.log(0.4, 3) * size - sink, bevel=0.08 * r, segments=d.pick((28, 28, 6))).at(z=sink)]
    if kind == "block":
        return [block((size, size * d.real(0.5, 1), d.log(0.3, 2) * size - sink), bevel=0.08 * r).at(z=sink)]
    if kind == "dome":
        return [ball((r, r, r * d.real(0.4, 1.2)))]
    if kind == "port":
        long = d.log(0.5, 2.0) * size
        tube_ = pipe(0.62 * r, 0.42 * r, long - sink, segments=24).at(z=sink)
        holes = outlines.around(outlines.circle(0.09 * r, 8), 0.8 * r, 6)
        rim = extrude(outlines.circle(r, 32), 0.2 * r, holes=[outlines.circle(0.42 * r, 24), *holes]).at(
            z=long - 0.19 * r
        )
        return (
            [tube_, rim]
            if d.chance(0.7)
            else [tube_, pipe(0.75 * r, 0.5 * r, 0.3 * r, segments=24).at(z=long - 0.28 * r)]
        )
    if kind == "lever":
        long, lean = d.log(1.5, 4) * size, d.real(-1.0, 1.0)
        bar = tube([(0, 0, sink), (0, 0, 0.4 * long), (0, lean * 0.5 * long, long)], 0.22 * r, sides=12)
        return [bar, ball(0.5 * r, count=14).at(0, lean * 0.5 * long, long), cylinder(0.5 * r, 0.4 * r).at(z=sink)]
    if kind == "knob":
        n = d.whole(4, 8)
        grip = extrude(outlines.petals(n, r, 0.25 * r, 8 * n), 0.8 * r, bevel=0.08 * r)
        return [cylinder(0.5 * r, 0.6 * r - sink).at(z=sink), grip.at(z=0.5 * r)]
    if kind == "fin":
        n = d.whole(2, 5)
        fins = in_row(block((0.5 * size / n, size, d.real(0.4, 1.2) * size - sink)).at(z=sink), n, (size / n, 0, 0))
        return [block((1.02 * size, 1.02 * size, 0.12 * r - sink)).at(z=sink), *fins]
    if kind == "eye":
        return [
            cylinder(0.45 * r, 0.6 * r - sink).at(z=sink),
            ring(0.7 * r, 0.25 * r, segments=28).turned(0, 90).at(z=1.2 * r),
        ]
    if kind == "bolt":
        return [
            cylinder(r, 0.2 * r - sink).at(z=sink),
            cylinder(0.75 * r, 0.7 * r, segments=6, bevel=0.08 * r).at(z=0.15 * r),
        ]
    if kind == "cone":
        return [cylinder(r, d.log(0.5, 2.5) * size - sink, top=d.real(0.05, 0.7)).at(z=sink)]
    if kind == "disc":
        wide = d.real(1.2, 2.0) * r
        teeth = outlines.gear(d.whole(10, 20), wide, 0.15 * wide) if d.chance(0.4) else outlines.circle(wide, 36)
        return [cylinder(0.35 * r, 1.2 * r - sink).at(z=sink), extrude(teeth, 0.35 * r, bevel=0.03 * r).at(z=0.5 * r)]
    legs = [(-0.8 * r, 0, sink), (-0.8 * r, 0, r), (0.8 * r, 0, r), (0.8 * r, 0, sink)]
    return [cylinder(r, 0.1 * r - sink).at(z=sink), tube(np.array(legs), 0.18 * r, sides=12)]


def _hit(mesh: Mesh, origin: Floats, direction: Floats) -> Floats | None:
    """Where a ray first meets a mesh (Möller and Trumbore 1997), or None."""
    origin = origin + np.array([1.3e-7, 2.1e-7, 1.7e-7])  # off the edges that symmetric meshes have in symmetry planes
    a, b, c = mesh.vertices[mesh.faces.T]
    e1, e2 = b - a, c - a
    p = np.cross(direction, e2)
    det = (e1 * p).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origin - a
        u = (s * p).sum(1) / det
        q = np.cross(s, e1)
        v = (q @ direction) / det
        t = (e2 * q).sum(1) / det
        hits = t[(np.abs(det) > 1e-15) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)]
    return None if not len(hits) else origin + hits.min() * direction
