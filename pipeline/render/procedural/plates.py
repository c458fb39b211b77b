"""Extruded parts: plates, bars, twisted prisms, gears, brackets, housings of plates with bosses and ribs."""

from __future__ import annotations

import numpy as np

from pipeline.render.procedural import profiles
from pipeline.render.procedural.pieces import Dice, Piece, around, both, corners, in_row, pieces
from pipeline.solids import outlines
from pipeline.solids.bodies import along, block, cylinder, extrude, pipe, ring, turned_body
from pipeline.solids.grids import spline
from pipeline.solids.mesh import Mesh, merged


def plate(d: Dice) -> list[Piece]:
    """A thin to stout plate of any outline, with holes and broken edges."""
    thick = d.log(0.03, 0.9)
    if d.chance(0.65):
        shape = profiles.compact_outline(d)
        holes = profiles.hole_pattern(d, shape, 0.1)
    else:
        shape, holes = profiles.outline(d), []
    bevel = d.pick((0.0, min(d.real(0.01, 0.04), 0.3 * thick)))
    return pieces("body", extrude(shape, thick, holes=holes, bevel=bevel, bevel_steps=d.pick((1, 3))))


def bar(d: Dice) -> list[Piece]:
    """A length of profile, straight or bent in an arc; end plates on some."""
    shape = profiles.outline(d, d.real(0.25, 0.6)) if d.chance(0.5) else None
    if shape is None:
        kind = d.pick(("L", "U", "T", "I", "Z", "H", "+"))
        shape = outlines.profile(kind, d.real(0.5, 1.0), d.real(0.5, 1.0), d.real(0.08, 0.2))
    long = d.log(1.5, 14.0)
    if d.chance(0.25):
        angle = np.radians(np.linspace(0, d.real(40, 170), 20))
        r = long / angle[-1]
        path = np.stack([r * np.cos(angle), 0 * angle, r * np.sin(angle)], axis=1)
        r_needed = 1.3 * float(np.abs(shape).max())
        path *= max(1.0, r_needed / r)
        return pieces("body", along(path, shape, up=(0, 1, 0)))
    body = extrude(shape, long, bevel=d.pick((0.0, 0.02)))
    found = pieces("body", body)
    if d.chance(0.3):
        wide = 2.6 * float(np.abs(shape).max())
        holes = [c * (0.38 * wide) + outlines.circle(0.06 * wide, 12) for c in outlines.rectangle(2, 2)]
        end = extrude(outlines.rounded(outlines.rectangle(wide, wide), 0.1, 3), 0.12, holes=holes)
        found += pieces("plates", end.at(z=-0.1))
        if d.chance(0.6):
            found += pieces("plates", end.at(z=long - 0.02))
    return found


def prism(d: Dice) -> list[Piece]:
    """A tall, tapered or twisted prism: drills, columns, twisted vases, obelisks."""
    shape = profiles.compact_outline(d) if d.chance(0.6) else profiles.outline(d)
    if len(shape) > 60:  # twisted, it would have too many faces
        shape = outlines.superellipse(2, 2, 5)
    high = d.log(0.6, 7.0)
    twist = d.pick((0.0, d.real(20, min(360, 130 * high))))
    top = d.pick((1.0, d.real(0.2, 0.95), d.real(1.05, 1.5)))
    levels = max(1, round(abs(twist) / 9))
    body = extrude(shape, high, top=top, twist_deg=twist, levels=levels, bevel=0.0 if twist else d.pick((0.0, 0.04)))
    found = pieces("body", body)
    if d.chance(0.3):
        found += pieces("base", cylinder(1.15, 0.2, bevel=0.03).at(z=-0.19))
    if d.chance(0.25):
        found += pieces("cap", cylinder(1.0 * top, 0.15, bevel=0.03).at(z=high - 0.01))
    return found


def gear_shaft(d: Dice) -> list[Piece]:
    """A stepped shaft with gears, pulleys, discs and collars on it."""
    thin, long = d.real(0.1, 0.25), d.log(1.0, 7.0)
    found = pieces("shaft", cylinder(thin, long, bevel=0.02, segments=24))
    z = 0.1 * long
    while z < 0.85 * long and len(found) < 6:
        wide = d.log(0.08, 0.45)
        kind = d.pick(("gear", "gear", "disc", "collar", "pulley"))
        r = d.real(0.4, 1.0)
        if kind == "gear":
            teeth = d.whole(10, 28)
            shape = outlines.gear(teeth, r, d.real(0.08, 0.2) * r, 0.28, 0.14)
            holes = []
            if r > 0.6 and d.chance(0.5):
                n, size = d.whole(3, 6), 0.25 * (0.75 * r - thin)
                at = 0.5 * (thin + 0.8 * r)
                holes = outlines.around(outlines.circle(size, 12), at, n)
            twist = d.pick((0.0, 0.0, d.real(-20, 20)))
            mesh = extrude(shape, wide, holes=holes, twist_deg=twist, levels=3 if twist else 1)
            found += pieces("gear", mesh.at(z=z), cylinder(1.8 * thin, wide + 0.12, segments=24).at(z=z - 0.06))
        elif kind == "disc":
            found += pieces("disc", cylinder(r, 0.5 * wide, bevel=0.02).at(z=z))
        elif kind == "collar":
            found += pieces(
                "disc", cylinder(thin * d.real(1.3, 2.2), wide, bevel=0.02, segments=d.pick((24, 6))).at(z=z)
            )
        else:
            found += pieces(
                "disc",
                cylinder(r, 0.4 * wide, top=0.75).at(z=z),
                cylinder(r * 0.75, 0.4 * wide, top=1 / 0.75).at(z=z + 0.39 * wide),
            )
        z += wide + d.real(0.05, 0.8)
    return found


