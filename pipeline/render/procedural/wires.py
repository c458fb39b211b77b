"""Objects of bent bars and tubes: springs, hooks, rings, frames, pipes with flanges, cages, baskets."""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Floats
from pipeline.render.procedural.pieces import Dice, Piece, around, both, pieces
from pipeline.solids import outlines
from pipeline.solids.bodies import along, ball, block, cylinder, extrude, pipe, ring, tube
from pipeline.solids.grids import spline


def _section(d: Dice, size: float) -> Floats:
    kind = d.pick(("round", "round", "round", "square", "flat", "hex"))
    if kind == "round":
        return outlines.circle(size, 14)
    if kind == "square":
        return outlines.rounded(outlines.rectangle(2 * size, 2 * size), 0.3 * size, 2)
    if kind == "flat":
        return outlines.rounded(outlines.rectangle(0.9 * size, 3 * size), 0.2 * size, 2)
    return outlines.circle(size, 6)


def spring(d: Dice) -> list[Piece]:
    """Helices: springs, coils, corkscrews; conical ones, with closed ends or hooks."""
    turns, thick = d.real(2.5, 9), d.real(0.05, 0.16)
    high = max(turns * thick * d.real(2.1, 6), 0.4)
    count = int(turns * 17)
    t = np.linspace(0, 1, count)
    angle = 2 * np.pi * turns * t
    r = 1 + d.pick((0.0, 0.0, d.real(-0.7, 0.7))) * (t - 0.5)
    z = high * t
    path = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    sides = outlines.circle(thick, 8) if d.chance(0.7) else outlines.rectangle(1.6 * thick, 1.6 * thick)
    found = pieces("body", along(path, sides, up=(0, 0, 1)))
    if d.chance(0.3):
        found += pieces("ends", cylinder(float(r[0]) + 1.5 * thick, 0.15, bevel=0.02).at(z=-0.13))
        found += pieces("ends", cylinder(float(r[-1]) + 1.5 * thick, 0.15, bevel=0.02).at(z=high - 0.02))
    elif d.chance(0.3):
        core = min(float(r.min()) - 0.9 * thick, 0.9)
        found += pieces("ends", cylinder(core + 0.3 * thick if core > 0.3 else 1.0, high, segments=24))
    return found


def bent(d: Dice) -> list[Piece]:
    """A bar bent as hooks, handles, clamps, U bolts, S hooks, cranks, paper clips, walking sticks are."""
    thick = d.log(0.025, 0.17)
    kind = d.pick(("hook", "s", "u", "crank", "free", "handle", "question"))
    arc = np.linspace(0, np.pi, 14)
    if kind == "hook":
        r, long = 0.5, d.log(0.8, 3)
        path = np.concatenate(
            [[(r, 0, long)], [(r * np.cos(a), 0, -r * np.sin(a)) for a in arc], [(-r, 0, d.real(0.05, 0.6))]]
        )
    elif kind == "s":
        r = d.real(0.4, 0.7)
        up = np.array([(r * np.sin(a) * 1.0, 0, r * np.cos(a) + r) for a in np.linspace(-1.9, np.pi, 18)])
        down = np.array([(-r * np.sin(a), 0, -r * np.cos(a) - r) for a in np.linspace(np.pi, -1.9, 18)])
        path = np.concatenate([up, down[1:]])
    elif kind == "u":
        long, r = d.log(0.4, 2.5), 0.6
        path = np.concatenate([[(r, 0, -long)], [(r * np.cos(a), 0, r * np.sin(a)) for a in arc], [(-r, 0, -long)]])
    elif kind == "crank":
        a, b, c = d.log(0.4, 1.5), d.log(0.4, 1.2), d.log(0.4, 1.5)
        sharp = np.array([(0, 0, 0), (a, 0, 0), (a, 0, b), (a + c, 0, b), (a + c, d.pick((0.0, b)) + 1e-3, b)])
        path = _soft(sharp, 0.25)
    elif kind == "handle":
        w, h = d.real(0.7, 1.5), d.real(0.3, 0.8)
        path = _soft(
            np.array([(-w, 0, 0), (-w * d.real(0.8, 1), 0, h), (w * d.real(0.8, 1), 0, h), (w, 0, 0)]), d.real(0.1, 0.4)
        )
    elif kind == "question":
        r = 0.6
        bow = [(r * np.cos(a), 0, r * np.sin(a)) for a in np.linspace(np.pi * 0.95, -0.6, 16)]
        path = np.concatenate([bow, [(0.1, 0, -r * 1.1), (0, 0, -r * 1.5), (0, 0, -r * d.real(2, 4))]])
    else:
        path = spline(np.cumsum(d.rng.uniform((-0.3, -1, -1), (1.7, 1, 1), (d.whole(3, 5), 3)), axis=0), 40)
    found = pieces("body", along(path, _section(d, thick), up=(0, 1, 0)))
    if kind == "handle":
        foot = cylinder(2.2 * thick, 0.08, bevel=0.02).at(z=-0.03)
        found += pieces("feet", foot.at(x=float(path[0, 0])), foot.at(x=float(path[-1, 0])))
    elif d.chance(0.4):
        for end in (path[0], path[-1]):
            found += pieces("ends", ball(thick * d.real(1.3, 1.9), count=12).at(*end))
            if d.chance(0.5):
                break
    return found


