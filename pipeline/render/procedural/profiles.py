"""Random profiles to turn and random outlines to extrude: what gives parts their character."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.geometry import Floats
from pipeline.render.procedural.pieces import Dice
from pipeline.solids import outlines
from pipeline.solids.grids import spline


def turned_side(d: Dice, height: float, radius: float) -> Floats:
    """The side (K, 2) of a turned part from z = 0 to `height`: radius and height, `radius` the largest by and large.

    A chain of cylinders, cones, beads, coves, grooves, flanges and curves that share a few radii, as a turner makes it;
    a third are symmetric about their middle.
    """
    sizes = [radius, radius * d.real(0.35, 0.9), radius * d.real(0.25, 0.75)]
    count = d.whole(1, 5)
    symmetric = count > 1 and d.chance(0.35)
    lengths = np.array([d.log(0.25, 2.0) for _ in range(count)])
    lengths *= (0.5 if symmetric else 1.0) * height / lengths.sum()
    points: list[tuple[float, float]] = []
    z, r = 0.0, sizes[d.whole(0, 1)]
    for length in lengths:
        after = d.pick(sizes)
        points += _element(d, r, after, z, float(length))
        z, r = z + length, after if d.chance(0.6) else d.pick(sizes)
    side = np.array(points)
    if symmetric:
        side = np.concatenate([side, (side * (1, -1) + (0, height))[::-1]])
    return without_repeats(side)


def _element(d: Dice, r: float, after: float, z: float, length: float) -> list[tuple[float, float]]:
    kind = d.pick(("cylinder", "cylinder", "cone", "bead", "cove", "groove", "flange", "ogee", "belly"))
    top = z + length
    if kind == "cylinder":
        return [(r, z), (r, top)]
    if kind == "cone":
        return [(r, z), (after, top)]
    if kind == "bead":
        angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
        bulge = min(0.5 * length, 0.8 * r)
        return [(r + bulge * np.cos(a), z + 0.5 * length * (1 + np.sin(a))) for a in angle]
    if kind == "cove":
        angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
        dent = min(0.5 * length, 0.6 * r)
        return [(r - dent * np.cos(a), z + 0.5 * length * (1 + np.sin(a))) for a in angle]
    if kind == "groove":
        low, high, floor = z + 0.35 * length, z + 0.65 * length, r * d.real(0.7, 0.9)
        return [(r, z), (r, low), (floor, low), (floor, high), (r, high), (r, top)]
    if kind == "flange":
        thin, wide = min(0.3 * length, 0.25 * r), r * d.real(1.1, 1.5)
        low, high = z + 0.5 * (length - thin), z + 0.5 * (length + thin)
        return [(r, z), (r, low), (wide, low), (wide, high), (r, high), (r, top)]
    if kind == "ogee":
        t = np.linspace(0, 1, 11)
        return [(r + (after - r) * (0.5 - 0.5 * np.cos(np.pi * s)), z + length * s) for s in t]
    middle = max(r, after) * d.real(0.6, 1.25)
    return [(x, y) for x, y in spline([(r, z), (middle, z + 0.5 * length), (after, top)], 12)]


def without_repeats(side: Floats) -> Floats:
    """A polyline without steps of no length."""
    step = np.linalg.norm(np.diff(side, axis=0), axis=1)
    return side[np.concatenate([[True], step > 1e-4 * np.abs(side).max()])]


def closed_profile(side: Floats, fillet: float = 0.0, steps: int = 3) -> Floats:
    """A side with its ends on the axis, its corners rounded or, with one step, cut off."""
    whole = np.concatenate([[(0, side[0, 1])], side, [(0, side[-1, 1])]])
    if fillet <= 0:
        return whole
    radii = np.full(len(whole), fillet)
    radii[[0, -1]] = 0
    return outlines.rounded(whole, radii, steps)


def cup_profile(side: Floats, wall: float, floor: float) -> Floats:
    """The closed profile of a vessel with this outer side: round the lip and down inside to the floor."""
    inner = without_repeats(np.maximum(side - (wall, 0), 0.3 * wall))
    inner = inner[inner[:, 1] > side[0, 1] + floor]
    low = np.interp(side[0, 1] + floor, side[:, 1], np.maximum(side[:, 0] - wall, 0.3 * wall))
    lip = [(side[-1, 0] - 0.5 * wall, side[-1, 1] + 0.3 * wall)]
    bottom = [(low, side[0, 1] + floor), (0, side[0, 1] + floor)]
    return np.concatenate([[(0, side[0, 1])], side, lip, inner[::-1], bottom])


def ring_profile(side: Floats, bore: float) -> Floats:
    """The closed profile of a turned part with a hole of radius `bore` through it."""
    side = np.maximum(side, (1.15 * bore, -np.inf))
    return np.concatenate([[(bore, side[0, 1])], side, [(bore, side[-1, 1])], [(bore, side[0, 1])]])


def outline(d: Dice, size: float = 1.0) -> Floats:
    """A random outline about the origin, its largest half extent `size` or a little less."""
    found = d.pick(_OUTLINES)(d)
    found = found - 0.5 * (found.min(0) + found.max(0))
    return found * (size / np.abs(found).max())


def compact_outline(d: Dice, size: float = 1.0) -> Floats:
    """A random outline with the origin well inside and room for holes."""
    found = d.pick(_COMPACT)(d)
    return found * (size / np.abs(found).max())


def _maybe_round(d: Dice, points: Floats, largest: float) -> Floats:
    if d.chance(0.3):
        return points
    return outlines.rounded(points, d.real(0.15, 1.0) * largest, d.pick((1, 4, 5)))


def _rectangle(d: Dice) -> Floats:
    w = d.log(0.25, 1.0)
    return _maybe_round(d, outlines.rectangle(2, 2 * w), 0.5 * w)


def _polygon(d: Dice) -> Floats:
    return _maybe_round(d, outlines.turned(outlines.circle(1, d.whole(3, 8)), d.pick((0.0, 30.0, 90.0))), 0.3)


def _ellipse(d: Dice) -> Floats:
    return outlines.circle(1, d.pick((32, 40, 48))) * (1, d.log(0.4, 1))


def _slot(d: Dice) -> Floats:
    return outlines.slot(2, 2 * d.real(0.2, 0.7), 10)


def _star(d: Dice) -> Floats:
    n = d.whole(4, 9)
    return _maybe_round(d, outlines.star(n, 1, d.real(0.45, 0.85)), 0.12)


def _gear(d: Dice) -> Floats:
    n = d.whole(8, 26)
    return outlines.gear(n, 1, d.real(0.08, 0.26), d.real(0.15, 0.35), d.real(0.08, 0.2))


def _petals(d: Dice) -> Floats:
    n = d.whole(2, 8)
    return outlines.petals(n, 1, d.real(0.15, 0.5) if n < 6 else d.real(0.08, 0.25), 16 * n if n > 3 else 48)


def _superellipse(d: Dice) -> Floats:
    return outlines.superellipse(2, 2 * d.log(0.35, 1), d.real(2.3, 7))


def _profile(d: Dice) -> Floats:
    kind = d.pick(("L", "U", "T", "I", "Z", "H", "+"))
    w, h = d.log(0.6, 1.6), d.log(0.6, 1.6)
    return _maybe_round(d, outlines.profile(kind, w, h, d.real(0.12, 0.32) * min(w, h)), 0.1)


def _sector(d: Dice) -> Floats:
    return outlines.sector(d.pick((0.0, d.real(0.3, 0.8))), 1.0, d.real(60, 300))


def _mirrored(d: Dice) -> Floats:
    n = d.whole(3, 5)
    heights = np.linspace(-1, 1, n)
    half = [(d.real(0.2, 0.9), z) for z in heights]
    half[0], half[-1] = (half[0][0] * d.pick((0.02, 0.6)), -1.0), (half[-1][0] * d.pick((0.02, 0.6)), 1.0)
    return outlines.mirrored(half, 26)


def _arrow(d: Dice) -> Floats:
    neck, stem = d.real(-0.2, 0.4), d.real(0.15, 0.4)
    points = [(-stem, -1), (stem, -1), (stem, neck), (0.8, neck), (0, 1), (-0.8, neck), (-stem, neck)]
    return _maybe_round(d, np.array(points, dtype=float), 0.08)


def _dee(d: Dice) -> Floats:
    angle = np.linspace(-np.pi / 2, np.pi / 2, 20)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    back = d.real(0.1, 1.0)
    return np.concatenate([arc, [(-back, 1.0), (-back, -1.0)]])


def _stepped(d: Dice) -> Floats:
    """Mirror-symmetric polygon of steps and slopes, like a machined bar's section."""
    n = d.whole(2, 4)
    x, half = d.real(0.5, 1.0), []
    for z in np.linspace(-1, 1, n + 1)[:-1]:
        half += [(x, z), (x if d.chance(0.7) else d.real(0.25, 1.0), z + 2 / n)]
        x = d.real(0.25, 1.0)
    right = without_repeats(np.array(half))
    return _maybe_round(d, np.concatenate([right, (right * (-1, 1))[::-1]]), 0.08)


