"""Turned objects: spindles, wheels and pulleys, vessels with handles and lids, knobs, domes, stacks."""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Floats
from pipeline.render.procedural import profiles
from pipeline.render.procedural.pieces import Dice, Piece, around, both, pieces
from pipeline.solids import outlines
from pipeline.solids.bodies import ball, cylinder, extrude, ring, soft_box, superquadric, tube, turned_body
from pipeline.solids.grids import spline
from pipeline.solids.mesh import Mesh


def spindle(d: Dice) -> list[Piece]:
    """A solid turned part, round or with a few flat sides, sometimes with a bore."""
    height = d.log(0.25, 10.0)
    side = profiles.turned_side(d, height, 1.0)
    segments = d.pick((32, 40, 40, 40, d.whole(3, 8), d.whole(10, 16)))
    if d.chance(0.35):
        return pieces("body", turned_body(profiles.ring_profile(side, d.real(0.15, 0.5) * side[:, 0].min()), segments))
    fillet = d.pick((0.0, d.real(0.01, 0.06)))
    return pieces("body", turned_body(profiles.closed_profile(side, fillet, d.pick((1, 3))), segments))


def fluted(d: Dice) -> list[Piece]:
    """A turned part whose sides are cut into flutes or knurls that may wind round it."""
    height, count = d.log(0.4, 4.0), d.whole(5, 20)
    side = profiles.turned_side(d, height, 1.0)
    levels = np.linspace(side[0, 1], side[-1, 1], d.whole(8, 20))
    side = np.stack([np.interp(levels, side[:, 1] + 1e-6 * np.arange(len(side)), side[:, 0]), levels], axis=1)
    body = turned_body(profiles.closed_profile(side), min(count * 6, 112))
    x, y, z = body.vertices.T
    depth, wind = d.real(0.04, 0.2), d.pick((0.0, 0.0, d.real(-1.5, 1.5)))
    wave = np.cos(count * np.arctan2(y, x) + wind * np.pi * z * count / 8)
    factor = 1 - depth * (0.5 - 0.5 * wave if d.chance(0.5) else np.abs(wave))
    found = pieces("body", body.deformed(x * factor, y * factor, z))
    if d.chance(0.5):
        cap = cylinder(float(side[-1, 0]) * d.real(0.7, 1.15), d.real(0.06, 0.2), bevel=0.02)
        found += pieces("trim", cap.at(z=height - 0.02))
    return found


def wheel(d: Dice) -> list[Piece]:
    """Rim, hub and spokes or a disc; tyre treads and bolts on some."""
    wide, hub, inner = d.log(0.06, 0.8), d.real(0.12, 0.3), d.real(0.6, 0.85)
    rim = turned_body(
        outlines_closed(outlines.rounded(_ring_section(d, inner, 1.0, wide), d.real(0.0, 0.3) * wide, 3)), 44
    )
    found = pieces("rim", rim)
    bore, long = hub * d.real(0.3, 0.7), wide * d.real(0.7, 1.5)
    hub_body = turned_body(outlines_closed(_ring_section(d, bore, hub, long)), 28)
    found += pieces("hub", hub_body)
    thin = wide * d.real(0.25, 0.8)
    if d.chance(0.6):
        n = d.whole(3, 9)
        reach = 0.5 * (hub + inner)
        style = d.pick(("bar", "flat", "bent"))
        if style == "bar":
            spoke = tube([(0.8 * hub, 0, 0), (inner + 0.05, 0, 0)], 0.5 * min(thin, 0.22), sides=12)
        elif style == "flat":
            w = d.real(0.08, 0.25)
            shape = np.array([(0.85 * hub, -w), (inner + 0.05, -w * 0.6), (inner + 0.05, w * 0.6), (0.85 * hub, w)])
            spoke = extrude(shape, thin).at(z=-0.5 * thin)
        else:
            path = spline([(0.8 * hub, 0, 0), (reach, 0.15, 0), (inner + 0.05, 0, 0)], 10)
            spoke = tube(path, 0.5 * min(thin, 0.2), sides=12)
        found += pieces("spokes", *around(spoke, n))
    else:
        disc = extrude(
            outlines.circle(inner + 0.04, 40),
            thin,
            holes=_ring_of_holes(d, 0.5 * (hub + inner), 0.35 * (inner - hub)) if d.chance(0.7) else (),
        )
        found += pieces("spokes", disc.at(z=-0.5 * thin))
    if d.chance(0.25):
        tread = extrude(outlines.rectangle(0.12, d.real(0.08, 0.2)), wide * 0.95).at(x=1.0, z=-0.475 * wide)
        found += pieces("rim", *around(tread, d.whole(12, 26)))
    if d.chance(0.3):
        bolt = cylinder(0.16 * hub, 0.5 * long + 0.05, segments=6).at(x=0.72 * hub)
        found += pieces("bolts", *around(bolt, d.whole(3, 6)))
    if d.chance(0.3):
        found += pieces("axle", cylinder(bore * 1.02, d.log(0.8, 4.0), segments=24, bevel=0.02).at(z=-0.5 * long))
    return found


