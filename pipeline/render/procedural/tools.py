"""Things for the hand and on the table: hammers, drivers, brushes, blades, cutlery, dumb-bells."""

from __future__ import annotations

import numpy as np

from pipeline.render.procedural import profiles
from pipeline.render.procedural.pieces import Dice, Piece, both, in_row, pieces
from pipeline.solids import outlines
from pipeline.solids.bodies import (
    along,
    ball,
    block,
    cylinder,
    extrude,
    pipe,
    superquadric,
    tube,
    turned_body,
)
from pipeline.solids.grids import spline
from pipeline.solids.mesh import Mesh


def _grip(d: Dice, long: float, thick: float) -> Mesh:
    """A handle from z = 0 to `long`."""
    kind = d.pick(("oval", "turned", "octagon", "swell"))
    if kind == "octagon":
        return extrude(
            outlines.rounded(outlines.rectangle(2 * thick, 1.6 * thick), 0.4 * thick, 1),
            long,
            top=d.real(0.7, 1.1),
            bevel=0.1 * thick,
        )
    if kind == "turned":
        return turned_body(profiles.closed_profile(profiles.turned_side(d, long, thick), 0.01), 24)
    bulge = d.real(0.9, 1.35)
    side = spline(
        [(0.6 * thick, 0), (thick * bulge, 0.15 * long), (0.75 * thick, 0.55 * long), (0.9 * thick, long)], 16
    )
    body = turned_body(profiles.closed_profile(side), 24)
    return body.scaled((1, 0.75 if kind == "oval" else 1, 1))