def _wedge(d: Dice) -> Floats:
    top, lean = d.real(0.1, 0.9), d.real(-0.4, 0.4)
    points = [(-1, -0.6), (1, -0.6), (lean + top, 0.6), (lean - top, 0.6)]
    return _maybe_round(d, np.array(points, dtype=float), 0.2)


_COMPACT: tuple[Callable[[Dice], Floats], ...] = (
    _rectangle,
    _polygon,
    _ellipse,
    _superellipse,
    _gear,
    _petals,
    _rectangle,
)
_OUTLINES: tuple[Callable[[Dice], Floats], ...] = (
    *(_rectangle, _polygon, _ellipse, _slot, _star, _gear, _petals, _superellipse, _profile, _profile),
    *(_sector, _mirrored, _mirrored, _arrow, _dee, _stepped, _stepped, _wedge),
)


def hole_pattern(d: Dice, shape: Floats, margin: float) -> list[Floats]:
    """Holes that fit into an outline: one in the middle, a ring of them, a grid of them; often none.

    Every hole keeps `margin` from the outline and half of that from the others.
    """
    inner = _clearance(shape) - margin
    if inner < 0.12 * np.abs(shape).max():
        return []
    kind = d.pick(("none", "middle", "ring", "ring", "both", "grid"))
    holes: list[Floats] = []
    bore = inner * d.real(0.2, 0.75)
    if kind in ("middle", "both"):
        bore = bore if kind == "middle" else min(bore, 0.45 * inner)
        holes.append(_hole(d, bore))
    if kind in ("ring", "both"):
        inside = bore + 0.5 * margin if kind == "both" else 0.2 * inner
        radius = 0.5 * (inside + inner)
        n = d.whole(3, 8)
        size = min(0.5 * (inner - inside), 0.75 * radius * np.sin(np.pi / n)) * d.real(0.5, 0.95)
        if size > 0.02:
            one = _hole(d, size)
            start = d.pick((0.0, 180.0 / n))
            holes += outlines.around(one, radius, n, start)
    if kind == "grid":
        low, high = shape.min(0), shape.max(0)
        pitch = inner * d.real(0.45, 0.9)
        one = _hole(d, 0.5 * pitch * d.real(0.4, 0.75))
        lines = [np.arange(-9, 10) * pitch + (0.5 * pitch if d.chance(0.5) else 0) for _ in range(2)]
        places = [(x, y) for x in lines[0] for y in lines[1] if low[0] < x < high[0] and low[1] < y < high[1]]
        places = [p for p in places if distance_inside(shape, np.array(p)) > 0.4 * pitch + margin]
        holes += [one + p for p in places[:30]]
    return holes


def _hole(d: Dice, radius: float) -> Floats:
    kind = d.pick(("round", "round", "round", "square", "hex", "slot"))
    if kind == "round":
        return outlines.circle(radius, 20 if radius > 0.3 else 12)
    if kind == "square":
        return outlines.rectangle(1.4 * radius, 1.4 * radius)
    if kind == "hex":
        return outlines.circle(radius, 6)
    return outlines.slot(2 * radius, radius, 6)


def distance_inside(shape: Floats, point: Floats) -> float:
    """How far a point inside of an outline is from it; negative outside."""
    a, b = shape, np.roll(shape, -1, 0)
    side = b - a
    t = np.clip(((point - a) * side).sum(1) / (side**2).sum(1), 0, 1)
    distance = float(np.linalg.norm(a + t[:, None] * side - point, axis=1).min())
    crossed = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
    x = a[crossed, 0] + (point[1] - a[crossed, 1]) / (b - a)[crossed, 1] * (b - a)[crossed, 0]
    return distance if int((x > point[0]).sum()) % 2 else -distance


def _clearance(shape: Floats) -> float:
    """Radius of the largest circle about the origin that fits into an outline; 0 where the origin is outside."""
    return max(distance_inside(shape, np.zeros(2)), 0.0)
