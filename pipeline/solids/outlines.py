"""Closed outlines in the plane: (N, 2), counter-clockwise, the last point not the first."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pipeline.geometry import Floats
from pipeline.solids.grids import spline


def circle(radius: float, count: int = 32, centre: ArrayLike = (0, 0)) -> Floats:
    """A circle, or with a small count a regular polygon with a corner at angle 0."""
    angle = np.arange(count) * (2 * np.pi / count)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1) + np.asarray(centre, dtype=float)


def rectangle(width: float, height: float, centre: ArrayLike = (0, 0)) -> Floats:
    """Centred, sides along the axes."""
    return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, height / 2) + np.asarray(centre, dtype=float)


def slot(length: float, width: float, count: int = 8, centre: ArrayLike = (0, 0)) -> Floats:
    """A stadium along x, `length` long in all, with `count` steps round each end."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, count + 1)
    end = 0.5 * width * np.stack([np.cos(angle), np.sin(angle)], axis=1) + (
        max(0.5 * (length - width), 1e-3 * width),
        0,
    )
    return np.concatenate([end, -end]) + np.asarray(centre, dtype=float)


def star(points: int, radius: float, inner: float) -> Floats:
    """A star polygon."""
    outline = circle(1.0, 2 * points)
    outline[::2] *= radius
    outline[1::2] *= inner
    return outline


def gear(teeth: int, radius: float, depth: float, top: float = 0.3, slope: float = 0.15) -> Floats:
    """A gear of outer `radius`: of each tooth's share of the round, `top` is its flat top and `slope` each flank."""
    steps = np.array([0, slope, slope + top, 2 * slope + top])
    angle = ((np.arange(teeth)[:, None] + steps) * (2 * np.pi / teeth)).ravel()
    r = np.tile([radius - depth, radius, radius, radius - depth], teeth)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)


def petals(count: int, radius: float, depth: float, steps: int = 96) -> Floats:
    """A circle whose radius swings `count` times between radius and radius - depth."""
    angle = np.arange(steps) * (2 * np.pi / steps)
    r = radius - 0.5 * depth * (1 - np.cos(count * angle))
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)


def superellipse(width: float, height: float, power: float, count: int = 48) -> Floats:
    """|2x/width|^p + |2y/height|^p = 1."""
    angle = np.arange(count) * (2 * np.pi / count)
    c, s = np.cos(angle), np.sin(angle)
    round_ = (np.abs(c) ** power + np.abs(s) ** power) ** (-1 / power)
    return np.stack([0.5 * width * c * round_, 0.5 * height * s * round_], axis=1)


def sector(inner: float, outer: float, degrees: float, steps: int = 24) -> Floats:
    """A piece of a ring, its middle at angle 0; with inner 0 a slice."""
    angle = np.radians(np.linspace(-degrees / 2, degrees / 2, steps + 1))
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([outer * arc, inner * arc[::-1] if inner > 0 else np.zeros((1, 2))])


def mirrored(half: ArrayLike, count: int = 40) -> Floats:
    """An outline symmetric about the y axis: a smooth curve through points (K, 2) of its right side, upwards."""
    side = spline(half, count)
    side[:, 0] = np.maximum(side[:, 0], 1e-3)
    return np.concatenate([side, (side * (-1, 1))[::-1]])


def profile(kind: str, width: float, height: float, wall: float) -> Floats:
    """The section of a rolled bar: "L", "U", "T", "I", "Z", "H", "+", with walls of one thickness; centred."""
    w, h, t = width, height, wall
    m, n = 0.5 * (w - t), 0.5 * (w + t)
    if kind == "L":
        points = [(0, 0), (w, 0), (w, t), (t, t), (t, h), (0, h)]
    elif kind == "U":
        points = [(0, 0), (w, 0), (w, h), (w - t, h), (w - t, t), (t, t), (t, h), (0, h)]
    elif kind == "T":
        points = [(m, 0), (n, 0), (n, h - t), (w, h - t), (w, h), (0, h), (0, h - t), (m, h - t)]
    elif kind in ("I", "H"):
        points = [
            (0, 0),
            (w, 0),
            (w, t),
            (n, t),
            (n, h - t),
            (w, h - t),
            (w, h),
            (0, h),
            (0, h - t),
            (m, h - t),
            (m, t),
            (0, t),
        ]
        if kind == "H":
            points = [(0, 0), (t, 0), (t, (h - t) / 2), (w - t, (h - t) / 2), (w - t, 0), (w, 0), (w, h), (w - t, h)]
            points += [(w - t, (h + t) / 2), (t, (h + t) / 2), (t, h), (0, h)]
    elif kind == "Z":
        points = [(0, 0), (n, 0), (n, h - t), (w, h - t), (w, h), (m, h), (m, t), (0, t)]
    else:
        p, q = 0.5 * (h - t), 0.5 * (h + t)
        points = [(m, 0), (n, 0), (n, p), (w, p), (w, q), (n, q), (n, h), (m, h), (m, q), (0, q), (0, p), (m, p)]
    return np.array(points, dtype=float) - (0.5 * w, 0.5 * h)


