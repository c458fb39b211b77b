"""Soft and moulded forms: superquadrics, rings of them, lofted hulls, mirrored bodies of a few rounded solids."""

from __future__ import annotations

import numpy as np

from pipeline.render.procedural.pieces import Dice, Piece, around, both, in_row, pieces
from pipeline.solids import grids
from pipeline.solids.bodies import ball, cylinder, soft_box, superquadric, supertoroid, tube
from pipeline.solids.grids import spline
from pipeline.solids.mesh import Mesh, outward, welded


def _radii(d: Dice) -> tuple[float, float, float]:
    return d.log(0.3, 1.0), d.log(0.3, 1.0), d.log(0.2, 1.0)


def _power(d: Dice) -> float:
    return d.pick((2.0, d.real(1.3, 2.0), d.real(2.5, 9.0), d.real(2.5, 9.0)))


def superquad(d: Dice) -> list[Piece]:
    """One superquadric, tapered, bent or pinched: boxes to balls to pillows, soap, stones, capsules."""
    body = superquadric(_radii(d), _power(d), _power(d), rows=26, columns=44)
    x, y, z = body.vertices.T
    high = float(z.max())
    way = d.pick(("none", "taper", "bend", "pinch"))
    if way == "taper":
        factor = 1 + d.real(-0.6, 0.6) * z / high
        x, y = x * factor, y * factor
    elif way == "bend":
        z = z + d.real(-0.5, 0.5) * x**2 / max(float(np.abs(x).max()), 0.5)
    elif way == "pinch":
        factor = 1 - d.real(0.15, 0.55) * np.exp(-((z / (0.45 * high)) ** 2))
        x, y = x * factor, y * factor
    return pieces("body", outward(body.deformed(x, y, z)))


def toroid(d: Dice) -> list[Piece]:
    """Rings: tyres, washers, square frames, cushions; a ball or disc within some."""
    half = d.real(0.1, 0.45), d.real(0.1, 0.6)
    found = pieces("body", supertoroid(1.0, half, _power(d), _power(d)))
    if d.chance(0.3):
        inner = 1.0 - half[0]
        fill = superquadric((inner * 1.03, inner * 1.03, half[1] * d.real(0.3, 1.0)), 2, d.pick((2.0, 8.0)))
        found += pieces("inside", fill)
    return found


def hull(d: Dice) -> list[Piece]:
    """A body lofted through rounded sections: boats, shoes, mice, bottles on their side, fuselages."""
    n = d.whole(4, 6)
    x = np.linspace(-1, 1, n)
    wide = d.real(0.2, 0.6) * np.array([d.real(0.65, 1.15) for _ in x])
    high = d.real(0.12, 0.45) * np.array([d.real(0.65, 1.2) for _ in x])
    if d.chance(0.6):
        wide[-1] *= 0.25
        high[-1] *= 0.3
    if d.chance(0.4):
        wide[0] *= 0.35
        high[0] *= 0.4
    middle = high if d.chance(0.6) else np.array([d.real(-0.05, 0.08) for _ in x])
    stations = spline(np.stack([x, 0 * x, wide, middle, high], axis=1), 26)
    stations[:, [2, 4]] = np.maximum(stations[:, [2, 4]], 0.03)
    body = outward(welded(grids.loft(stations, power=d.real(2, 5), sides=36)))
    found = pieces("body", body)

    def section(at: float) -> tuple[float, float, float]:
        w, c, h = (float(np.interp(at, stations[:, 0], stations[:, k])) for k in (2, 3, 4))
        return w, c, h

    extra = d.pick(("none", "none", "wings", "cabin", "wheels", "fin"))
    if extra == "wings":
        at = d.real(-0.2, 0.2)
        w, c, _ = section(at)
        reach, chord = d.real(0.5, 1.2), d.real(0.2, 0.5)
        rows = [(0, 0, 0.5 * chord, 0, 0.06), (w + reach, d.real(-0.5, 0.1), 0.3 * chord, 0.1, 0.03)]
        wing = outward(welded(grids.loft(np.array(rows), power=2.2, sides=24, axis=1)))
        found += pieces("wings", *both(wing.at(at, 0, c), 1))
        if d.chance(0.7):
            w, c, h = section(-0.8)
            tail = [m.scaled(0.45).at(-0.82, 0, c + 0.3 * h) for m in both(wing, 1)]
            found += pieces("wings", *tail)
    elif extra == "cabin":
        at = d.real(-0.4, 0.3)
        w, c, h = section(at)
        found += pieces(
            "cabin", superquadric((d.real(0.25, 0.45), 0.8 * w, 0.8 * h + 0.1), 2.5, 3).at(at, 0, c + 0.7 * h)
        )
    elif extra == "wheels":
        for at in (-0.6, 0.55):
            w, c, h = section(at)
            r = d.real(0.18, 0.26)
            wheel = cylinder(r, 0.16, bevel=0.03).turned(0, 90).at(at, w + 0.05, c - 0.9 * h)
            found += pieces("wheels", *both(wheel, 1))
            axle = tube([(at, -w - 0.02, c - 0.9 * h), (at, w + 0.02, c - 0.9 * h)], 0.05, sides=12)
            found += pieces("axles", axle, soft_box((0.2, w, h), 0.1).at(at, 0, c - 0.95 * h))
    elif extra == "fin":
        _, c, h = section(-0.75)
        rows = [(0.0, 0.0, 0.25, 0.0, 0.04), (h + d.real(0.3, 0.6), -0.2, 0.12, 0.0, 0.02)]
        fin = outward(welded(grids.loft(np.array(rows), power=2.2, sides=24, axis=1))).turned(0, 90)
        found += pieces("wings", fin.at(-0.7, 0, c))
    return found