def hand_tool(d: Dice) -> list[Piece]:
    """A handle with a head: hammers, mallets, axes, drivers, chisels, shovels, brushes, rollers, rakes, spoons."""
    long, thick = d.log(0.8, 4.5), d.log(0.08, 0.26)
    found = pieces("handle", _grip(d, long, thick))
    z = long - 0.02
    head = d.pick(
        ("hammer", "mallet", "axe", "driver", "chisel", "shovel", "brush", "rake", "spoon", "pick", "blade", "fork")
    )
    if head == "hammer":
        w = d.real(0.4, 0.8)
        found += pieces("head", block((0.7 * w, 0.26, 0.28), bevel=0.03).at(z=z - 0.12))
        face = cylinder(0.16, 0.3 * w, bevel=0.03, segments=d.pick((28, 8))).turned(1, 90).at(x=0.3 * w, z=z + 0.02)
        found += pieces("head", face)
        if d.chance(0.5):
            found += pieces("head", face.scaled((-1, 1, 1)))
        else:
            claw = extrude(np.array([(0, -0.1), (0.5, -0.28), (0.5, -0.22), (0, 0.12)]), 0.2).turned(0, 90)
            found += pieces("head", claw.at(y=0.1).scaled((-1, 1, 1)).at(x=-0.33 * w, z=z + 0.02))
    elif head == "mallet":
        r, w = d.real(0.25, 0.5), d.real(0.35, 0.7)
        found += pieces(
            "head", cylinder(r, 2 * w, bevel=0.05, segments=d.pick((36, 8, 4))).at(z=-w).turned(1, 90).at(z=z)
        )
    elif head == "axe":
        edge, reach = d.real(0.35, 0.7), d.real(0.5, 0.9)
        shape = outlines.rounded(
            np.array(
                [
                    (-0.2, -0.15),
                    (0.2, -0.15),
                    (reach, -edge),
                    (reach + 0.08, 0),
                    (reach, edge * 0.8),
                    (0.2, 0.17),
                    (-0.2, 0.17),
                ]
            ),
            0.06,
            3,
        )
        body = extrude(shape, 0.22).turned(0, 90).at(y=0.11, z=z - 0.1)
        x, y, h = body.vertices.T
        found += pieces("head", body.deformed(x, y * np.clip(1 - 0.95 * (x - 0.1) / reach, 0.06, 1), h))
        if d.chance(0.4):
            found += pieces("head", *[found[-1].mesh.scaled((-1, 1, 1))])
    elif head == "driver":
        found += pieces(
            "head", cylinder(0.35 * thick, d.log(0.5, 2.0), segments=d.pick((16, 6)), top=d.real(0.6, 1)).at(z=z)
        )
        found += pieces("trim", cylinder(0.8 * thick, 0.12, bevel=0.02).at(z=z - 0.05))
    elif head in ("chisel", "blade"):
        w, up = d.real(0.15, 0.45), d.log(0.6, 2.0)
        tip = d.real(-0.6, 0.9) if head == "blade" else 1.0
        points = [
            (-0.5 * thick, 0),
            (0.5 * thick, 0),
            (w, 0.15 * up),
            (w, 0.8 * up),
            (w * tip, up),
            (-w, up * d.real(0.75, 1.0)),
            (-w, 0.15 * up),
        ]
        body = extrude(outlines.rounded(np.array(points), 0.05, 3), 0.07, bevel=0.025).turned(0, 90)
        found += pieces("head", body.at(y=0.035, z=z))
        if head == "blade":
            found += pieces("trim", block((3.2 * w, 0.2, 0.1), bevel=0.02).at(z=z - 0.05))
    elif head == "shovel":
        w, up = d.real(0.3, 0.6), d.real(0.6, 1.2)
        shape = outlines.rounded(np.array([(-w, 0), (w, 0), (w, 0.6 * up), (0.0, up), (-w, 0.6 * up)]), 0.2, 6)
        body = extrude(shape, 0.05).turned(0, 90).at(z=z - 0.06)
        x, y, h = body.vertices.T
        found += pieces("head", body.deformed(x, y + 0.6 * x**2, h), cylinder(0.8 * thick, 0.25, top=0.7).at(z=z - 0.1))
    elif head in ("brush", "rake", "fork"):
        n, w = d.whole(3, 8), d.real(0.3, 0.8)
        found += pieces("head", block((2 * w, 0.24, 0.2), bevel=0.03).at(z=z - 0.04))
        up = d.real(0.25, 0.8)
        tooth = (
            block((1.3 * w / n, 0.16, up))
            if head == "brush"
            else tube([(0, 0, 0), (0, 0.02, 0.6 * up), (0, 0.1, up)], 0.035, sides=10)
        )
        found += pieces("teeth", *in_row(tooth.at(z=z + 0.13), n, (1.9 * w / n, 0, 0)))
    elif head == "spoon":
        a, b = d.real(0.2, 0.45), d.real(0.35, 0.6)
        bowl = superquadric((a, 0.12, b), 2, 2, rows=18, columns=30)
        x, y, h = bowl.vertices.T
        found += pieces(
            "head", bowl.deformed(x, y - 0.5 * (1 - (x / a) ** 2 - (h / b) ** 2) * a * (y < 0.2), h).at(z=z + 0.85 * b)
        )
    else:
        angle = np.linspace(-0.55, 0.55, 15)
        r = d.real(1.2, 2.0)
        path = [(r * np.sin(a), 0, r * np.cos(a) - r) for a in angle]
        found += pieces(
            "head",
            along(path, outlines.rectangle(0.24, 0.24), scale=1.02 - 1.6 * angle**2 / 0.55, up=(0, 1, 0)).at(z=z),
        )
    return found


