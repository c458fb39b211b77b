"""Furniture-like frames: tables, seats, shelves, cabinets, crates, beds, lamps."""

from __future__ import annotations

import numpy as np

from pipeline.render.procedural import profiles
from pipeline.render.procedural.pieces import Dice, Piece, both, corners, in_row, pieces
from pipeline.solids import outlines
from pipeline.solids.bodies import along, ball, block, cylinder, extrude, soft_box, tube, turned_body
from pipeline.solids.mesh import Mesh


def _leg(d: Dice, high: float, thick: float) -> Mesh:
    """One leg from z = 0 to `high` about z."""
    kind = d.pick(("square", "tapered", "round", "turned", "square"))
    if kind == "square":
        return block((2 * thick, 2 * thick, high), bevel=d.pick((0.0, 0.2 * thick)))
    if kind == "tapered":
        return extrude(outlines.rectangle(1.2 * thick, 1.2 * thick), high, top=1.7)
    if kind == "round":
        return cylinder(0.7 * thick, high, top=d.real(1.0, 1.6), segments=20)
    side = profiles.turned_side(d, high, 1.1 * thick)
    return turned_body(profiles.closed_profile(side), 20)


def _top(d: Dice, w: float, length: float, thick: float) -> Mesh:
    kind = d.pick(("box", "box", "rounded", "oval", "soft"))
    if kind == "box":
        return block((w, length, thick), bevel=d.pick((0.0, 0.2 * thick)))
    if kind == "rounded":
        return extrude(
            outlines.rounded(outlines.rectangle(w, length), d.real(0.1, 0.45) * min(w, length), 6),
            thick,
            bevel=0.2 * thick,
        )
    if kind == "oval":
        return extrude(outlines.superellipse(w, length, d.real(2, 4)), thick, bevel=0.2 * thick)
    return soft_box((w, length, thick), 0.35)


def table(d: Dice) -> list[Piece]:
    """Tables, desks, benches, stools: a top on legs, a pedestal or slabs, with rails, shelves, drawers."""
    w, length, high = 2.0, 2.0 * d.log(0.3, 1.0), d.log(0.4, 3.0)
    thick, leg = d.real(0.06, 0.25), d.real(0.06, 0.14)
    found = pieces("top", _top(d, w, length, thick).at(z=high))
    stand = d.pick(("legs", "legs", "legs", "pedestal", "slabs", "trestle", "splayed"))
    x, y = 0.5 * w * d.real(0.7, 0.9) - leg, 0.5 * length * d.real(0.7, 0.9) - leg
    x, y = max(x, 1.1 * leg), max(y, 1.1 * leg)
    if stand == "legs":
        found += pieces("legs", *corners(_leg(d, high + 0.02, leg).at(x, y)))
        if d.chance(0.6):
            deep = min(d.real(0.1, 0.3), 0.4 * high)
            found += pieces("frame", *both(block((2 * x, 0.7 * leg, deep)).at(y=y, z=high - deep + 0.01), 1))
            found += pieces("frame", *both(block((0.7 * leg, 2 * y, deep)).at(x=x, z=high - deep + 0.01), 0))
        if d.chance(0.3) and high > 0.8:
            found += pieces("frame", block((2 * x + leg, 2 * y + leg, 0.07)).at(z=d.real(0.15, 0.4) * high))
    elif stand == "splayed":
        r = 0.6 * leg
        line = [(x, y, high + 0.03), (1.25 * x, 1.25 * y, 0.0)]
        found += pieces("legs", *corners(tube(line, np.array([1.2 * r, 0.7 * r]), sides=14)))
    elif stand == "pedestal":
        side = profiles.turned_side(d, high + 0.02, d.real(0.15, 0.3))
        found += pieces("legs", turned_body(profiles.closed_profile(side), 28))
        found += pieces("foot", cylinder(d.real(0.45, 0.8) * min(1, length), 0.12, top=0.8, bevel=0.02))
    elif stand == "slabs":
        found += pieces("legs", *both(block((1.4 * leg, 0.9 * length, high + 0.01)).at(x=x)))
        if d.chance(0.6):
            found += pieces("frame", block((2 * x, 1.2 * leg, 0.5 * high)).at(z=0.4 * high))
    else:
        foot = block((2 * leg, 0.9 * length, 1.4 * leg), bevel=0.02)
        found += pieces("legs", *both(foot.at(x=x)), *both(block((1.3 * leg, 2.4 * leg, high + 0.01)).at(x=x)))
        found += pieces("frame", block((2 * x, 0.8 * leg, 1.6 * leg)).at(z=0.35 * high))
    return found