def outlines_closed(outline: Floats) -> Floats:
    """With its first point again at the end, as profiles to turn have it."""
    return np.concatenate([outline, outline[:1]])


def _ring_section(d: Dice, inner: float, outer: float, wide: float) -> Floats:
    h = 0.5 * wide
    if d.chance(0.3):  # a groove round the rim: a pulley
        m, deep = h * d.real(0.3, 0.8), d.real(0.3, 0.7) * (outer - inner)
        return np.array([(inner, -h), (outer, -h), (outer, -m), (outer - deep, 0), (outer, m), (outer, h), (inner, h)])
    return np.array([(inner, -h), (outer, -h), (outer, h), (inner, h)])


def _ring_of_holes(d: Dice, radius: float, size: float) -> list[Floats]:
    n = d.whole(3, 8)
    size = min(size, 0.8 * radius * float(np.sin(np.pi / n)))
    return outlines.around(outlines.circle(size, 14), radius, n)


def _vessel_side(d: Dice, height: float) -> Floats:
    """The outer side of a bowl, a cup, a vase, a bottle: (K, 2) from the foot to the lip."""
    foot = d.real(0.35, 1.0)
    kind = d.pick(("straight", "flared", "belly", "neck", "neck", "shoulder"))
    if kind == "straight":
        points = [(foot, 0), (foot * d.real(0.85, 1.3), height)]
        return np.array(points)
    if kind == "flared":
        points = [(0.5 * foot, 0), (foot * 0.8, 0.35 * height), (1.2, height)]
    elif kind == "belly":
        points = [(0.8 * foot, 0), (1.0, d.real(0.3, 0.6) * height), (d.real(0.5, 0.95), height)]
    elif kind == "neck":
        neck = d.real(0.2, 0.5)
        points = [
            (0.8 * foot, 0),
            (1, d.real(0.25, 0.45) * height),
            (neck, 0.75 * height),
            (neck * d.real(1, 1.9), height),
        ]
    else:
        neck, up = d.real(0.2, 0.5), d.real(0.55, 0.75) * height
        straight = [(1.0, 0.0), (1.0, up)]
        bend = spline([(1.0, up), (0.85, up + 0.1 * height), (neck, up + 0.2 * height), (neck, height)], 14)
        bend[:, 0] = np.minimum(bend[:, 0], 1.0)
        return profiles.without_repeats(np.concatenate([straight, bend]))
    side = spline(points, 20)
    side[:, 0] = np.maximum(side[:, 0], 0.15)
    return side