def bracket(d: Dice) -> list[Piece]:
    """An angle of sheet metal: two plates with holes, ribs in the corner, bolts in some of the holes."""
    wide, deep, high = d.real(0.8, 2.2), d.real(0.7, 1.6), d.real(0.7, 2.0)
    thick = d.log(0.03, 0.18)
    n = d.whole(1, 3)
    hole = outlines.circle(0.16 * min(wide / n, deep, high), 16)
    places = [(wide * (k + 0.5) / n - 0.5 * wide, 0.12 * deep) for k in range(n)]
    corner = d.real(0.0, 0.3) * min(wide, deep)
    shape = outlines.rounded(outlines.rectangle(wide, deep), np.array([1e-9, 1e-9, corner, corner]), 5)
    foot = extrude(shape, thick, holes=[hole + p for p in places]).at(y=0.5 * deep)
    found = pieces("body", foot)
    shape = outlines.rounded(outlines.rectangle(wide, high), np.array([1e-9, 1e-9, corner, corner]), 5)
    if d.chance(0.5):
        big = outlines.circle(0.3 * min(wide, high), 28)
        holes = [outlines.shifted(big, 0, 0.1 * high)]
    else:
        holes = [outlines.shifted(hole, x, 0.15 * high) for x, _ in places]
    wall = extrude(shape, thick, holes=holes).turned(0, 90).at(y=thick, z=0.5 * high)
    found += pieces("body", wall)
    ribs = d.pick((0, 1, 2, 2))
    if ribs:
        reach, up = 0.8 * deep, 0.8 * high
        tri = np.array([(0, 0), (reach, 0), (0.12 * reach, up), (0, up)])
        rib = extrude(tri, thick).turned(0, 90).turned(2, 90).at(x=-0.5 * thick, y=0.9 * thick, z=0.9 * thick)
        shift = 0.5 * wide - 0.5 * thick
        found += pieces("body", *([rib] if ribs == 1 and n != 1 and n != 3 else both(rib.at(x=0.985 * shift))))
    if d.chance(0.4):
        size = float(np.abs(hole).max())
        for x, y in places:
            found += pieces("bolts", bolt(d, size * 0.98, 2.5 * thick).at(x, y + 0.5 * deep, -1.5 * thick))
    return found


def bolt(d: Dice, radius: float, long: float) -> Mesh:
    """A shank from z = 0 to `long` and a head on it."""
    head = cylinder(1.7 * radius, 1.1 * radius, segments=d.pick((6, 6, 18)), bevel=0.1 * radius)
    return merged([cylinder(radius, long, segments=16), head.at(z=long - 0.02 * radius)])


def fastener(d: Dice) -> list[Piece]:
    """Bolts, screws and rivets with ridges for a thread; nuts and washers on some."""
    r, long = d.real(0.12, 0.3), d.log(0.4, 3.5)
    turns = int(min(long * d.real(0.4, 0.9) / (0.3 * r), 24))
    pitch = 0.32 * r
    side = [(0.9 * r, 0.0)]
    tip = d.pick(("flat", "point"))
    if tip == "point":
        side = [(0.05 * r, -1.2 * r), (0.9 * r, 0.0)]
    for k in range(turns):
        side += [(r, (k + 0.5) * pitch), (0.82 * r, (k + 1) * pitch)]
    side += [(r, turns * pitch + 0.05), (r, max(long, turns * pitch + 0.1))]
    top = side[-1][1]
    found = pieces("shank", _turned_side_body(side))
    kind = d.pick(("hex", "hex", "socket", "pan", "sunk", "wing", "eye"))
    if kind == "hex":
        head = extrude(outlines.circle(1.9 * r, 6), 1.2 * r, bevel=0.12 * r)
    elif kind == "socket":
        head = extrude(outlines.circle(1.6 * r, 32), 1.7 * r, holes=[outlines.circle(0.85 * r, 6)])
        found += pieces("head", cylinder(1.5 * r, 0.8 * r).at(z=top))
    elif kind == "pan":
        dome = spline([(2 * r, 0.3 * r), (1.3 * r, 1.1 * r), (0, 1.4 * r)], 10)
        head = turned_body([(0, 0), (2 * r, 0), *dome[:-1], (0, 1.4 * r)], 32)
    elif kind == "sunk":
        head = cylinder(r, 1.1 * r, top=2.1)
    elif kind == "wing":
        head = cylinder(1.3 * r, 1.3 * r, bevel=0.1 * r)
        wing = extrude(
            outlines.rounded(
                np.array([(0, 0), (2.5 * r, 1.2 * r), (2.9 * r, 2.8 * r), (1.9 * r, 2.8 * r), (0, 1.2 * r)]), 0.4 * r, 4
            ),
            0.5 * r,
        )
        found += pieces("head", *[w.at(z=top) for w in around(wing.turned(0, 90).at(y=0.25 * r), 2)])
    else:
        head = ring(1.5 * r, 0.45 * r, segments=28).turned(0, 90).at(z=1.8 * r)
        found += pieces("head", cylinder(1.4 * r, 0.3 * r).at(z=top - 0.05 * r))
    found += pieces("head", head.at(z=top - 0.03 * r))
    if d.chance(0.4):
        nut = extrude(outlines.circle(1.9 * r, 6), 1.1 * r, holes=[outlines.circle(0.93 * r, 18)], bevel=0.08 * r)
        found += pieces("nut", nut.at(z=d.real(0.1, 0.5) * top))
    if d.chance(0.4):
        washer = pipe(2.4 * r, 0.93 * r, 0.25 * r)
        found += pieces("nut", washer.at(z=top - 0.25 * r))
    return found