def seat(d: Dice) -> list[Piece]:
    """Chairs, armchairs, sofas, stools with backs."""
    w, length, high = d.pick((1.0, 1.0, d.log(1.0, 2.6))), d.real(0.85, 1.1), d.real(0.35, 1.0)
    if d.chance(0.35):  # upholstered
        thick, arm = d.real(0.2, 0.35), d.real(0.15, 0.25)
        found = pieces("seat", soft_box((w + 0.02, length, 0.3 + thick), 0.12))
        n = max(1, round(w / 0.9))
        cushion = soft_box((w / n * 0.97, length * 0.85, 0.22), 0.4)
        found += pieces("cushions", *in_row(cushion.at(y=-0.05, z=0.28 + thick), n, (w / n, 0, 0)))
        found += pieces("seat", soft_box((w + 2 * arm, 0.28, d.real(0.9, 1.4)), 0.3).at(y=0.5 * length))
        found += pieces(
            "seat", *both(soft_box((arm, length * 1.05, d.real(0.65, 0.85)), 0.35).at(x=0.5 * w + 0.45 * arm))
        )
        foot = cylinder(0.06, 0.16, top=1.3, segments=14).at(0.5 * w - 0.05, 0.4 * length, -0.14)
        return found + pieces("legs", *corners(foot))
    thick, leg, up = d.real(0.05, 0.14), d.real(0.04, 0.08), d.real(0.5, 1.3)
    kind = d.pick(("panel", "slats", "bars", "bow"))
    # a back stands on the seat's corners, so the seat has them
    top = d.pick((soft_box((w, length, thick), 0.35), block((w, length, thick), bevel=0.2 * thick)))
    found = pieces("seat", top.at(z=high))
    x, y = 0.5 * w - 1.2 * leg, 0.5 * length - 1.2 * leg
    one = _leg(d, high + 0.02, leg)
    found += pieces("legs", *corners(one.at(x * 0.97, y * 0.97)))
    lean = -d.real(0, 12)
    back: list[Mesh] = []
    if kind == "panel":
        back.append(
            extrude(outlines.rounded(outlines.rectangle(0.95 * w, up), d.real(0.02, 0.3), 5), 0.08, bevel=0.02)
            .turned(0, 90)
            .at(z=0.5 * up)
        )
    elif kind == "bow":
        half = 0.46 * w
        path = [(half * np.cos(a), 0, up * np.sin(a) ** 0.7) for a in np.linspace(0.0, np.pi, 18)]
        back.append(along(path, outlines.circle(0.045, 10), up=(0, 1, 0)))
        back += in_row(tube([(0, 0, -0.01), (0, 0, 0.8 * up)], 0.025, sides=10), 4, (0.25 * half * 1.2, 0, 0))
    else:
        back += both(block((1.8 * leg, 1.4 * leg, up)).at(x=x))
        n = d.whole(2, 5)
        if kind == "slats":
            back += [block((2 * x, 0.05, 0.35 * up / n)).at(z=z * up) for z in np.linspace(0.35, 0.9, n)]
        else:
            back += [
                block((2 * x, 0.07, 0.12)).at(z=0.86 * up),
                *in_row(block((0.05, 0.05, 0.9 * up)), n + 1, (1.6 * x / n, 0, 0)),
            ]
    found += [Piece(m.turned(0, lean).at(y=y - 0.01, z=high + 0.4 * thick), "back") for m in back]
    if d.chance(0.25):
        rail = block((0.1, 0.8 * length, 0.06), bevel=0.015).at(x=x, z=high + 0.42)
        post = block((0.06, 0.06, 0.45)).at(x=x, y=-0.3 * length, z=high)
        found += pieces("arms", *both(rail.at(y=0.1)), *both(post))
    return found


