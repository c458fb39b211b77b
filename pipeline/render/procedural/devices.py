"""Devices and vehicles: cases with screens and keys, bodies on wheels."""

from __future__ import annotations

import numpy as np

from pipeline.render.procedural.pieces import Dice, Piece, both, corners, in_grid, in_row, pieces
from pipeline.solids import outlines
from pipeline.solids.bodies import (
    ball,
    block,
    cylinder,
    extrude,
    ring,
    soft_box,
    superquadric,
    tube,
    turned_body,
)
from pipeline.solids.grids import spline
from pipeline.solids.mesh import Mesh


def device(d: Dice) -> list[Piece]:
    """A case with a screen, keys, dials, feet, an antenna: phones, radios, consoles, speakers, cameras."""
    w, length, t = d.log(0.6, 2.6), d.log(0.7, 1.8), d.log(0.05, 1.0)
    case = d.pick(
        (
            block((w, length, t), bevel=0.12 * min(t, 0.5)),
            extrude(
                outlines.rounded(outlines.rectangle(w, length), d.real(0.05, 0.35), 6), t, bevel=0.1 * t, bevel_steps=3
            ),
            soft_box((w, length, t), d.real(0.1, 0.4)),
        )
    )
    found = pieces("case", case)
    free_low, free_high = -0.44 * length, 0.44 * length
    top = t - 0.02
    if d.chance(0.6):  # a screen at the far end
        deep = d.real(0.3, 0.7) * 0.8 * length
        found += pieces("screen", block((0.84 * w, deep, 0.045), bevel=0.01).at(y=free_high - 0.5 * deep, z=top))
        free_high -= deep + 0.06 * length
    room = free_high - free_low
    if room > 0.25 * length:
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
        found += pieces("feet", *corners(cylinder(0.08, 0.1, top=1.2).at(0.38 * w, 0.38 * length, -0.08)))
    elif extra == "antenna":
        found += pieces(
            "antenna",
            tube(
                [(0.4 * w, 0.42 * length, 0.5 * t), (0.4 * w, 0.42 * length + d.real(0.4, 1.2), 0.5 * t)],
                0.035,
                sides=12,
            ),
            ball(0.06, count=12).at(0.4 * w, 0.42 * length + 0.02, 0.5 * t),
        )
    elif extra == "handle":
        path = [
            (-0.3 * w, 0.48 * length, 0.5 * t),
            (-0.3 * w, 0.5 * length + 0.25, 0.5 * t),
            (0.3 * w, 0.5 * length + 0.25, 0.5 * t),
            (0.3 * w, 0.48 * length, 0.5 * t),
        ]
        found += pieces("handle", tube(path, min(0.06, 0.3 * t)))
    elif extra == "plug":
        cable = spline(
            [
                (0, 0.48 * length, 0.5 * t),
                (0.1, 0.6 * length + 0.2, 0.5 * t),
                (-0.2, 0.6 * length + 0.5, 0.3 * t),
                (0.1, 0.6 * length + 0.9, 0.3 * t),
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