def vessel(d: Dice) -> list[Piece]:
    """Bowls, cups, vases, bottles, pots: with feet, handles, spouts, lids and bands."""
    height = d.log(0.3, 4.5)
    side = _vessel_side(d, height)
    wall = d.real(0.05, 0.14)
    segments = d.pick((40, 40, 40, 6, 8, 4))

    def radius_at(z: float) -> float:
        return float(np.interp(z, side[:, 1], side[:, 0]))

    lip = float(side[-1, 0])
    stand = 0.0
    found: list[Piece] = []
    if d.chance(0.25):  # a goblet's foot
        stand = d.real(0.2, 1.2)
        stem, foot = d.real(0.08, 0.2), d.real(0.5, 0.9)
        leg = spline([(foot, 0.06), (0.6 * foot, 0.12), (stem, 0.3 * stand + 0.1), (stem * 1.3, stand + 0.1)], 16)
        found += pieces("foot", turned_body([(0, 0), (foot, 0), *leg, (0, stand + 0.1)], 40))
    closed = lip < 0.55 and d.chance(0.5)
    if closed or segments < 40:
        body = turned_body(profiles.closed_profile(side, 0.02), segments)
    else:
        body = turned_body(profiles.cup_profile(side, wall, 1.5 * wall), segments)
    found += pieces("body", body.at(z=stand))
    top = stand + height
    if segments == 40 and height > 0.6 and d.chance(0.6):
        found += pieces("handle", *_handles(d, radius_at, height, stand))
    if d.chance(0.35) or closed:
        found += [Piece(mesh.at(z=top), "lid") for mesh in _lid(d, lip)]
    elif segments == 40 and d.chance(0.2) and lip > 0.4:
        z = stand + 0.55 * height
        start = radius_at(z - stand) - 0.05
        path = spline([(start, 0, z), (start + 0.35, 0, z + 0.1), (start + 0.55, 0, z + 0.45 * height + 0.2)], 14)
        found += pieces("spout", tube(path, np.linspace(0.2, 0.09, 14) * min(1.0, height)))
    if segments == 40 and d.chance(0.25):
        z = d.real(0.2, 0.8) * height
        found += pieces("band", ring(radius_at(z) - 0.01, d.real(0.025, 0.06), segments=40).at(z=z + stand))
    return found


def _handles(d: Dice, radius_at: object, height: float, stand: float) -> list[Mesh]:
    assert callable(radius_at)
    low, high = d.real(0.12, 0.35) * height, d.real(0.65, 0.88) * height
    start, stop = radius_at(low) - 0.04, radius_at(high) - 0.04
    thick = d.real(0.06, 0.12) * min(1.0, height)
    style = d.pick(("bow", "square", "ears"))
    out = max(start, stop) + d.real(0.3, 0.7) * min(1.0, height)
    if style == "ears":
        z = stand + high
        r = radius_at(high)
        path = spline(
            [(0.9 * r, -0.3 * r, z), (r + 0.3, -0.2 * r, z), (r + 0.3, 0.2 * r, z), (0.9 * r, 0.3 * r, z)], 16
        )
        return both(tube(path, min(thick, 0.08)))
    a, b = stand + low, stand + high
    if style == "bow":
        path = spline([(start, 0, a), (0.9 * out, 0, a), (out, 0, 0.5 * (a + b)), (0.9 * out, 0, b), (stop, 0, b)], 22)
    else:
        path = np.array([(start, 0, a), (out, 0, a), (out, 0, b), (stop, 0, b)])
    one = tube(path, thick)
    return both(one) if d.chance(0.3) else [one]


