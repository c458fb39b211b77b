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
from pipeline.demo.raster import Panel, Visible, project, rasterise
from pipeline.demo.solids import box, cylinder, ellipsoid, placed, turn_about
from pipeline.demo.textures import SolidTexture, painted_plane, random_texture
from pipeline.geometry import Camera, Floats

OBJECT_TEXELS, CLUTTER_TEXELS = 320, 190
"""Texels a unit of length on the object and on the things around it."""
SHADOW_TEXELS, SHADOW_REACH = 130, 5.6
"""Resolution of the light's depth map a unit of length, and half its side."""
ROOM_RADIUS, ROOM_WALLS = 5.6, 6
NEAR_RING, FAR_RING = (0.95, 1.5), (3.7, 4.9)
"""Distances from the object at which things stand around; the camera moves between the two rings."""
LOWEST_ELEVATION_DEG = 22.0
"""Nothing hides the object from a camera at or above this elevation: near things are kept low enough."""
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


def build_scene(family: str, seed: int) -> Scene:
    """The world of one instance: object, clutter, room and light, all drawn from (family, seed)."""
    rng = seeds.generator("demo", "scene", family, seed)
    parts = shapes.make_object(family, seed)
    items = [(part.grids, random_texture(rng, part.name), OBJECT_TEXELS) for part in parts]
    n_object = len(items)
    reach = max(float(np.hypot(grid[..., 0], grid[..., 1]).max()) for part in parts for grid in part.grids)
    items += [(grids, random_texture(rng), CLUTTER_TEXELS) for grids in _clutter(rng, reach)]

    charts: list[_Chart] = []
    for number, (grids, texture, texels) in enumerate(items):
        charts += [_Chart(grid, texture, texels, number < n_object) for grid in grids]
    shape = _pack(charts)
    starts = np.cumsum([0, *(chart.grid.shape[0] * chart.grid.shape[1] for chart in charts)])
    vertices = np.concatenate([chart.grid.reshape(-1, 3) for chart in charts])
    faces = np.concatenate([_grid_faces(chart.grid) + start for chart, start in zip(charts, starts, strict=False)])
    is_object = np.concatenate([np.full(len(_grid_faces(chart.grid)), chart.is_object) for chart in charts])

    light = _Light.cast(rng, vertices, faces)
    atlas = np.zeros((*shape, 3), np.uint8)
    for chart in charts:
        points, normals = chart.surface()
        colours = chart.texture.colour(points) * light.on(points, normals)
        window = atlas[chart.y : chart.y + chart.height, chart.x : chart.x + chart.width]
        window[:] = np.clip(255 * colours, 0, 255).reshape(window.shape)
    height = max(float(grid[..., 2].max()) for part in parts for grid in part.grids)
    uv = np.concatenate([chart.uv() for chart in charts])
    return Scene(vertices, faces, is_object, uv, atlas, _room(rng, light, vertices, faces), height)


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


def _clutter(rng: np.random.Generator, object_reach: float) -> list[tuple[Floats, ...]]:
    """Boxes, balls, drums and cones around the object, none standing between it and a camera."""
    slope = np.tan(np.radians(LOWEST_ELEVATION_DEG))
    placed_at: list[tuple[Floats, float]] = []
    things: list[tuple[Floats, ...]] = []
    for ring, count, sizes in ((NEAR_RING, 9, (0.09, 0.17)), (FAR_RING, 11, (0.2, 0.5))):
        for _ in range(count * 6):
            if len(things) >= (9 if ring is NEAR_RING else 20):
                break
            radius, angle, distance = rng.uniform(*sizes), rng.uniform(0, 2 * np.pi), rng.uniform(*ring)
            at = distance * np.array([np.cos(angle), np.sin(angle)])
            if any(np.linalg.norm(at - other) < 1.1 * (radius + r) for other, r in placed_at):
                continue
            tall = radius * rng.uniform(0.6, 2.6)
            if ring is NEAR_RING:
                tall = min(tall, (distance - radius - object_reach) * slope)
                if tall < 0.03:
                    continue
            placed_at.append((at, radius))
            things.append(_thing(rng, radius, tall, at))
    return things


def _thing(rng: np.random.Generator, radius: float, tall: float, at: Floats) -> tuple[Floats, ...]:
    """One piece of clutter that fits a cylinder of that radius and height."""
    match rng.integers(4):
        case 0:
            size = np.array([np.cos(a := rng.uniform(0.5, 1.0)), np.sin(a), 0]) * 2 * radius
            grids = box(size + np.array([0, 0, tall]), (0, 0, tall / 2), 0.06)
        case 1:
            grids = cylinder(radius, 0, tall)
        case 2:
            ball = min(radius, tall / 2)
            grids = ellipsoid((ball, ball, ball), (0, 0, ball))
        case _:
            grids = cylinder(radius, 0, tall, radius * rng.uniform(0.2, 0.7))
    return placed(grids, turn=turn_about(2, float(rng.uniform(0, 360))), shift=(*at, 0))