def rounded(outline: ArrayLike, radius: ArrayLike, steps: int = 4) -> Floats:
    """Corners cut off by arcs of at most `radius` (one, or one each), or straight where `steps` is 1.

    An arc takes up to 0.45 of each of its corner's sides, so that neighbours do not meet.
    """
    p = np.asarray(outline, dtype=float)
    before, after = np.roll(p, 1, 0) - p, np.roll(p, -1, 0) - p
    length = np.minimum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1))
    before /= np.linalg.norm(before, axis=1, keepdims=True)
    after /= np.linalg.norm(after, axis=1, keepdims=True)
    half = 0.5 * np.arccos(np.clip((before * after).sum(1), -1, 1))
    cut = np.minimum(np.broadcast_to(np.asarray(radius, dtype=float), len(p)) / np.tan(half), 0.45 * length)
    found: list[Floats] = []
    for corner, b, a, angle, c in zip(p, before, after, half, cut, strict=True):
        if c < 1e-6 or angle > 1.5:
            found.append(corner[None])
            continue
        r = c * np.tan(angle)
        centre = corner + (a + b) / np.linalg.norm(a + b) * r / np.sin(angle)
        start, stop = corner + c * b - centre, corner + c * a - centre
        sweep = np.pi - 2 * angle
        t = np.linspace(0, 1, steps + 1)[:, None]
        arc = (np.sin((1 - t) * sweep) * start + np.sin(t * sweep) * stop) / np.sin(sweep)
        found.append(centre + arc)
    return np.concatenate(found)


def inset(outline: Floats, distance: float) -> Floats:
    """Every side moved inwards (to the left of its direction) by a distance; corners are mitred.

    The distance is halved until no side turns round; the outline itself if four halvings do not help.
    """
    ahead = np.roll(outline, -1, 0) - outline
    sides = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    left = np.stack([-sides[:, 1], sides[:, 0]], axis=1)
    both = left + np.roll(left, 1, 0)
    mitre = 2 * both / np.maximum((both**2).sum(1, keepdims=True), 0.3)
    for _ in range(5):
        moved = outline + distance * mitre
        if (((np.roll(moved, -1, 0) - moved) * sides).sum(1) > 0.1 * np.linalg.norm(ahead, axis=1)).all():
            return moved
        distance /= 2
    return outline


def finer(outline: Floats, longest: float) -> Floats:
    """The same outline, its sides cut into equal pieces no longer than `longest`."""
    ahead = np.roll(outline, -1, 0) - outline
    pieces = np.ceil(np.linalg.norm(ahead, axis=1) / longest).astype(int)
    return np.concatenate([p + a * np.arange(n)[:, None] / n for p, a, n in zip(outline, ahead, pieces, strict=True)])


def shifted(outline: Floats, x: float, y: float) -> Floats:
    """Moved in the plane."""
    return outline + np.array([x, y])


def around(outline: Floats, radius: float, count: int, start_deg: float = 0.0) -> list[Floats]:
    """Copies at even angles about the origin, their own origins at a radius."""
    out = shifted(outline, radius, 0)
    return [turned(out, start_deg + 360 * k / count) for k in range(count)]


def turned(outline: Floats, degrees: float) -> Floats:
    """Turned counter-clockwise about the origin."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return outline @ np.array([[c, s], [-s, c]])
