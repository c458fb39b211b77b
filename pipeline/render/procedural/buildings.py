"""Built things: columns, arches, stairs, houses, towers, fences, fountains, bridges, blocks in stacks."""

from __future__ import annotations

import numpy as np

from pipeline.render.procedural import profiles
from pipeline.render.procedural.pieces import Dice, Piece, around, both, corners, in_grid, in_row, pieces
from pipeline.solids import outlines
from pipeline.solids.bodies import along, ball, block, cylinder, extrude, turned_body
from pipeline.solids.mesh import Mesh


def column(d: Dice) -> list[Piece]:
    """Plinth, base, plain or fluted shaft, capital, abacus; posts and balusters."""
    high, r = d.log(0.7, 8.0), 0.5
    t = d.real(0.12, 0.3)
    square = d.chance(0.3)
    found = pieces("base", block((1.5, 1.5, t), bevel=0.03))
    side = profiles.turned_side(d, 0.4, 0.68)
    found += pieces("base", turned_body(profiles.closed_profile(side), 32).at(z=t - 0.01))
    z = t + 0.38
    n = d.whole(8, 14)
    shape = (
        outlines.rectangle(1.7 * r, 1.7 * r)
        if square
        else outlines.petals(n, r, 0.12, n * 8)
        if d.chance(0.5)
        else outlines.circle(r, 32)
    )
    found += pieces("shaft", extrude(shape, high, top=d.real(0.75, 1.0), levels=1, twist_deg=0).at(z=z))
    z += high - 0.01
    found += pieces("capital", cylinder(0.45, 0.3, top=1.5, segments=d.pick((32, 8, 4))).at(z=z))
    found += pieces("capital", block((1.45, 1.45, d.real(0.1, 0.25)), bevel=0.02).at(z=z + 0.29))
    if d.chance(0.4):
        found += pieces(
            "top",
            d.pick((ball(0.5).at(z=z + 0.85), cylinder(0.6, 0.9, top=0.05, segments=4).turned(2, 45).at(z=z + 0.38))),
        )
    return found


def arch(d: Dice) -> list[Piece]:
    """Arches, gates, door and window frames with panels, tunnels."""
    w, up, t = d.real(0.4, 0.8), d.log(0.3, 1.6), d.real(0.12, 0.3)
    deep = d.log(0.06, 1.5)
    steps = d.pick((3, 20, 20))
    inner = [(w * np.cos(a), up + w * np.sin(a) * d.pick((1.0,))) for a in np.linspace(0, np.pi, steps + 1)]
    out = w + t
    if d.chance(0.5):
        outer = [(out * np.cos(a), up + out * np.sin(a)) for a in np.linspace(np.pi, 0, steps + 1)]
    else:
        outer = [(-out, up + out), (out, up + out)]
    shape = np.array([(w, 0), *inner, (-w, 0), (-out, 0), *outer, (out, 0)])[::-1]
    shape = profiles.without_repeats(shape)
    body = extrude(shape, deep, bevel=d.pick((0.0, 0.02))).turned(0, 90).at(y=0.5 * deep)
    found = pieces("body", body)
    if d.chance(0.5):
        foot = block((1.4 * t, deep + 0.08, 0.15), bevel=0.02).at(x=w + 0.5 * t, z=-0.02)
        found += pieces("base", *both(foot))
    if d.chance(0.5):
        fill = np.array([(w + 0.01, 0), *inner, (-w - 0.01, 0)])
        fill = profiles.without_repeats(fill)
        found += pieces("door", extrude(fill, 0.4 * deep).turned(0, 90).at(y=0.2 * deep))
        if d.chance(0.6):
            found += pieces("knob", ball(0.06, count=12).at(0.6 * w, -0.22 * deep - 0.02, 0.5 * up))
    if d.chance(0.3):
        key = extrude(np.array([(-0.1, 0), (0.1, 0), (0.16, 1.3 * t), (-0.16, 1.3 * t)]), deep + 0.06).turned(0, 90)
        found += pieces("base", key.at(y=0.5 * deep + 0.03, z=up + w - 0.02))
    return found