def shelf(d: Dice) -> list[Piece]:
    """Shelves, book cases, cabinets, chests of drawers, lockers: boards in a grid, with fronts, knobs, plinth, feet."""
    w, deep, high = d.log(0.6, 2.8), d.log(0.2, 1.0), d.log(0.5, 3.2)
    t = d.real(0.04, 0.1)
    rows, columns = d.whole(1, 5), d.whole(1, 3)
    open_front = d.chance(0.5)
    found: list[Piece] = []
    if open_front:
        found += pieces("body", *both(block((t, deep, high)).at(x=0.5 * w - 0.5 * t)))
        board = block((w - 0.01, deep * 0.98, t))
        found += [Piece(board.at(z=z), "boards") for z in np.linspace(0.02, high - t - 0.002, rows + 1)]
        if columns > 1:
            wall = block((t, deep * 0.96, high - t))
            found += pieces("boards", *in_row(wall.at(z=0.5 * t), columns - 1, (w / columns, 0, 0)))
        if d.chance(0.7):
            found += pieces("back", block((w - 0.005, 0.5 * t, high - 0.01)).at(y=0.5 * deep - 0.2 * t))
    else:
        found += pieces("body", block((w, deep, high), bevel=d.pick((0.0, 0.03))))
        fw, fh = w / columns, high / rows
        front = block((0.92 * fw, 0.06, 0.88 * fh), bevel=d.pick((0.0, 0.015))).at(y=-0.5 * deep, z=0.06 * fh)
        grip = d.pick(("knob", "bar", "none", "plate"))
        for z in np.arange(rows) * fh:
            found += pieces("fronts", *in_row(front.at(z=z), columns, (fw, 0, 0)))
            if grip != "none":
                if grip == "knob":
                    one = ball(0.05, count=10).at(y=-0.5 * deep - 0.06)
                elif grip == "bar":
                    one = tube(
                        np.array([(-0.15, 0, 0), (-0.15, -0.09, 0), (0.15, -0.09, 0), (0.15, 0, 0)])
                        * (min(1, fw), 1, 1),
                        0.02,
                        sides=8,
                    ).at(y=-0.5 * deep - 0.02)
                else:
                    one = block((0.3 * fw, 0.05, 0.04)).at(y=-0.5 * deep - 0.04)
                found += pieces("grips", *in_row(one.at(z=z + 0.5 * fh), columns, (fw, 0, 0)))
        if d.chance(0.4):
            found += pieces("top", block((w * 1.06, deep * 1.08, 0.07), bevel=0.02).at(z=high - 0.01))
    if d.chance(0.4):
        found += pieces(
            "feet", *corners(_leg(d, d.real(0.1, 0.5), 0.05).at(0.5 * w - 0.08, 0.5 * deep - 0.08).at(z=-0.0))
        )
        lift = float(found[-1].mesh.high[2]) - 0.01
        n = len(found)
        found = [Piece(p.mesh.at(z=lift) if k < n - 4 else p.mesh, p.role) for k, p in enumerate(found)]
    elif d.chance(0.3):
        found += pieces("feet", block((0.94 * w, 0.9 * deep, 0.12)).at(z=-0.11))
    return found


def crate(d: Dice) -> list[Piece]:
    """Boxes, crates of slats, pallets, trays, bins, boxes with lids and bands."""
    w, length, high = d.log(0.6, 2.4), d.log(0.5, 1.6), d.log(0.15, 1.6)
    t = d.real(0.04, 0.1)
    kind = d.pick(("slats", "pallet", "tray", "box", "bin"))
    if kind == "slats":
        n = d.whole(2, 5)
        found = pieces("posts", *corners(block((1.6 * t, 1.6 * t, high)).at(0.5 * w - 1.3 * t, 0.5 * length - 1.3 * t)))
        pitch = high / n
        slat = 0.75 * pitch
        for z in np.arange(n) * pitch + 0.1 * pitch:
            found += pieces("slats", *both(block((w, t, slat)).at(y=0.5 * length - 0.2 * t, z=z), 1))
            found += pieces("slats", *both(block((t, length - t, slat)).at(x=0.5 * w - 0.2 * t, z=z + 0.003)))
        return found + pieces("slats", block((w - t, length - t, t)).at(z=0.02))
    if kind == "pallet":
        n, deck = d.whole(4, 9), d.real(0.05, 0.08)
        board = block((w / n * d.real(0.65, 0.92), length, deck))
        found = pieces("slats", *in_row(board.at(z=0.3), n, (w / n, 0, 0)))
        found += pieces("posts", *in_row(block((w * 0.999, 0.14, 0.26)).at(z=0.05), 3, (0, 0.5 * length - 0.08, 0)))
        return found + pieces("slats", *in_row(board.at(z=0.0), 3, (0.5 * w - 0.5 * w / n, 0, 0)))
    if kind in ("tray", "bin"):
        shape = d.pick(
            (
                outlines.rounded(outlines.rectangle(w, length), d.real(0.05, 0.4), 5),
                outlines.superellipse(w, length, 4),
                outlines.circle(0.5 * w, 36),
            )
        )
        grow = d.real(1.0, 1.35)
        wall = extrude(shape, high, holes=[outlines.inset(shape, t)], top=grow)
        found = pieces("body", wall, extrude(outlines.inset(shape, 0.3 * t), t))
        if d.chance(0.5):
            rim = np.concatenate([shape * grow, np.full((len(shape), 1), high)], axis=1)
            found += pieces("rim", along(rim, outlines.circle(0.8 * t, 8), closed=True, up=(0, 0, 1)))
        return found
    found = pieces("body", block((w, length, high), bevel=d.pick((0.0, 0.04))))
    if d.chance(0.6):
        found += pieces("lid", block((w + 0.08, length + 0.08, d.real(0.1, 0.3)), bevel=0.02).at(z=high - 0.05))
    if d.chance(0.5):
        band = block((0.12, length + 0.1, high + 0.05))
        found += pieces("bands", *both(band.at(x=0.3 * w)))
    if d.chance(0.4):
        grip = along(
            np.array([(-0.2, 0, 0), (-0.2, -0.12, 0), (0.2, -0.12, 0), (0.2, 0, 0)]), outlines.circle(0.03, 10)
        )
        found += [Piece(m, "grips") for m in both(grip.at(y=-0.5 * length + 0.01, z=0.6 * high), 1)]
    return found