def _turned_side_body(side: list[tuple[float, float]], segments: int = 24) -> Mesh:
    """A turned body with this side, closed on the axis."""
    return turned_body(profiles.closed_profile(np.array(side)), segments)


def mounted(d: Dice) -> list[Piece]:
    """A base plate with bosses, ribs, a housing and bolts on it, mirror-symmetric."""
    w, length, t = d.real(1.2, 2.4), d.real(1.0, 2.0), d.real(0.1, 0.25)
    hole = outlines.circle(0.07, 12)
    inset = 0.17
    places = [(x * (0.5 * w - inset), y * (0.5 * length - inset)) for x in (-1, 1) for y in (-1, 1)]
    shape = outlines.rounded(outlines.rectangle(w, length), d.real(0.05, 0.16), d.pick((1, 4)))
    found = pieces("base", extrude(shape, t, holes=[hole + p for p in places], bevel=0.02))
    top = t - 0.01
    kind = d.pick(("boss", "bosses", "block", "bearing"))
    if kind == "boss":
        r, h = d.real(0.25, 0.42) * min(w, length), d.log(0.3, 1.5)
        found += pieces("body", pipe(r, r * d.real(0.4, 0.8), h).at(z=top))
        n = d.pick((0, 3, 4, 6))
        if n:
            reach, up = min(0.5 * min(w, length) * 0.95, r + 0.5), h * d.real(0.4, 0.9)
            tri = np.array([(0.93 * r, 0), (reach, 0), (reach, 0.12 * up), (r, up), (0.93 * r, up)])
            rib = extrude(tri, 0.08).turned(0, 90).at(y=0.04, z=top)
            found += pieces("body", *around(rib, n, 45 if n == 4 else 0))
    elif kind == "bosses":
        r, h = 0.14, d.real(0.2, 0.8)
        one = pipe(r, 0.5 * r, h, segments=20).at(0.25 * w, 0.2 * length, top)
        found += pieces("body", *corners(one))
        if d.chance(0.6):
            found += pieces(
                "body",
                block((0.5 * w - 1.4 * r, 0.08, 0.6 * h)).at(0, 0.2 * length, top),
                block((0.5 * w - 1.4 * r, 0.08, 0.6 * h)).at(0, -0.2 * length, top),
            )
    elif kind == "block":
        bw, bl, h = w * d.real(0.35, 0.6), length * d.real(0.35, 0.75), d.log(0.3, 1.4)
        found += pieces("body", block((bw, bl, h), bevel=0.05).at(z=top))
        n = d.whole(2, 6)
        fin = block((0.4 * bw / n, bl * 1.02, d.real(0.1, 0.4)))
        if d.chance(0.6):
            found += pieces("fins", *in_row(fin.at(z=top + h - 0.02), n, (bw / n, 0, 0)))
        else:
            found += pieces("fins", cylinder(0.3 * min(bw, bl), d.real(0.2, 0.8), bevel=0.02).at(z=top + h - 0.02))
    else:
        r, thick = d.real(0.35, 0.55) * min(w, 1.6) * 0.7, d.real(0.25, 0.6) * length
        up = r * d.real(1.2, 1.8)
        arch = np.concatenate([[(-1.25 * r, 0), (1.25 * r, 0)], outlines.circle(1.25 * r, 48, (0, up))[:25]])
        body = extrude(profiles.without_repeats(arch), thick, holes=[outlines.circle(0.7 * r, 28, (0, up))], bevel=0.02)
        found += pieces("body", body.turned(0, 90).at(y=0.5 * thick, z=top))
        if d.chance(0.6):
            axle = cylinder(0.72 * r, thick * d.real(1.4, 3.0), bevel=0.02)
            found += pieces("axle", axle.at(z=-0.5 * float(axle.high[2])).turned(0, 90).at(z=top + up))
    if d.chance(0.5):
        for x, y in places:
            found += pieces("bolts", bolt(d, 0.072, t + 0.06).at(x, y, -0.02))
    return found