def stairs(d: Dice) -> list[Piece]:
    """Flights of steps, solid or on strings, with railings; spiral stairs."""
    n = d.whole(3, 10)
    if d.chance(0.35):
        high, r = d.real(0.12, 0.25), 1.0
        step = extrude(outlines.sector(0.1, r, d.real(24, 40), 5), 0.6 * high)
        turn = d.real(22, 30)
        found = [Piece(step.turned(2, k * turn).at(z=k * high), "steps") for k in range(n + 4)]
        pole = cylinder(0.13, (n + 4) * high + d.real(0.1, 0.8), segments=20)
        return found + pieces("pole", pole)
    run, rise, w = d.real(0.2, 0.35), d.real(0.12, 0.3), d.real(0.6, 2.0)
    points = [(0.0, 0.0)]
    for k in range(n):
        points += [(k * run, (k + 1) * rise), ((k + 1) * run, (k + 1) * rise)]
    if d.chance(0.5):
        points += [(n * run, 0.0)]
    else:
        points += [(n * run, (n - 1) * rise - 0.1), (1.5 * run, 0.0)]
    shape = profiles.without_repeats(np.array(points))[::-1]
    found = pieces("body", extrude(shape, w).turned(0, 90).at(y=0.5 * w))
    if d.chance(0.5):
        tall = d.real(0.5, 0.9)
        ends = [(0.5 * run, 0.42 * w, rise), ((n - 0.5) * run, 0.42 * w, n * rise)]
        rail = tube_between(np.array(ends) + np.array([0, 0, tall]), 0.04)
        posts = [
            block((0.05, 0.05, tall + 0.02)).at((k + 0.5) * run, 0.42 * w, (k + 1) * rise - 0.01) for k in range(n)
        ]
        found += pieces("rail", *both(rail, 1), *[m for post in posts for m in both(post, 1)])
    return found


def tube_between(ends: np.ndarray, radius: float) -> Mesh:
    """A round bar from one point (3,) to another."""
    return along(ends, outlines.circle(radius, 12))


def house(d: Dice) -> list[Piece]:
    """Houses, barns, kennels, chapels: walls, a roof of some form, chimney, door, windows, porch, tower."""
    w, length, high = d.real(0.8, 1.4), d.log(0.9, 2.2), d.log(0.4, 1.5)
    found = pieces("walls", block((w, length, high)))
    roof = d.pick(("gable", "gable", "hip", "flat", "shed", "barrel"))
    over = d.real(0.04, 0.16)
    peak = d.real(0.3, 0.8) * w
    half = 0.5 * w + over
    if roof == "gable":
        t = 0.1
        shape = np.array([(-half, 0), (half, 0), (half, t), (0, peak + t), (-half, t)])
        found += pieces(
            "roof", extrude(shape, length + 2 * over).turned(0, 90).at(y=0.5 * length + over, z=high - 0.02)
        )
    elif roof == "hip":
        body = extrude(outlines.rectangle(w + 2 * over, length + 2 * over), peak, top=(0.05, max(0.05, 1 - w / length)))
        found += pieces(
            "roof", block((w + 2 * over, length + 2 * over, 0.06)).at(z=high - 0.02), body.at(z=high + 0.03)
        )
    elif roof == "flat":
        found += pieces("roof", block((w + 2 * over, length + 2 * over, 0.12), bevel=0.02).at(z=high - 0.02))
        if d.chance(0.5):
            found += pieces("walls", block((0.5 * w, 0.4 * length, d.real(0.2, 0.5))).at(0, 0.1 * length, high + 0.09))
    elif roof == "shed":
        shape = np.array([(-half, 0), (half, 0), (half, 0.08), (-half, peak)])
        found += pieces(
            "roof", extrude(shape, length + 2 * over).turned(0, 90).at(y=0.5 * length + over, z=high - 0.02)
        )
    else:
        shape = profiles.without_repeats(outlines.circle(half, 40)[:21] * (1, peak / half))
        found += pieces(
            "roof", extrude(shape, length + 2 * over).turned(0, 90).at(y=0.5 * length + over, z=high - 0.02)
        )
    if d.chance(0.5):
        found += pieces("chimney", block((0.18, 0.18, peak + 0.4)).at(0.25 * w, 0.25 * length, high))
    door_high = 0.6 * high
    found += pieces("door", block((0.22, 0.06, door_high)).at(0, -0.5 * length))
    window = block((0.16, 0.06, min(0.2, 0.3 * high)), bevel=0.01).at(y=-0.5 * length, z=0.45 * high)
    if d.chance(0.7):
        found += pieces("windows", *both(window.at(x=0.32 * w)))
        n = d.whole(1, 4)
        side = block((0.06, 0.4 * length / n, 0.3 * high)).at(x=0.5 * w, z=0.4 * high)
        found += [Piece(m, "windows") for row in in_row(side, n, (0, 0.85 * length / n, 0)) for m in both(row)]
    if d.chance(0.3):
        r = d.real(0.2, 0.35)
        up = high + peak * d.real(0.6, 1.6)
        sides = d.pick((4, 24, 8))
        tower = [
            Piece(cylinder(r, up, segments=sides), "walls"),
            Piece(cylinder(1.2 * r, d.real(0.3, 0.9), top=0.03, segments=sides).at(z=up - 0.01), "roof"),
        ]
        found += [Piece(p.mesh.turned(2, 45 if sides == 4 else 0).at(0.5 * w, 0.35 * length), p.role) for p in tower]
    if d.chance(0.5):
        found += pieces("base", block((w + 0.3, length + 0.3, 0.1)).at(z=-0.09))
    return found


