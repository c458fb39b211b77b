"""What is rendered: an object in its pose, how it looks, what it stands on, the light, the cameras; and what comes out.

The world of a scene is the object's: z up, the middle of its bounding box at the origin, largest absolute coordinate
0.5. Every renderer takes a `Scene` and gives a `Picture` for each shot; nothing else passes between recipe and
renderer. Colours are sRGB in [0, 1] unless said otherwise; panoramas are linear.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Camera, Floats


@dataclass(frozen=True)
class Part:
    """Triangles of one material.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) int64, counter-clockwise from outside where the mesh has an outside.
        normals: (V, 3) unit, or None: flat shading by the faces' own.
        uv: (V, 2), (0, 0) the texture's bottom-left corner, or None.
        colours: (V, 3) sRGB in [0, 1], mixed as linear light between vertices, or None.
        texture: (H, W, 3) uint8 sRGB, first row at the top; wraps around. None without one.
        colour: (3,) sRGB in [0, 1], multiplies texture and vertex colours; None where the file gives no material.
    """

    vertices: Floats
    faces: NDArray[np.int64]
    normals: Floats | None = None
    uv: Floats | None = None
    colours: Floats | None = None
    texture: NDArray[np.uint8] | None = None
    colour: tuple[float, float, float] | None = None

    @property
    def has_look(self) -> bool:
        """Whether the file says how it looks."""
        return self.texture is not None or self.colours is not None or self.colour is not None


@dataclass(frozen=True)
class Model:
    """An object: one or more parts in one frame."""

    parts: tuple[Part, ...]

    @property
    def n_faces(self) -> int:
        return sum(len(part.faces) for part in self.parts)

    @property
    def has_look(self) -> bool:
        return any(part.has_look for part in self.parts)

    def vertices(self) -> Floats:
        """(V, 3) of all parts."""
        return np.concatenate([part.vertices for part in self.parts])


@dataclass(frozen=True)
class Surface:
    """How the object looks.

    Attributes:
        kind: "own": by its textures and colours, grey where it has none; "colour": `colours[0]` all over; "voronoi":
            solid cells in space, each of one of `colours`.
        colours: (K, 3) sRGB.
        cells: Voronoi cells a unit of length.
        roughness: 0 = mirror, 1 = matt.
        seed: of the cells.
    """

    kind: Literal["own", "colour", "voronoi"] = "own"
    colours: tuple[tuple[float, float, float], ...] = ((0.6, 0.6, 0.6),)
    cells: float = 8.0
    roughness: float = 0.6
    seed: int = 0


@dataclass(frozen=True)
class Ground:
    """The plane z = `height` that the object stands on.

    Attributes:
        height: of the plane.
        albedo: (S, S, 3) uint8 sRGB, wraps around without a seam.
        bumps: (S, S) float32 heights in units of length, the same wrapping, or None.
        roughness: of the whole plane.
        side: length of the world that one period of the picture covers.
    """

    height: float
    albedo: NDArray[np.uint8]
    bumps: NDArray[np.float32] | None = None
    roughness: float = 0.8
    side: float = 2.0


@dataclass(frozen=True)
class Light:
    """Light from all around.

    Attributes:
        panorama: (h, 2h, 3) float32 linear RGB, equirectangular as in Blender: the first row is up, the middle column
            looks along +x, columns go clockwise seen from above; divided by its mean over the sphere.
        strength: multiplies it.
        turn: by how many radians it is turned about z, counter-clockwise seen from above.
    """

    panorama: NDArray[np.float32]
    strength: float = 0.65
    turn: float = 0.0


@dataclass(frozen=True)
class Shot:
    """One view: a pinhole camera in the object's world, and where on the ground the object stands.

    Attributes:
        camera: width, height, K, R, t; no distortion.
        place: (x, y) in the ground's own coordinates of the world's origin.
    """

    camera: Camera
    place: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Scene:
    """An object, ready to be rendered. Without a ground it floats before its light."""

    model: Model
    surface: Surface
    ground: Ground | None
    light: Light
    shots: tuple[Shot, ...]
    seed: int = 0


@dataclass(frozen=True)
class Picture:
    """What a shot gives.

    Attributes:
        image: (H, W, 3) uint8 sRGB.
        mask: (H, W) bool: the object is what is seen through the pixel's centre.
        depth: (H, W) float32 z-depth of what is seen through the pixel's centre, ground included; 0 where nothing is.
    """

    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    depth: NDArray[np.float32]


RENDERER_VERSIONS = {"fast": 2, "cycles": 2}
"""Raised by hand when a renderer's pictures of the same scene change; part of the fingerprint of what it made."""


class Renderer(Protocol):
    """Makes pictures: a function of the scene and of the renderer's settings, whatever was rendered before."""

    version: str
    """The renderer, `RENDERER_VERSIONS` of it and what program it uses, as the details of the stage `frames` say."""

    def render(self, scene: Scene) -> Iterator[Picture]:
        """A picture for each shot, in order. Raises BadInput where the scene cannot be rendered."""
        ...

    def close(self) -> None: ...
