"""An object on a cluttered ground in a room: geometry, light and colours baked once, then filmed from anywhere.

Surfaces are matt and the light stands still, so colour depends on the surface point alone: albedo, shade and shadow are
baked into one atlas, and a view costs a rasterisation and a look-up. It also makes views exactly consistent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common import seeds
from pipeline.demo import shapes
from pipeline.demo.light import Light
from pipeline.demo.raster import Panel, Visible, project, rasterise
from pipeline.demo.surroundings import clutter, room
from pipeline.demo.textures import SolidTexture, random_texture
from pipeline.geometry import Camera, Floats

OBJECT_TEXELS, CLUTTER_TEXELS = 320, 190
"""Texels a unit of length on the object and on the things around it."""
_PAD = 2


@dataclass(frozen=True)
class Scene:
    """A world ready to be filmed.

    Attributes:
        vertices: (V, 3) world points; faces: (F, 3), clockwise on the screen seen from outside.
        is_object: (F,) bool: the object's faces, as against the clutter's.
        uv: (V, 2) positions in `atlas` (H, W, 3) uint8 RGB.
        panels: the room, farthest first.
        height: of the object, which stands on z = 0 about the z axis.
    """

    vertices: Floats
    faces: NDArray[np.int64]
    is_object: NDArray[np.bool_]
    uv: Floats
    atlas: NDArray[np.uint8]
    panels: tuple[Panel, ...]
    height: float


def render_view(scene: Scene, camera: Camera, samples: int = 2) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Floats]:
    """Film a scene: RGB (H, W, 3) uint8, mask (H, W) uint8 (255 = object) and true z-depth (H, W) float64.

    Mask and depth are exact at pixel centres; colours are means over `samples` x `samples` points a pixel.
    """
    rgb = render_colours(scene, camera, samples)
    visible = _visible(scene, camera)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    room = np.max([panel.nearness(camera, x, y) for panel in scene.panels], axis=0)
    nearness = np.where(visible.face >= 0, visible.nearness, room)
    return rgb, _mask(scene, visible), 1 / nearness


def render_mask(scene: Scene, camera: Camera) -> NDArray[np.uint8]:
    """The object's silhouette (H, W) uint8, 255 = object, exact at pixel centres."""
    return _mask(scene, _visible(scene, camera))


def render_colours(scene: Scene, camera: Camera, samples: int = 2) -> NDArray[np.uint8]:
    """RGB (H, W, 3) uint8, the mean over `samples` x `samples` points a pixel."""
    fine = camera.resized(camera.width * samples, camera.height * samples)
    image = np.zeros((fine.height, fine.width, 3), np.uint8)
    for panel in scene.panels:
        panel.draw(image, fine)
    visible = _visible(scene, fine)
    rows, columns, uv = visible.interpolate(scene.uv, scene.faces)
    if len(rows):
        image[rows, columns] = _look_up(scene.atlas, uv)
    return np.asarray(cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)


def build_scene(family: str, seed: int, detail: float = 1.0) -> Scene:
    """The world of one instance: object, clutter, room and light, all drawn from (family, seed).

    `detail` multiplies the resolution of everything that is painted; 1 suits videos of 640 px.
    """
    rng = seeds.generator("demo", "scene", family, seed)
    parts = shapes.make_object(family, seed)
    items = [(part.grids, random_texture(rng, part.name), OBJECT_TEXELS * detail) for part in parts]
    n_object = len(items)
    reach = max(float(np.hypot(grid[..., 0], grid[..., 1]).max()) for part in parts for grid in part.grids)
    items += [(grids, random_texture(rng), CLUTTER_TEXELS * detail) for grids in clutter(rng, reach)]

    charts: list[_Chart] = []
    for number, (grids, texture, texels) in enumerate(items):
        charts += [_Chart(grid, texture, texels, number < n_object) for grid in grids]
    shape = _pack(charts)
    starts = np.cumsum([0, *(chart.grid.shape[0] * chart.grid.shape[1] for chart in charts)])
    vertices = np.concatenate([chart.grid.reshape(-1, 3) for chart in charts])
    faces = np.concatenate([_grid_faces(chart.grid) + start for chart, start in zip(charts, starts, strict=False)])
    is_object = np.concatenate([np.full(len(_grid_faces(chart.grid)), chart.is_object) for chart in charts])

    light = Light.cast(rng, vertices, faces, detail)
    atlas = np.zeros((*shape, 3), np.uint8)
    for chart in charts:
        points, normals = chart.surface()
        colours = chart.texture.colour(points) * light.on(points, normals)
        window = atlas[chart.y : chart.y + chart.height, chart.x : chart.x + chart.width]
        window[:] = np.clip(255 * colours, 0, 255).reshape(window.shape)
    height = max(float(grid[..., 2].max()) for part in parts for grid in part.grids)
    uv = np.concatenate([chart.uv() for chart in charts])
    panels = room(rng, light, vertices, faces, detail)
    return Scene(vertices, faces, is_object, uv, atlas, panels, height)


