"""The series: which kind a number is, its pieces put together, coloured, checked."""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import numpy as np

from dope.common import seeds
from pipeline.render.procedural import assembly, buildings, devices, furniture, plates, soft, tools, turned, wires
from pipeline.render.procedural.pieces import Dice, Piece
from pipeline.render.scene import Model, Part
from pipeline.solids.mesh import Mesh, area_vectors, merged, outward, shaded, subdivided

FACES = (200, 6000)
"""Fewest and most faces of an object."""

COLOURED = 0.3
"""Share of the objects that have colours of their own; the others are without a look, for the renderer to give one."""

Kind = Callable[[Dice], list[Piece]]

KINDS: dict[str, tuple[Kind, float]] = {
    "spindle": (turned.spindle, 1.5),
    "fluted": (turned.fluted, 0.7),
    "wheel": (turned.wheel, 1),
    "vessel": (turned.vessel, 2),
    "knob": (turned.knob, 0.7),
    "stack": (turned.stack, 1),
    "plate": (plates.plate, 2.4),
    "bar": (plates.bar, 1.4),
    "prism": (plates.prism, 1.2),
    "gear shaft": (plates.gear_shaft, 1),
    "bracket": (plates.bracket, 1),
    "fastener": (plates.fastener, 0.8),
    "mounted": (plates.mounted, 1.2),
    "spring": (wires.spring, 0.5),
    "bent": (wires.bent, 1),
    "loop": (wires.loop, 1),
    "piping": (wires.piping, 1),
    "cage": (wires.cage, 1),
    "star": (wires.bars_star, 0.8),
    "superquadric": (soft.superquad, 0.8),
    "toroid": (soft.toroid, 0.5),
    "hull": (soft.hull, 1),
    "soft group": (soft.soft_group, 1),
    "table": (furniture.table, 1),
    "seat": (furniture.seat, 1),
    "shelf": (furniture.shelf, 1),
    "crate": (furniture.crate, 1),
    "bed": (furniture.bed, 0.4),
    "lamp": (furniture.lamp, 0.8),
    "hand tool": (tools.hand_tool, 2),
    "flat tool": (tools.spanner, 1),
    "weights": (tools.weights, 0.6),
    "device": (devices.device, 1.2),
    "vehicle": (devices.vehicle, 0.8),
    "canopy": (turned.canopy, 0.8),
    "column": (buildings.column, 0.6),
    "arch": (buildings.arch, 0.7),
    "stairs": (buildings.stairs, 0.7),
    "house": (buildings.house, 0.8),
    "fence": (buildings.fence, 0.6),
    "tiers": (buildings.tiers, 0.8),
    "blocks": (buildings.blocks, 0.8),
    "assembly": (assembly.assembly, 5),
}
"""Kinds and how often each comes, relatively."""


def procedural_object(number: int, seed: int) -> Model:
    """Object `number` of the series `seed`: closed parts, upright on z, in the frame of a `Scene`.

    The middle of the bounding box is the origin, the largest absolute coordinate 0.5. Parts are closed surfaces that
    touch or reach into each other. Objects without colours are one part; others have a part for each colour.
    """
    for attempt in range(50):
        dice = Dice(seeds.generator("procedural", seed, number, attempt))
        model = _model(dice, _kind(dice)(dice))
        if model is not None:
            return model
    raise AssertionError(f"object {number} of series {seed} has not come out right in 50 attempts")


def _kind(d: Dice) -> Kind:
    kinds, weights = zip(*KINDS.values(), strict=True)
    ends = np.cumsum(weights)
    chosen: Kind = kinds[int(np.searchsorted(ends, d.rng.random() * ends[-1], side="right"))]
    return chosen


def _model(d: Dice, found: list[Piece]) -> Model | None:
    """The object, or None where it has too many faces or a face without area."""
    count = sum(len(piece.mesh.faces) for piece in found)
    if count > FACES[1]:
        return None
    meshes = [piece.mesh for piece in found]
    if d.chance(0.4):  # proportions no recipe thought of
        stretch = np.exp(d.rng.normal(0, 0.3, 3))
        meshes = [mesh.scaled(stretch) for mesh in meshes]
    meshes = [outward(mesh) for mesh in meshes]
    while count < FACES[0]:
        meshes, count = [subdivided(mesh) for mesh in meshes], 4 * count
    points = np.concatenate([mesh.vertices for mesh in meshes])
    if not np.isfinite(points).all():
        return None
    low, high = points.min(0), points.max(0)
    scale = 1 / float((high - low).max())
    meshes = [mesh.at(*(-0.5 * (low + high))).scaled(scale) for mesh in meshes]
    if min(float((area_vectors(mesh) ** 2).sum(1).min()) for mesh in meshes) < 1e-18:
        return None
    roles = [piece.role for piece in found]
    names = list(dict.fromkeys(roles))
    if d.chance(COLOURED) and len(names) > 1:
        colours = _palette(d, len(names))
        groups = [merged([m for m, role in zip(meshes, roles, strict=True) if role == name]) for name in names]
        return Model(tuple(_part(mesh, colour) for mesh, colour in zip(groups, colours, strict=True)))
    return Model((_part(merged(meshes), None),))


def _part(mesh: Mesh, colour: tuple[float, float, float] | None) -> Part:
    vertices, faces, normals = shaded(mesh)
    return Part(vertices, faces, normals, colour=colour)


def _palette(d: Dice, count: int) -> list[tuple[float, float, float]]:
    """Colours that go together: two or three hues, some greys, light and dark."""
    hues = [d.real(0, 1)]
    hues += [(hues[0] + d.pick((0.5, 0.33, 0.08, 0.0))) % 1, (hues[0] - d.pick((0.4, 0.12, 0.25))) % 1]
    greys = d.real(0.1, 0.6)
    colours = []
    for k in range(count):
        saturation = d.real(0.0, 0.12) if d.chance(greys) else d.real(0.35, 0.9)
        colours.append(colorsys.hsv_to_rgb(hues[k % 3], saturation, d.real(0.25, 0.95)))
    return colours