def spanner(d: Dice) -> list[Piece]:
    """Flat tools cut from plate: spanners, keys, combs, rulers, bottle openers, saw blades, hinges."""
    kind = d.pick(("spanner", "ring", "key", "comb", "saw", "hinge"))
    t = d.log(0.025, 0.2)
    if kind in ("spanner", "ring"):
        long, w, r = d.real(1.5, 3.0), d.real(0.12, 0.25), d.real(0.35, 0.55)
        found = pieces(
            "body",
            extrude(outlines.rounded(outlines.rectangle(long, 2 * w), 0.05, 2), 0.8 * t, bevel=0.02).at(z=0.1 * t),
        )
        nut = outlines.circle(0.55 * r, d.pick((6, 6, 12)))
        jaw = outlines.sector(0.5 * r, r, 285, 30)
        for sign in (1, -1):
            as_ring = kind == "ring" or (sign < 0 and d.chance(0.5))
            head = (
                extrude(outlines.circle(r, 36), t, holes=[nut], bevel=0.02)
                if as_ring
                else extrude(outlines.turned(jaw, 180 + d.real(-20, 20)), t, bevel=0.02)
            )
            head = head.at(x=0.5 * long + 0.8 * r)
            found += pieces("head", head if sign > 0 else head.turned(2, 180))
        return found
    if kind == "key":
        long, r = d.real(1.2, 2.2), d.real(0.3, 0.5)
        bow = d.pick(
            (
                outlines.circle(r, 32),
                outlines.petals(3, r, 0.4 * r, 60),
                outlines.rounded(outlines.rectangle(2 * r, 1.6 * r), 0.3 * r, 4),
            )
        )
        found = pieces("body", extrude(bow, t, holes=[outlines.circle(0.4 * r, 18)], bevel=0.02).at(x=-0.9 * r))
        found += pieces("body", cylinder(0.1, long, segments=18, bevel=0.02).turned(1, 90).at(x=-0.1, z=0.5 * t))
        for k in range(d.whole(2, 4)):
            found += pieces(
                "teeth", block((0.12, d.real(0.2, 0.45), 0.8 * t)).at(x=long - 0.2 - 0.18 * k, y=0.18, z=0.1 * t)
            )
        return found
    if kind == "comb":
        n = d.whole(6, 16)
        found = pieces("body", block((2, 0.3, t), bevel=0.02))
        tooth = extrude(np.array([(-0.6 / n, 0), (-0.35 / n, -0.8), (0.35 / n, -0.8), (0.6 / n, 0)]), 0.8 * t)
        return found + pieces("teeth", *in_row(tooth.at(y=-0.1, z=0.1 * t), n, (1.9 / n, 0, 0)))
    if kind == "saw":
        n = d.whole(16, 30)
        angle = np.arange(n)[:, None] * (2 * np.pi / n) + np.array([0.0, 0.03])
        shape = np.stack([np.cos(angle.ravel()), np.sin(angle.ravel())], axis=1)
        shape[::2] *= 0.84
        slots = [outlines.turned(outlines.slot(0.25, 0.08, 5, (0.55, 0)), 90 * k) for k in range(4)]
        found = pieces("body", extrude(shape, 0.5 * t, holes=[outlines.circle(0.16, 20), *slots]))
        return found + (pieces("hub", pipe(0.3, 0.15, t).at(z=-0.25 * t)) if d.chance(0.6) else [])
    high, n = d.real(0.8, 1.6), d.whole(2, 4)
    hole = outlines.circle(0.08, 12)
    holes = [outlines.shifted(hole, *place) for place in ((0.45, -0.3 * high), (0.45, 0.3 * high), (0.65, 0))]
    leaf = outlines.rounded(outlines.rectangle(0.9, high, (0.45, 0)), np.array([1e-9, 0.1, 0.1, 1e-9]), 4)
    leaf_body = extrude(leaf, t, holes=holes).at(z=-0.5 * t)
    found = pieces("body", leaf_body, leaf_body.turned(1, 180 - d.pick((0.0, 40.0, 90.0))))
    barrel = cylinder(0.09 + 0.5 * t, 0.92 * high / (2 * n), segments=18).turned(0, 90)
    found += pieces("barrel", *in_row(barrel.at(y=0.23 * high / n), 2 * n, (0, high / (2 * n), 0)))
    return found + pieces("pin", cylinder(0.05 + 0.25 * t, high * 1.08, segments=14).turned(0, 90).at(y=0.54 * high))


def weights(d: Dice) -> list[Piece]:
    """Bars with ends: dumb-bells, rolling pins, reels, bones, axles, barbells, mirrored about their middle."""
    long, thin = d.log(0.5, 4.0), d.real(0.08, 0.22)
    found = pieces("bar", cylinder(thin, 2 * long, segments=24).at(z=-long).turned(1, 90))
    x = long * d.real(0.5, 0.95)
    for _ in range(d.whole(1, 3)):
        r, w = d.real(1.6, 5.0) * thin, d.log(0.08, 0.6)
        if d.chance(0.2):
            one = ball(r).at(x=x + 0.8 * r)
            w = 1.6 * r
        else:
            one = cylinder(r, w, segments=d.pick((36, 36, 6, 8)), bevel=d.real(0.02, 0.2) * w).turned(1, 90).at(x=x)
        found += pieces("weights", *both(one))
        x += w - 0.01
    return found