@dataclass(frozen=True)
class _Light:
    """A lamp far away, the sky, and the lamp's view of the scene for shadows.

    Attributes:
        frame: (3, 3) rows: the light map's x and y in the world, and the direction to the lamp.
        key, sky: (3,) RGB strengths.
        heights: (S, S) float32, the nearest surface to the lamp at each texel of the light map (-inf: none).
    """

    frame: Floats
    key: Floats
    sky: Floats
    heights: NDArray[np.float32]

    @classmethod
    def cast(cls, rng: np.random.Generator, vertices: Floats, faces: NDArray[np.int64]) -> _Light:
        elevation, azimuth = np.radians(rng.uniform(48, 68)), rng.uniform(0, 2 * np.pi)
        to_lamp = np.array(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        )
        x = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        frame = np.stack([x, np.cross(to_lamp, x), to_lamp])
        warm = rng.uniform(-0.05, 0.05)
        key, sky = (
            rng.uniform(0.72, 0.85) * np.array([1 + warm, 1, 1 - warm]),
            rng.uniform(0.42, 0.5) * np.array([0.97, 1, 1.04]),
        )
        heights = _seen_along(frame, vertices, faces)
        return cls(frame, key, sky, heights)

    def on(self, points: Floats, normals: Floats) -> Floats:
        """Light (N, 3) that reaches surface points (N, 3) with unit normals (N, 3)."""
        facing = np.maximum(normals @ self.frame[2], 0)
        # off the surface along the normal: a point must not shade itself
        local = (points + 0.025 * normals) @ self.frame.T
        at = (local[:, :2] + SHADOW_REACH) * SHADOW_TEXELS
        size = self.heights.shape[0]
        open_share = np.zeros(len(points))
        for dx, dy in np.ndindex(3, 3):
            column = np.clip((at[:, 0] + dx - 1).astype(int), 0, size - 1)
            row = np.clip((at[:, 1] + dy - 1).astype(int), 0, size - 1)
            open_share += self.heights[row, column] < local[:, 2]
        # the ground takes away half the sky from what looks down, more from what is close to it
        near_ground = np.clip(points[:, 2] / 0.22, 0, 1)
        sky = (0.68 + 0.32 * normals[:, 2]) * (0.7 + 0.3 * near_ground)
        return self.key * (facing * open_share / 9)[:, None] + self.sky * sky[:, None]

    def on_ground(self, panel: Panel, vertices: Floats, faces: NDArray[np.int64]) -> NDArray[np.uint8]:
        """The panel's picture, a part of z = 0, lit and with the shadows of everything on it."""
        height, width = panel.texture.shape[:2]
        lamp = cv2.GaussianBlur(np.isfinite(self.heights).astype(np.float32), (0, 0), 1.8)
        low = np.where(vertices[:, 2:] < 0.1, vertices, np.nan)
        contact = np.isfinite(_seen_along(np.eye(3), low, faces)).astype(np.float32)
        above = cv2.GaussianBlur(contact, (0, 0), 0.07 * SHADOW_TEXELS)
        shades = []
        for frame, shade in ((self.frame, lamp), (np.eye(3), above)):
            # texel index of the panel -> texel index of the map, both half a step from positions
            world = np.stack([panel.right, panel.down, panel.origin + 0.5 * (panel.right + panel.down)], axis=1)
            to_map = (frame[:2] @ world) * SHADOW_TEXELS
            to_map[:, 2] += SHADOW_REACH * SHADOW_TEXELS - 0.5
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            shades.append(cv2.warpAffine(shade, to_map, (width, height), flags=flags))
        key = (self.key * self.frame[2, 2]).astype(np.float32)
        lit = (1 - shades[0])[..., None] * key + (1 - 0.5 * shades[1])[..., None] * self.sky.astype(np.float32)
        return np.clip(panel.texture * lit, 0, 255).astype(np.uint8)


def _seen_along(frame: Floats, vertices: Floats, faces: NDArray[np.int64]) -> NDArray[np.float32]:
    """Largest coordinate along frame[2] at each texel of an orthographic map, -inf where there is nothing."""
    size = int(2 * SHADOW_REACH * SHADOW_TEXELS)
    local = vertices @ frame.T
    xy = (local[:, :2] + SHADOW_REACH) * SHADOW_TEXELS
    lift = 2 * SHADOW_REACH  # makes all positive, as the depth buffer wants
    nearness = np.where(np.isfinite(local[:, 2]), local[:, 2] + lift, -1)
    seen = rasterise(np.nan_to_num(xy), nearness, faces, size, size, cull=False)
    return np.where(seen.face >= 0, seen.nearness - lift, -np.inf).astype(np.float32)


def _room(rng: np.random.Generator, light: _Light, vertices: Floats, faces: NDArray[np.int64]) -> tuple[Panel, ...]:
    """Floor, walls and the mat under the object, with light and shadows."""
    x, y, z = np.eye(3)
    corners = (np.arange(ROOM_WALLS) + 0.5) * 2 * np.pi / ROOM_WALLS
    outer = ROOM_RADIUS / np.cos(np.pi / ROOM_WALLS)
    ring = np.stack([outer * np.cos(corners), outer * np.sin(corners), np.zeros(ROOM_WALLS)], axis=1)

    def ground(half: float, texels: int, step: int, style: str, outline: Floats) -> Panel:
        side = int(2 * half * texels)
        bare = Panel(
            np.array([-half, -half, 0]), x / texels, y / texels, outline, painted_plane(rng, side, side, step, style)
        )
        return Panel(bare.origin, bare.right, bare.down, outline, light.on_ground(bare, vertices, faces))

    panels = [ground(outer, 130, 50, str(rng.choice(["tiles", "boards"])), ring)]
    texels, tall = 120, 3.4
    for first, second in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        width = float(np.linalg.norm(second - first))
        picture = painted_plane(rng, int(tall * texels), int(width * texels), 90, "paper")
        shade = rng.uniform(0.7, 1.0)
        right = (second - first) / width / texels
        outline = np.array([first, second, second + 12 * z, first + 12 * z])
        panels.append(Panel(first + tall * z, right, -z / texels, outline, (picture * shade).astype(np.uint8)))
    half = 1.75
    mat = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    panels.append(ground(half, 380, int(rng.integers(60, 120)), str(rng.choice(["shapes", "tiles", "boards"])), mat))
    return tuple(panels)