def fence(d: Dice) -> list[Piece]:
    """Fences, balustrades, barriers: posts, pickets, rails."""
    n, long, high = d.whole(3, 11), d.real(1.0, 3.0), d.real(0.4, 1.6)
    pitch = long / n
    kind = d.pick(("picket", "baluster", "round", "board"))
    if kind == "picket":
        w = 0.5 * pitch * d.real(0.4, 0.85)
        shape = np.array([(-w, 0), (w, 0), (w, high), (0, high + w), (-w, high)])
        one = extrude(shape, 0.06).turned(0, 90)
    elif kind == "baluster":
        one = turned_body(
            profiles.closed_profile(profiles.turned_side(d, high, min(0.35 * pitch, 0.16))), 14 if n > 7 else 20
        )
    elif kind == "round":
        one = cylinder(0.2 * pitch, high, segments=16)
    else:
        one = block((0.8 * pitch, 0.07, high))
    found = pieces("pickets", *in_row(one, n, (pitch, 0, 0)))
    reach = long + 0.1
    if kind == "baluster":
        found += pieces(
            "rails",
            block((reach, 0.3, 0.1), bevel=0.02).at(z=high - 0.01),
            block((reach, 0.3, 0.1), bevel=0.02).at(z=-0.08),
        )
    else:
        rail = block((reach, 0.09, 0.1)).at(y=0.03 if kind != "round" else 0)
        found += pieces("rails", rail.at(z=0.2 * high), rail.at(z=0.75 * high))
    if d.chance(0.6):
        post = block((0.16, 0.16, high * 1.2), bevel=0.02).at(z=-0.09)
        found += pieces("posts", *both(post.at(x=0.5 * reach)))
        if d.chance(0.6):
            cap = d.pick(
                (
                    ball(0.12, count=12).at(z=high * 1.2),
                    cylinder(0.15, 0.12, top=0.1, segments=4).turned(2, 45).at(z=high * 1.2 - 0.11),
                )
            )
            found += pieces("posts", *both(cap.at(x=0.5 * reach)))
    return found