def _lid(d: Dice, lip: float) -> list[Mesh]:
    """A cap, a cork or a domed lid over an opening at z = 0."""
    kind = d.pick(("cap", "dome", "cork"))
    if kind == "cap" or lip < 0.3:
        r, h = lip * d.real(1.02, 1.25), d.real(0.15, 0.6) * max(lip, 0.3)
        count = d.whole(14, 22)
        shape = outlines.circle(r, 36) if d.chance(0.6) else outlines.gear(count, r * 1.05, 0.07 * r, 0.35, 0.12)
        return [extrude(shape, h, bevel=0.04 * r).at(z=-0.12 * h)]
    if kind == "cork":
        return [cylinder(lip * 0.9, 0.7 * lip, top=1.15, bevel=0.03).at(z=-0.3 * lip)]
    high = d.real(0.15, 0.5) * lip
    dome = spline([(lip * 1.05, 0.04), (0.65 * lip, 0.65 * high), (0.0, high)], 14)
    knob = d.real(0.1, 0.2) * lip + 0.02
    lid = turned_body([(0, -0.04), (lip * 1.05, -0.04), *dome[:-1], (0, high)], 40)
    top = (
        ball(knob).at(z=high + 0.6 * knob) if d.chance(0.7) else soft_box((4 * knob, knob, knob), 0.3).at(z=high - 0.02)
    )
    return [lid, top]


def knob(d: Dice) -> list[Piece]:
    """A handle to turn: a lobed, knurled or round grip on a collar and a shaft."""
    high, n = d.log(0.3, 1.2), d.whole(3, 9)
    shape = d.pick(
        (
            outlines.petals(n, 1, d.real(0.12, 0.35), 84),
            outlines.gear(d.whole(16, 30), 1, d.real(0.04, 0.1)),
            outlines.circle(1, 40),
            outlines.rounded(outlines.circle(1, d.whole(3, 6)), 0.3, 6),
        )
    )
    grip = extrude(shape, high, bevel=d.real(0.04, 0.12), bevel_steps=3, top=d.real(0.75, 1.0))
    found = pieces("grip", grip)
    collar = d.real(0.45, 0.9)
    found += pieces("collar", cylinder(collar, d.real(0.1, 0.35), bevel=0.02).at(z=-0.08))
    if d.chance(0.7):
        long, thin = d.log(0.3, 2.5), d.real(0.12, 0.35)
        found += pieces("shaft", cylinder(thin, long + 0.1, segments=d.pick((24, 24, 6)), bevel=0.02).at(z=-long))
    if d.chance(0.5):
        top = cylinder(collar * 0.7, 0.05, bevel=0.015).at(z=high - 0.005)
        found += pieces("trim", top)
        if d.chance(0.6):
            found += pieces("mark", soft_box((0.08, 0.5 * collar, 0.05), 0.2).at(y=0.35 * collar, z=high + 0.03))
    return found


def stack(d: Dice) -> list[Piece]:
    """Bodies of revolution on top of each other, each as wide as it likes: towers, finials, chess men, lanterns."""
    found: list[Piece] = []
    z, r = 0.0, d.real(0.7, 1.0)
    flat = d.pick((36, 36, 36, 4, 6, 8))
    for level in range(d.whole(2, 5)):
        role = ("base", "body", "trim", "body", "trim")[level]
        high = d.log(0.15, 1.5) * r
        kind = d.pick(("cylinder", "cone", "side", "ball", "disc", "torus"))
        if kind == "ball":
            found += pieces(role, ball((r, r, 0.5 * high + 0.2 * r)).at(z=z + 0.5 * high + 0.1 * r))
            z += high + 0.2 * r - 0.15 * r
        elif kind == "torus":
            thick = 0.3 * r
            found += pieces(
                role,
                ring(r - thick, thick).at(z=z + 0.6 * thick),
                cylinder(r - thick, 1.6 * thick + 0.02).at(z=z - 0.02),
            )
            z += 1.55 * thick
        elif kind == "side":
            side = profiles.turned_side(d, high, r)
            found += pieces(role, turned_body(profiles.closed_profile(side, 0.02), flat).at(z=z))
            z += high
        else:
            high = 0.2 * high if kind == "disc" else high
            top = d.real(0.4, 0.95) if kind == "cone" else 1.0
            found += pieces(role, cylinder(r, high, top=top, bevel=0.03 * r, segments=flat).at(z=z))
            z, r = z + high, r * top
        z -= 0.01 * r
        r *= d.real(0.55, 1.1)
    return found


def canopy(d: Dice) -> list[Piece]:
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