def bed(d: Dice) -> list[Piece]:
    """Beds and benches: a frame with a mattress, boards at the ends, pillows."""
    w, length, high = d.real(0.9, 1.9), 2.1, d.real(0.2, 0.5)
    found = pieces("frame", block((w, length, 0.16)).at(z=high))
    soft = d.real(0.2, 0.35)
    found += pieces("mattress", soft_box((0.95 * w, 0.97 * length, soft), 0.35).at(z=high + 0.12))
    post = _leg(d, high + 0.1, 0.06)
    found += pieces("legs", *corners(post.at(0.5 * w - 0.07, 0.5 * length - 0.07)))
    up = d.real(0.5, 1.2)
    found += pieces("boards", block((w + 0.04, 0.1, up), bevel=0.02).at(y=0.5 * length, z=high))
    if d.chance(0.6):
        found += pieces("boards", block((w + 0.04, 0.1, 0.6 * up), bevel=0.02).at(y=-0.5 * length, z=high))
    n = 1 if w < 1.3 else 2
    pillow = soft_box((0.8 * w / n, 0.45, 0.18), 0.45).at(y=0.32 * length, z=high + soft + 0.08)
    return found + pieces("pillows", *in_row(pillow, n, (0.9 * w / n, 0, 0)))


def lamp(d: Dice) -> list[Piece]:
    """Lamps and lanterns: foot, stem or arm, shade."""
    high, foot = d.log(0.8, 3.0), d.real(0.35, 0.7)
    found = pieces("base", cylinder(foot, d.real(0.06, 0.2), top=d.real(0.6, 1.0), bevel=0.02))
    wide, narrow, tall = d.real(0.45, 0.9), d.real(0.15, 0.5), d.real(0.3, 0.9)
    t = 0.04
    shade = turned_body(
        [(wide, 0), (narrow, tall), (narrow - t, tall), (wide - t, 0), (wide, 0)], d.pick((40, 40, 6, 12))
    )
    hoop = cylinder(narrow - 0.01, 0.04).at(z=tall - 0.025)
    if d.chance(0.5):
        if d.chance(0.5):
            stem = turned_body(profiles.closed_profile(profiles.turned_side(d, high, d.real(0.1, 0.3))), 28)
        else:
            stem = cylinder(0.05, high, segments=16)
        found += pieces("stem", stem.at(z=0.02), cylinder(0.05, 0.55 * tall + 0.12, segments=16).at(z=high))
        z = high + 0.55 * tall - tall + 0.1
        found += pieces("shade", shade.at(z=z), hoop.at(z=z))
        return found + pieces("bulb", ball((0.12, 0.12, 0.16)).at(z=high + 0.05))
    elbow = (d.real(-0.5, 0.1), 0.0, 0.6 * high)
    tip = (d.real(0.5, 1.0), 0.0, high)
    arm = tube([(0, 0, 0.03), elbow, tip], 0.05, sides=12)
    found += pieces("stem", arm, ball(0.09).at(*elbow))
    tilt = d.real(-10, 50)
    head = [
        Piece(shade, "shade"),
        Piece(hoop, "shade"),
        Piece(cylinder(narrow * 0.8, 0.12, top=0.6).at(z=tall - 0.05), "trim"),
    ]
    head.append(Piece(ball((0.11, 0.11, 0.15)).at(z=tall - 0.16), "bulb"))
    return found + [Piece(p.mesh.at(z=-tall).turned(1, -tilt).at(*tip), p.role) for p in head]