def _soft(path: Floats, radius: float, steps: int = 5) -> Floats:
    """A polyline with its inner corners rounded by quadratic curves."""
    found = [path[:1]]
    for before, corner, after in zip(path, path[1:], path[2:], strict=False):
        a, b = before - corner, after - corner
        la, lb = np.linalg.norm(a), np.linalg.norm(b)
        cut = min(radius, 0.45 * la, 0.45 * lb)
        start, stop = corner + a / la * cut, corner + b / lb * cut
        t = np.linspace(0, 1, steps)[:, None]
        found.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * stop)
    return np.concatenate([*found, path[-1:]])


def loop(d: Dice) -> list[Piece]:
    """Closed bars: rings, frames, links, buckles, chains of links, knots."""
    kind = d.pick(("ring", "frame", "frame", "chain", "knot", "wavy"))
    thick = d.log(0.025, 0.28)
    if kind == "chain":
        n, thin = d.whole(2, 6), d.real(0.12, 0.2)
        shape = np.concatenate([outlines.slot(2, 1.2, 9), np.zeros((20, 1))], axis=1)
        link = along(shape, outlines.circle(thin, 10), closed=True)
        step = 2 - 2 * thin * 0.98
        return [Piece(link.turned(0, 90 * (k % 2)).at(x=k * step), "link" if k % 2 else "body") for k in range(n)]
    if kind == "knot":
        p, q = d.pick(((2, 3), (3, 2), (2, 5), (3, 4)))
        t = np.arange(110) * (2 * np.pi / 110)
        r = 1 + 0.42 * np.cos(q * t)
        path = np.stack([r * np.cos(p * t), r * np.sin(p * t), 0.42 * np.sin(q * t)], axis=1)
        return pieces("body", tube(path, d.real(0.1, 0.18), closed=True, sides=12))
    shape = outlines.circle(1, 48)
    if kind == "frame":
        w, h = 1.0, d.log(0.4, 1)
        shape = outlines.rectangle(2 * w, 2 * h) if d.chance(0.7) else outlines.circle(1, d.whole(3, 8))
        if d.chance(0.5):
            shape = outlines.rounded(shape, d.real(0.1, 0.5) * h, 6)
    path = np.concatenate([shape, np.zeros((len(shape), 1))], axis=1)
    if kind == "wavy":
        n = d.whole(3, 9)
        path[:, 2] = d.real(0.1, 0.3) * np.cos(n * np.arctan2(path[:, 1], path[:, 0]))
    section = _section(d, thick)
    if kind == "frame" and d.chance(0.5):  # a picture frame's moulding
        m, up = d.real(0.1, 0.3), d.real(0.06, 0.2)
        section = np.array([(-m, -up), (m, -up), (m, 0.4 * up), (0.4 * m, up), (0, 0.5 * up), (-m, 0.7 * up)])
    found = pieces("body", along(path, section, closed=True, up=(0, 0, 1)))
    if kind == "frame" and d.chance(0.5) and len(shape) == 4:
        found += pieces("panel", block((2 * w_of(shape), 2 * h_of(shape), 0.5 * thick)).at(z=-0.3 * thick))
    elif kind == "ring" and d.chance(0.5):
        found += pieces("stone", ball((0.3, 0.3, 0.2 + thick), count=12).turned(1, 90).at(x=1.0 + 0.5 * thick))
    return found


def w_of(shape: Floats) -> float:
    """Half the width of an outline about the origin."""
    return float(np.abs(shape[:, 0]).max())