def _visible(scene: Scene, camera: Camera) -> Visible:
    return rasterise(*project(camera, scene.vertices), scene.faces, camera.width, camera.height)


def _mask(scene: Scene, visible: Visible) -> NDArray[np.uint8]:
    return np.where((visible.face >= 0) & scene.is_object[visible.face], 255, 0).astype(np.uint8)


def _look_up(atlas: NDArray[np.uint8], uv: Floats) -> NDArray[np.uint8]:
    """Bilinear colours (N, 3) at atlas positions (N, 2)."""
    width = 4096  # remap wants an image-shaped map with sides below 32768
    table = np.zeros((2, -(-len(uv) // width) * width), np.float32)
    table[:, : len(uv)] = (uv - 0.5).T
    x, y = table.reshape(2, -1, width)
    colours = np.asarray(cv2.remap(atlas, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
    return colours.reshape(-1, 3)[: len(uv)]


@dataclass
class _Chart:
    """One grid's rectangle of the atlas. `x`, `y` are set by packing."""

    grid: Floats
    texture: SolidTexture
    texels: float
    is_object: bool
    x: int = 0
    y: int = 0

    def __post_init__(self) -> None:
        self.s_rows = self._lengths(0)
        self.s_columns = self._lengths(1)
        self.height = int(np.ceil(self.s_rows[-1])) + 2 * _PAD
        self.width = int(np.ceil(self.s_columns[-1])) + 2 * _PAD

    def _lengths(self, axis: int) -> Floats:
        """Position in texels of each row (0) or column (1): arc length, as long as nearly the longest line is."""
        steps = np.linalg.norm(np.diff(self.grid, axis=axis), axis=2)
        lines = steps.max(1 - axis)
        return np.concatenate([[0], np.cumsum(lines)]) * self.texels * 0.9

    def uv(self) -> Floats:
        """Atlas positions (m * n, 2) of the grid's points."""
        u, v = np.meshgrid(self.x + _PAD + self.s_columns, self.y + _PAD + self.s_rows)
        return np.stack([u, v], axis=2).reshape(-1, 2)

    def surface(self) -> tuple[Floats, Floats]:
        """Points and unit normals (height * width, 3) at the texels' centres."""
        both = np.concatenate([self.grid, _grid_normals(self.grid)], axis=2)
        both = _blend(both, self.s_rows, np.arange(self.height) + 0.5 - _PAD).swapaxes(0, 1)
        both = _blend(both, self.s_columns, np.arange(self.width) + 0.5 - _PAD).swapaxes(0, 1)
        texels = both.reshape(-1, 6)
        normals = texels[:, 3:]
        return texels[:, :3], normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)


def _blend(values: Floats, knots: Floats, at: Floats) -> Floats:
    """Linear interpolation along the first axis: values (K, ...) at knots (K,) to (len(at), ...), held at the ends."""
    at = np.clip(at, knots[0], knots[-1])
    right = np.clip(np.searchsorted(knots, at, side="right"), 1, len(knots) - 1)
    span = knots[right] - knots[right - 1]
    fraction = (at - knots[right - 1]) / np.where(span > 0, span, 1)
    fraction = fraction.reshape(-1, *(1,) * (values.ndim - 1))
    return values[right - 1] * (1 - fraction) + values[right] * fraction


def _grid_faces(grid: Floats) -> NDArray[np.int64]:
    """Two triangles a cell (F, 3), clockwise seen from outside on a screen whose y points down."""
    m, n = grid.shape[:2]
    a = (np.arange(m - 1)[:, None] * n + np.arange(n - 1)).ravel()
    return np.concatenate([np.stack([a, a + n, a + 1], axis=1), np.stack([a + 1, a + n, a + n + 1], axis=1)])


def _grid_normals(grid: Floats) -> Floats:
    """Outward normals (m, n, 3), not of unit length: cells' area vectors summed at their corners."""
    down, across = np.diff(grid, axis=0), np.diff(grid, axis=1)
    area = np.cross(across[:-1] + across[1:], down[:, :-1] + down[:, 1:])
    total = np.zeros_like(grid)
    for rows in (slice(None, -1), slice(1, None)):
        for columns in (slice(None, -1), slice(1, None)):
            total[rows, columns] += area
    if np.array_equal(grid[:, 0], grid[:, -1]):  # closed round: the seam has cells on both sides
        total[:, 0] = total[:, -1] = total[:, 0] + total[:, -1]
    poles = (grid == grid[:, :1]).all((1, 2))
    total[poles] = total[poles].sum(1, keepdims=True)
    return total


def _pack(charts: Sequence[_Chart]) -> tuple[int, int]:
    """Place charts on shelves, tallest first; returns the atlas's height and width."""
    width = max(2048, *(chart.width for chart in charts))
    x = y = shelf = 0
    for chart in sorted(charts, key=lambda chart: -chart.height):
        if x + chart.width > width:
            x, y = 0, y + shelf
        if x == 0:
            shelf = chart.height
        chart.x, chart.y = x, y
        x += chart.width
    return y + shelf, width