def tiers(d: Dice) -> list[Piece]:
    """Tiered things: fountains, cakes, pagodas, stepped towers, tiered trays, skyscrapers."""
    kind = d.pick(("fountain", "cake", "pagoda", "tower"))
    n = d.whole(2, 4)
    found: list[Piece] = []
    z, r = 0.0, 1.0
    sides = d.pick((36, 36, 8, 4, 6))
    for k in range(n):
        if kind == "fountain":
            up, high = d.real(0.3, 0.9) * r, 0.3 * r
            stem = profiles.closed_profile(profiles.turned_side(d, up + 0.05, 0.25 * r))
            found += pieces("stem", turned_body(stem, 24).at(z=z))
            z += up
            side = np.array([(0.3 * r, 0), (0.75 * r, 0.35 * high), (r, high)])
            found += pieces("bowls", turned_body(profiles.cup_profile(side, 0.08 * r, 0.05 * r), 36).at(z=z))
            z += 0.04 * r
            r *= d.real(0.5, 0.7)
        elif kind == "cake":
            high = d.real(0.25, 0.6)
            found += pieces("body" if k % 2 else "bowls", cylinder(r, high, bevel=0.04, segments=sides).at(z=z))
            z, r = z + high - 0.01, r * d.real(0.6, 0.85)
        elif kind == "pagoda":
            high = d.real(0.3, 0.6) * r
            found += pieces("body", cylinder(0.7 * r, high, segments=sides).at(z=z))
            found += pieces("roof", cylinder(1.1 * r, 0.35 * r, top=0.4, segments=sides).at(z=z + high - 0.01))
            z, r = z + high + 0.3 * r, r * d.real(0.65, 0.85)
        else:
            high = d.log(0.3, 2.0)
            found += pieces("body", cylinder(r, high, segments=sides).at(z=z))
            found += pieces("roof", cylinder(1.06 * r, 0.08, segments=sides).at(z=z + high - 0.02))
            z, r = z + high + 0.05, r * d.real(0.55, 0.85)
    if kind != "fountain":
        tip = d.pick(
            (
                ball(0.4 * r).at(z=z + 0.3 * r),
                cylinder(0.5 * r, 1.2 * r, top=0.05).at(z=z - 0.02),
                cylinder(0.06, 1.2 * r, segments=12).at(z=z - 0.02),
            )
        )
        found += pieces("tip", tip)
    else:
        found += pieces("stem", ball((0.3 * r, 0.3 * r, 0.6 * r)).at(z=z + 0.4 * r))
    if kind == "cake" and d.chance(0.5):
        candle = cylinder(0.05, d.real(0.2, 0.4), segments=12).at(x=0.7 * r, z=z - 0.02)
        found += pieces("tip", *around(candle, d.whole(3, 8)))
    return found


def blocks(d: Dice) -> list[Piece]:
    """Bricks with studs, stacked blocks, walls of bricks, dice with pips, mirror-symmetric towns of boxes."""
    kind = d.pick(("studs", "wall", "bridge", "town"))
    if kind == "studs":
        nx, ny = d.whole(1, 4), d.whole(1, 3)
        high = d.real(0.4, 1.2)
        found = pieces("body", block((nx, ny, high), bevel=0.03))
        stud = cylinder(0.3, 0.22, segments=20, bevel=0.03).at(z=high - 0.01)
        found += pieces("studs", *in_grid(stud, nx, ny, 1, 1))
        if d.chance(0.3):
            found += pieces("top", block((max(nx - 1, 1), ny, high), bevel=0.03).at(z=high + 0.18))
        return found
    if kind == "wall":
        rows, n, w = d.whole(2, 5), d.whole(2, 4), d.real(1.5, 2.6)
        brick = block((w * 0.97, 1.0, 0.97), bevel=0.06)
        found = []
        for row in range(rows):
            shift = 0.5 * w * (row % 2)
            found += [
                Piece(m.at(x=shift - 0.25 * w, z=row * 0.96), "body" if row % 2 else "other")
                for m in in_row(brick, n, (w * 0.965, 0, 0))
            ]
        return found
    if kind == "bridge":
        span, w, high = d.real(2, 4), d.real(0.6, 1.2), d.real(0.5, 1.2)
        n = d.whole(1, 3)
        found = pieces("deck", block((span, w, 0.16), bevel=0.03).at(z=high - 0.02))
        pier = extrude(outlines.slot(0.9 * w, 0.3, 8), high).turned(2, 90)
        found += pieces("piers", *in_row(pier, n + 1, (span / (n + 1), 0, 0)))
        rail = block((span, 0.06, 0.3)).at(y=0.5 * w - 0.05, z=high + 0.12)
        found += pieces("rails", *both(rail, 1))
        if d.chance(0.5):
            arc = [
                (0.5 * span * np.cos(a), 0.5 * w - 0.02, high + 0.1 + 0.7 * np.sin(a))
                for a in np.linspace(0.05, np.pi - 0.05, 20)
            ]
            found += pieces("rails", *both(along(np.array(arc), outlines.rectangle(0.1, 0.1), up=(0, 1, 0)), 1))
        return found
    found = pieces("base", block((2.2, 2.2, 0.15), bevel=0.03))
    for _ in range(d.whole(1, 3)):
        x, y = d.real(0.0, 0.8), d.real(0.0, 0.8)
        one = block((d.real(0.3, 0.7), d.real(0.3, 0.7), d.log(0.2, 1.8)), bevel=0.02).at(x, y, 0.14)
        found += pieces("body", *corners(one)) if d.chance(0.5) else pieces("body", *both(one))
    return found
