"""Things for the hand and on the table: hammers, drivers, brushes, blades, cutlery, dumb-bells, devices, vehicles."""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Floats
from pipeline.render.procedural import profiles
from pipeline.render.procedural.pieces import Dice, Piece, around, both, corners, in_grid, in_row, pieces
from pipeline.solids import outlines
from pipeline.solids.bodies import (
    along,
    ball,
    block,
    cylinder,
    extrude,
    pipe,
    ring,
    soft_box,
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
    long, thick = d.log(0.8, 3.0), d.log(0.1, 0.26)
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
    t = d.real(0.06, 0.2)
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
        r = np.tile([0.84, 1.0], n)
        shape = np.stack([r * np.cos(angle.ravel()), r * np.sin(angle.ravel())], axis=1)
        slots = [outlines.turned(outlines.slot(0.25, 0.08, 5, (0.55, 0)), 90 * k) for k in range(4)]
        found = pieces("body", extrude(shape, 0.5 * t, holes=[outlines.circle(0.16, 20), *slots]))
        return found + (pieces("hub", pipe(0.3, 0.15, t).at(z=-0.25 * t)) if d.chance(0.6) else [])
    high, n = d.real(0.8, 1.6), d.whole(2, 4)
    hole = outlines.circle(0.08, 12)
    holes = [hole + (0.45, y) for y in (-0.3 * high, 0.3 * high)] + [hole + (0.65, 0)]
    leaf = outlines.rounded(outlines.rectangle(0.9, high, (0.45, 0)), np.array([1e-9, 0.1, 0.1, 1e-9]), 4)
    leaf_body = extrude(leaf, t, holes=holes).at(z=-0.5 * t)
    found = pieces("body", leaf_body, leaf_body.turned(1, 180 - d.pick((0.0, 40.0, 90.0))))
    barrel = cylinder(0.09 + 0.5 * t, 0.92 * high / (2 * n), segments=18).turned(0, 90)
    found += pieces("barrel", *in_row(barrel.at(y=0.23 * high / n), 2 * n, (0, high / (2 * n), 0)))
    return found + pieces("pin", cylinder(0.05 + 0.25 * t, high * 1.08, segments=14).turned(0, 90).at(y=0.54 * high))


def weights(d: Dice) -> list[Piece]:
    """Bars with ends: dumb-bells, rolling pins, reels, bones, axles, barbells, mirrored about their middle."""
    long, thin = d.log(0.5, 2.5), d.real(0.08, 0.22)
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


def device(d: Dice) -> list[Piece]:
    """Devices: a case with a screen, keys, dials, ports, feet, an antenna: phones, radios, consoles, speakers, cameras."""
    w, l, t = d.log(0.8, 2.4), d.log(0.7, 1.8), d.log(0.08, 1.0)
    case = d.pick(
        (
            block((w, l, t), bevel=0.12 * min(t, 0.5)),
            extrude(outlines.rounded(outlines.rectangle(w, l), d.real(0.05, 0.35), 6), t, bevel=0.1 * t, bevel_steps=3),
            soft_box((w, l, t), d.real(0.1, 0.4)),
        )
    )
    found = pieces("case", case)
    free_low, free_high = -0.44 * l, 0.44 * l
    top = t - 0.02
    if d.chance(0.6):  # a screen at the far end
        deep = d.real(0.3, 0.7) * 0.8 * l
        found += pieces("screen", block((0.84 * w, deep, 0.045), bevel=0.01).at(y=free_high - 0.5 * deep, z=top))
        free_high -= deep + 0.06 * l
    room = free_high - free_low
    if room > 0.25 * l:
        kind = d.pick(("keys", "keys", "dials", "speaker", "lens"))
        middle = 0.5 * (free_low + free_high)
        if kind == "keys":
            columns, rows = d.whole(2, 6), d.whole(1, 4)
            dx, dy = 0.84 * w / columns, room / rows
            size = 0.7 * min(dx, dy)
            key = d.pick(
                (block((0.75 * dx, 0.7 * dy, 0.07), bevel=0.015), cylinder(0.5 * size, 0.07, segments=16, bevel=0.015))
            )
            found += pieces("keys", *in_grid(key.at(y=middle, z=top), columns, rows, dx, dy))
        elif kind == "dials":
            n = d.whole(1, 4)
            r = 0.4 * min(0.84 * w / n, room)
            dial = cylinder(r, d.real(0.08, 0.3), top=0.88, bevel=0.02, segments=28)
            found += pieces("keys", *in_row(dial.at(y=middle, z=top), n, (0.84 * w / n, 0, 0)))
        else:
            r = 0.46 * min(0.84 * w, room)
            found += pieces("keys", ring(0.9 * r, 0.1 * r, segments=36).at(y=middle, z=top + 0.02))
            if kind == "lens":
                high = d.real(0.1, 0.6)
                barrel = [
                    (0.6 * r, 0),
                    (0.82 * r, 0),
                    (0.82 * r, 0.5 * high),
                    (0.74 * r, 0.55 * high),
                    (0.74 * r, high),
                    (0.6 * r, high),
                    (0.6 * r, 0),
                ]
                found += pieces(
                    "lens",
                    turned_body(barrel, 36).at(y=middle, z=top),
                    ball((0.62 * r, 0.62 * r, 0.2 * high)).at(y=middle, z=top + 0.4 * high),
                )
            else:
                found += pieces("lens", ball((0.85 * r, 0.85 * r, 0.12)).at(y=middle, z=top))
    extra = d.pick(("none", "feet", "antenna", "handle", "plug"))
    if extra == "feet":
        found += pieces("feet", *corners(cylinder(0.08, 0.1, top=1.2).at(0.38 * w, 0.38 * l, -0.08)))
    elif extra == "antenna":
        found += pieces(
            "antenna",
            tube([(0.4 * w, 0.42 * l, 0.5 * t), (0.4 * w, 0.42 * l + d.real(0.4, 1.2), 0.5 * t)], 0.035, sides=12),
            ball(0.06, count=12).at(0.4 * w, 0.42 * l + 0.02, 0.5 * t),
        )
    elif extra == "handle":
        path = [
            (-0.3 * w, 0.48 * l, 0.5 * t),
            (-0.3 * w, 0.5 * l + 0.25, 0.5 * t),
            (0.3 * w, 0.5 * l + 0.25, 0.5 * t),
            (0.3 * w, 0.48 * l, 0.5 * t),
        ]
        found += pieces("handle", tube(path, min(0.06, 0.3 * t)))
    elif extra == "plug":
        cable = spline(
            [
                (0, 0.48 * l, 0.5 * t),
                (0.1, 0.6 * l + 0.2, 0.5 * t),
                (-0.2, 0.6 * l + 0.5, 0.3 * t),
                (0.1, 0.6 * l + 0.9, 0.3 * t),
            ],
            30,
        )
        found += pieces("cable", tube(cable, min(0.05, 0.3 * t), sides=12))
    if d.chance(0.5):
        tilt = d.pick((90.0, 75.0))
        found = [Piece(p.mesh.turned(0, tilt), p.role) for p in found]
    return found


def vehicle(d: Dice) -> list[Piece]:
    """Carts, toy cars, trucks, wagons, locomotives, prams: a body on wheels."""
    long, wide, r = d.real(1.6, 3.0), d.real(0.8, 1.2), d.real(0.2, 0.4)
    axles = d.whole(2, 3)
    found = pieces("chassis", block((long, 0.8 * wide, 0.16), bevel=0.02).at(z=r))
    wheel: list[Mesh] = [
        cylinder(r, 0.16, bevel=0.03, segments=28).turned(0, 90),
        cylinder(0.4 * r, 0.24, segments=16).turned(0, 90).at(y=0.04),
    ]
    axle = tube([(0, -0.45 * wide, r), (0, 0.45 * wide, r)], 0.05, sides=12)
    for x in np.linspace(-0.5 * long + 1.1 * r, 0.5 * long - 1.1 * r, axles):
        found += pieces("axles", axle.at(x=x))
        found += pieces("wheels", *both(wheel[0].at(x=x, y=0.5 * wide + 0.03, z=r), 1))
        found += pieces("hubs", *both(wheel[1].at(x=x, y=0.5 * wide + 0.03, z=r), 1))
    z = r + 0.15
    kind = d.pick(("car", "truck", "loco", "cart", "tank"))
    if kind == "car":
        high = d.real(0.25, 0.4)
        found += pieces("body", soft_box((long * 1.04, 0.86 * wide, high), 0.25).at(z=z))
        a, b = d.real(0.45, 0.7) * long, d.real(0.25, 0.4) * long
        shape = outlines.rounded(
            np.array([(-0.5 * a, 0), (0.5 * a, 0), (0.5 * b, d.real(0.3, 0.45)), (-0.5 * b, d.real(0.3, 0.45))]),
            0.08,
            4,
        )
        found += pieces(
            "cabin",
            extrude(shape, 0.76 * wide, bevel=0.04)
            .turned(0, 90)
            .at(x=d.real(-0.15, 0.05) * long, y=0.38 * wide, z=z + high - 0.02),
        )
        found += pieces("trim", *both(ball((0.06, 0.1, 0.08), count=12).at(0.52 * long, 0.3 * wide, z + 0.6 * high), 1))
    elif kind == "truck":
        cab = d.real(0.25, 0.35) * long
        found += pieces("cabin", block((cab, 0.9 * wide, d.real(0.6, 0.9)), bevel=0.08).at(x=0.5 * (long - cab), z=z))
        bed_long = long - cab - 0.1
        if d.chance(0.5):
            found += pieces(
                "body",
                block((bed_long, 0.94 * wide, d.real(0.5, 1.1)), bevel=0.03).at(x=-0.5 * (long - bed_long), z=z - 0.01),
            )
        else:
            found += pieces(
                "body", cylinder(0.42 * wide, bed_long, bevel=0.08).turned(1, 90).at(x=-0.5 * long, z=z + 0.38 * wide)
            )
    elif kind == "loco":
        rr = 0.34 * wide
        found += pieces("body", cylinder(rr, 0.75 * long, bevel=0.04).turned(1, 90).at(x=-0.25 * long, z=z + 0.9 * rr))
        found += pieces(
            "cabin",
            block((0.3 * long, 0.9 * wide, 0.85), bevel=0.03).at(x=-0.34 * long, z=z),
            block((0.36 * long, wide, 0.07)).at(x=-0.34 * long, z=z + 0.84),
        )
        found += pieces(
            "trim",
            cylinder(0.1, 0.4, top=1.5).at(x=0.35 * long, z=z + 1.8 * rr),
            ball(0.13, count=12).at(x=0.08 * long, z=z + 1.85 * rr),
        )
    elif kind == "cart":
        high, t = d.real(0.3, 0.6), 0.06
        shape = outlines.rectangle(0.95 * long, 0.85 * wide)
        found += pieces(
            "body", extrude(shape, high, holes=[outlines.inset(shape, t)], top=d.real(1.0, 1.15)).at(z=z - 0.02)
        )
        arm = tube([(0.45 * long, 0, r + 0.1), (0.5 * long + 0.7, 0, d.real(0.2, 1.0) + r)], 0.04, sides=12)
        found += pieces(
            "handle",
            arm,
            tube(
                [
                    (0.5 * long + 0.7, -0.2, float(arm.high[2]) - 0.03),
                    (0.5 * long + 0.7, 0.2, float(arm.high[2]) - 0.03),
                ],
                0.045,
                sides=12,
            ),
        )
    else:
        found += pieces("body", superquadric((0.48 * long, 0.4 * wide, 0.3), 5, 3).at(z=z + 0.2))
        found += pieces("cabin", cylinder(0.32 * wide, 0.3, top=0.8, bevel=0.03).at(z=z + 0.42))
        found += pieces("trim", cylinder(0.07, 0.55 * long, segments=18).turned(1, 90).at(x=0.1, z=z + 0.58))
    return found


def umbrella(d: Dice) -> list[Piece]:
    """Things with a canopy on a stem: umbrellas, mushrooms, parasols, trees, pins, balloons, lollipops."""
    high = d.log(0.6, 2.5)
    r = d.real(0.5, 1.1) * min(1.0, high)
    thin = d.real(0.04, 0.25)
    stem = spline([(thin * d.real(1, 1.6), 0), (thin, 0.4 * high), (thin, high + 0.05)], 10)
    found = pieces("stem", turned_body(profiles.closed_profile(stem), 20))
    kind = d.pick(("cap", "cone", "ball", "tiers", "panels", "disc"))
    if kind == "cap":
        up = d.real(0.3, 0.9) * r
        dome = spline([(r, 0), (0.8 * r, 0.6 * up), (0.0, up)], 14)
        under: Floats = np.array([(0, 0.1 * up), (0.85 * r, -0.02)])
        found += pieces("cap", turned_body(np.concatenate([under, dome[:-1], [(0, up)]]), 40).at(z=high))
    elif kind == "cone":
        found += pieces("cap", cylinder(r, d.log(0.5, 2.2), top=0.02, segments=d.pick((36, 6, 8))).at(z=high))
    elif kind == "ball":
        found += pieces("cap", superquadric((r, r, r * d.real(0.6, 1.5)), 2, d.pick((2, 2, 3))).at(z=high + 0.55 * r))
    elif kind == "tiers":
        n = d.whole(2, 5)
        z = high
        for k in range(n):
            rr = r * (1 - 0.75 * k / n)
            found += pieces("cap", cylinder(rr, 0.7 * rr + 0.1, top=0.3, segments=d.pick((32, 32))).at(z=z))
            z += 0.45 * rr + 0.05
    elif kind == "panels":
        n = d.whole(6, 10)
        shape = outlines.circle(1, n)
        found += pieces("cap", extrude(shape * r, 0.45 * r, top=0.05).at(z=high - 0.1))
        rib = tube([(r * 0.98, 0, high - 0.1), (0, 0, high + 0.36 * r)], 0.02, sides=8)
        found += pieces("ribs", *around(rib, n), ball(0.06, count=10).at(z=high + 0.37 * r))
    else:
        found += pieces(
            "cap", cylinder(r, d.real(0.1, 0.3), bevel=0.05).at(z=-0.1).turned(0, 90).at(y=0, z=high + 0.9 * r)
        )
    if d.chance(0.3):
        found += pieces("base", cylinder(d.real(0.3, 0.7) * r, 0.12, top=0.8, bevel=0.02).at(z=-0.08))
    return found