def h_of(shape: Floats) -> float:
    """Half the height of an outline about the origin."""
    return float(np.abs(shape[:, 1]).max())


def piping(d: Dice) -> list[Piece]:
    """Pipes: elbows, tees, crosses and runs, with flanges or nuts at their ends; valves with a hand wheel."""
    r = d.real(0.2, 0.35)
    kind = d.pick(("elbow", "tee", "cross", "run", "valve"))
    found: list[Piece] = []
    ends: list[tuple[Floats, int, float]] = []  # where, axis, direction
    if kind in ("elbow", "run"):
        a, b = d.log(0.6, 1.8), d.log(0.6, 1.8)
        points = [(-a, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, b)]
        if kind == "run":
            c = d.log(0.8, 1.8)
            points += [(0.0, c, b)] if d.chance(0.5) else [(c, 0.0, b)]
        path = _soft(np.array(points), 2 * r, 8)
        found += pieces("body", tube(path, r, sides=24))
        ends = [(path[0], 0, -1.0), (path[-1], 2 if kind == "elbow" else (1 if points[-1][1] else 0), 1.0)]
    else:
        long, side = d.log(0.7, 1.6), d.log(0.6, 1.2)
        run = cylinder(r, 2 * long, segments=28).at(z=-long).turned(1, 90)
        found += pieces("body", run)
        ends = [(np.array([s * long, 0, 0]), 0, s) for s in (-1.0, 1.0)]
        if kind == "valve":
            found += pieces("body", ball((1.5 * r, 1.3 * r, 1.3 * r)), cylinder(0.6 * r, side + r, segments=20))
            found += pieces("collar", cylinder(r, 0.3, segments=6).at(z=0.9 * r))
            wheel = d.real(0.4, 0.8)
            found += pieces("wheel", ring(wheel, 0.06, sides=12).at(z=side + r))
            spoke = tube([(0, 0, side + r), (wheel, 0, side + r)], 0.045, sides=12)
            found += pieces("wheel", *around(spoke, d.whole(3, 5)), cylinder(0.15, 0.15).at(z=side + r - 0.075))
        else:
            up = cylinder(r, side, segments=28)
            found += pieces("body", up)
            ends.append((np.array([0, 0, side]), 2, 1.0))
            if kind == "cross":
                found += pieces("body", up.turned(0, 180))
                ends.append((np.array([0, 0, -side]), 2, -1.0))
    flange = d.pick(("flange", "flange", "nut", "collar", "none"))
    for where, axis, sign in ends:
        if flange == "none":
            continue
        if flange == "flange":
            holes = outlines.around(outlines.circle(0.13 * r, 8), 1.5 * r, 6)
            mesh = extrude(outlines.circle(1.85 * r, 32), 0.35 * r, holes=[outlines.circle(0.8 * r, 24), *holes])
        elif flange == "nut":
            mesh = cylinder(1.5 * r, 0.8 * r, segments=6, bevel=0.08 * r)
        else:
            mesh = pipe(1.25 * r, 0.85 * r, 0.6 * r)
        mesh = mesh.at(z=-0.25 * r)
        if sign < 0:
            mesh = mesh.turned(0, 180)
        mesh = mesh if axis == 2 else mesh.turned(1, 90) if axis == 0 else mesh.turned(0, -90)
        found += pieces("ends", mesh.at(*where))
    return found