def soft_group(d: Dice) -> list[Piece]:
    """A mirrored or radial group of overlapping rounded solids about a body: toys, fruit, dumb-bells, clouds."""
    core = _radii(d)
    found = pieces("body", superquadric(core, _power(d), _power(d)))
    style = d.pick(("top", "sides", "ring", "legs", "row"))
    size = d.real(0.25, 0.55) * min(core)
    if style == "top":
        r, z = core[0], core[2]
        for _ in range(d.whole(1, 3)):
            r *= d.real(0.55, 0.9)
            found += pieces("trim", superquadric((r, r, r), _power(d), 2.0, rows=16, columns=28).at(z=z + 0.6 * r))
            z += 1.4 * r
    elif style == "sides":
        long = d.log(0.3, 1.2)
        arm = superquadric((long, size, size), 2.0, d.pick((2.0, 5.0)), rows=16, columns=28)
        found += pieces("trim", *both(arm.turned(1, d.real(-50, 50)).at(x=core[0] + 0.4 * long)))
        found += pieces("trim", ball(0.7 * min(core)).at(z=core[2] + 0.3 * min(core)))
        if d.chance(0.5):
            foot = superquadric((size, size, long), 2.0, 3.0, rows=16, columns=28)
            found += pieces("trim", *both(foot.at(x=0.5 * core[0], z=-0.8 * core[2] - 0.5 * long)))
    elif style == "ring":
        n = d.whole(3, 9)
        one = ball((size, size, size * d.real(0.6, 1.6)), count=12).at(x=max(core[0], core[1]) * 0.95)
        found = pieces("body", superquadric((core[0], core[0], core[2]), 2.0, _power(d)))
        found += pieces("trim", *around(one.at(x=core[0] * 0.95 - float(one.vertices[:, 0].mean())), n))
    elif style == "legs":
        leg: Mesh = tube(
            [(0.5 * core[0], 0.5 * core[1], 0), (0.9 * core[0], 0.9 * core[1], -core[2] - d.log(0.2, 0.8))], 0.4 * size
        )
        found += pieces("legs", *[m for half in both(leg, 0) for m in both(half, 1)])
        if d.chance(0.6):
            head = 0.6 * min(core)
            found += pieces("trim", ball(head).at(x=core[0] + 0.2 * head, z=0.15 * core[2]))
    else:
        n = d.whole(2, 5)
        body = superquadric(core, _power(d), _power(d), rows=18, columns=32)
        found = pieces("body", *in_row(body, n, (1.75 * core[0], 0, 0)))
        rod = cylinder(0.3 * min(core), 1.75 * core[0] * (n - 1) + 0.01, segments=20)
        rod = rod.turned(1, 90).at(x=-0.875 * core[0] * (n - 1))
        found += pieces("trim", rod)
    return found