def cage(d: Dice) -> list[Piece]:
    """Bars between rings or rails: baskets, lanterns, grilles, railings, ladders, racks."""
    thin = d.real(0.025, 0.06)
    if d.chance(0.5):
        n, levels, high = d.whole(6, 16), d.whole(2, 4), d.log(0.6, 2.5)
        flare = d.real(0.6, 1.4)
        radii = np.linspace(1, flare, levels)
        found = [
            Piece(ring(float(r), 1.6 * thin, segments=32, sides=10).at(z=z), "rings")
            for r, z in zip(radii, np.linspace(0, high, levels), strict=True)
        ]
        post = tube([(1, 0, 0), (flare, 0, high)], thin, sides=8)
        found += pieces("bars", *around(post, n))
        if d.chance(0.5):
            found += pieces("base", cylinder(1 + thin, 0.08).at(z=-0.08))
        if d.chance(0.4):
            if d.chance(0.5):
                found += pieces("base", cylinder(flare + thin, d.real(0.2, 0.8), top=0.15).at(z=high - 0.01))
            else:
                bow = [(flare * np.cos(a), 0, high + 0.8 * flare * np.sin(a)) for a in np.linspace(0, np.pi, 16)]
                found += pieces("handle", tube(bow, 1.5 * thin, sides=10))
        return found
    w, h, n = 1.0, d.log(0.4, 3.0), d.whole(3, 14)
    thick = 1.8 * thin
    round_bars = d.chance(0.5)
    post = tube([(0, 0, 0), (0, 0, 2 * h)], thick, sides=12) if round_bars else block((2 * thick, 2 * thick, 2 * h))
    found = pieces("rails", *both(post.at(x=w)))
    rung = (
        tube([(-w, 0, 0), (w, 0, 0)], thin, sides=10)
        if round_bars
        else block((2 * w, 1.5 * thin, 3 * thin)).at(z=-1.5 * thin)
    )
    found += [Piece(rung.at(z=z), "bars") for z in np.linspace(0.12 * h, 1.88 * h, n)]
    if d.chance(0.4):  # a rack: the same again behind it
        deep = d.real(0.4, 1.2)
        found = [Piece(p.mesh.at(y=y), p.role) for p in found for y in (-0.5 * deep, 0.5 * deep)]
        tie = block((2 * thick, deep, 2 * thick))
        found += pieces("rails", *both(tie.at(x=w, z=1.6 * h)), *both(tie.at(x=w, z=0.2 * h)))
        if d.chance(0.5):
            shelf = block((2 * w, deep, thin))
            found += [Piece(shelf.at(z=z), "shelves") for z in np.linspace(0.12 * h, 1.88 * h, min(n, 4))]
    elif d.chance(0.4):
        found += pieces("feet", *both(block((0.3, 0.7, 0.08)).at(x=w, z=-0.06)))
    return found


def bars_star(d: Dice) -> list[Piece]:
    """Bars out of a hub: jacks, molecules, propellers, fans, windmills, caltrops."""
    n = d.whole(2, 8)
    hub = d.real(0.15, 0.35)
    kind = d.pick(("propeller", "fan", "jack", "spokes"))
    if kind == "jack":
        bar = tube([(0, 0, -1), (0, 0, 1)], d.real(0.08, 0.16), sides=14)
        end = [ball(d.real(0.17, 0.3)).at(z=s) for s in (-1, 1)] if d.chance(0.7) else []
        parts = [bar, *end]
        found = [Piece(m, "ends" if k else "bars") for k, m in enumerate(parts)]
        found += [Piece(p.mesh.turned(axis, 90), p.role) for p in found[:3] for axis in (0, 1)]
        return [*found, Piece(ball(1.5 * hub * 0.7), "hub")]
    found = pieces("hub", cylinder(hub, d.real(0.25, 0.6), bevel=0.05, top=d.real(0.6, 1)).at(z=-0.15))
    if kind == "spokes":
        arm = tube([(0, 0, 0), (1, 0, d.real(-0.4, 0.4))], np.array([0.1, d.real(0.04, 0.1)]), sides=12)
        found += pieces("bars", *around(arm, n))
        tip = ball(d.real(0.1, 0.22), count=12).at(*arm.vertices[14:].mean(0))
        found += pieces("ends", *around(tip, n)) if d.chance(0.6) else []
        return found
    root, tip_w = d.real(0.08, 0.2), d.real(0.12, 0.4)
    blade = extrude(
        outlines.rounded(np.array([(-root, 0), (root, 0), (tip_w, 1.0), (-0.6 * tip_w, 0.95)]), 0.2, 5),
        0.05,
        bevel=0.012,
    )
    blade = blade.at(z=-0.025).turned(1, d.real(15, 45)).at(y=0.6 * hub)
    found += pieces("bars", *around(blade, max(n, 2)))
    if kind == "fan":
        r = 1.0 + 0.6 * hub + 0.05
        found += pieces("frame", ring(r, 0.06, segments=44, sides=10))
        spoke = tube([(0, 0, -0.12), (r, 0, 0)], 0.03, sides=8)
        found += pieces("frame", *around(spoke, d.whole(3, 8)))
        if d.chance(0.6):
            stand = d.real(0.5, 1.5)
            found = [Piece(p.mesh.turned(0, 90).at(z=r + stand), p.role) for p in found]
            found += pieces(
                "frame", cylinder(0.07, stand + 0.05), cylinder(d.real(0.5, 0.8), 0.1, bevel=0.03).at(z=-0.05)
            )
    return found
