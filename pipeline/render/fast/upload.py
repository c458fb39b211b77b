"""A scene on the device: buffers, textures and shadows that all its shots share."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Floats
from pipeline.render.exposure import to_linear
from pipeline.render.fast.context import MAX_COLOURS, context, give_texture, program, take_texture
from pipeline.render.fast.geometry import Geometry, occluder_faces
from pipeline.render.fast.light import CASTERS, DIRECTIONS, KEYS, Lights, frame_of, lights_of
from pipeline.render.scene import Ground, Scene

TILE = 128
"""Side of a direction's shadow map."""
TILES = (8, -(-DIRECTIONS // 8))
GUTTER = 1.0 - 4.0 / TILE
"""Share of a tile that the object's ball fills, so that no tile's filter reads its neighbour."""
CAST = 192
"""Side of the picture of shadows on the ground."""
LOWEST_CASTER = 0.12
"""Height of the lowest direction that casts a shadow on the ground."""
MAX_REACH = 4.0
UNITS = {"panorama": 2, "albedo": 3, "slopes": 4, "blocked": 5, "textures": 6, "atlas": 7}
"""Texture units of what a scene has; those of a shot's targets come before."""
SCREENS = ("sky", "ground", "object", "depth", "resolve")
TEXTURED = 3
PROGRAMS = ("sky", "ground", "object", "resolve", "shadow", "cast")

_current: SceneOnDevice | None = None  # whose values the programs hold


class SceneOnDevice:
    """Uploads a scene; what it made is released when `stack` is closed.

    Attributes:
        visible: draws all faces by the program "visible".
        kind: the macro KIND of the program "object".
        height: of the ground, None without one.
    """

    def __init__(self, scene: Scene, geometry: Geometry, stack: ExitStack) -> None:
        self._stack = stack
        self._textures: dict[int, Any] = {}
        self._values: dict[str, Any] = {}
        self.kind = _kind(scene, geometry)
        self.height = None if scene.ground is None else scene.ground.height
        ctx = context()
        vertices = self._own(ctx.buffer(geometry.vertices.tobytes()))
        indices = self._own(ctx.buffer(np.ascontiguousarray(geometry.faces[:, :3]).tobytes()))
        self.visible = self._mesh("visible", vertices, indices)
        occluders = occluder_faces(geometry)
        few = indices if len(occluders) == len(geometry.faces) else self._own(ctx.buffer(occluders.tobytes()))
        arrays = (geometry.faces, geometry.colours, geometry.materials)
        self._buffers = [vertices, *(self._own(ctx.buffer(array.tobytes())) for array in arrays)]
        self._screens = {name: self._own(ctx.vertex_array(self._program(name), [])) for name in SCREENS}
        lights = lights_of(scene.light, scene.ground)
        self._set_light(scene, lights)
        self._set_surface(scene)
        self._set_directions(lights, geometry)
        self._set_ground(scene.ground, lights, geometry)
        if self.kind == TEXTURED:
            self._textures[UNITS["textures"]] = self._texture_array(geometry.textures)
        self._textures[UNITS["panorama"]] = self._panorama(scene.light.panorama)
        self.make_current()
        self._textures[UNITS["atlas"]] = self._shadow_atlas(self._mesh("shadow", vertices, few), lights)
        if scene.ground is not None:
            self._textures[UNITS["blocked"]] = self._cast(self._mesh("cast", vertices, few), lights)

    def make_current(self) -> None:
        """Bind what the scene has, and give the programs its values if they hold another scene's."""
        global _current
        for unit, texture in self._textures.items():
            texture.use(unit)
        for binding, buffer in enumerate(self._buffers):
            buffer.bind_to_storage_buffer(binding)
        if _current is self:
            return
        for name in PROGRAMS:
            target = self._program(name)
            for key, value in self._values.items():
                set_value(target, key, value)
            for key, unit in UNITS.items():
                set_value(target, key, unit)
        _current = self

    def draw(self, name: str, values: dict[str, Any]) -> None:
        """Run a program over the target that is set."""
        import moderngl

        target = self._program(name)
        for key, value in values.items():
            set_value(target, key, value)
        self._screens[name].render(moderngl.TRIANGLES, vertices=3)

    def _program(self, name: str) -> Any:
        return program(name, self.kind if name == "object" else 0)

    # ---- values

    def _set_light(self, scene: Scene, lights: Lights) -> None:
        self._values |= {
            "turn": scene.light.turn,
            "panorama_rows": float(len(scene.light.panorama)),
            "exposure": lights.exposure,
            "harmonics": lights.harmonics,
            "keys": lights.keys,
            "key_directions": lights.key_directions,
            "bounce": lights.bounce,
            "weights": lights.weights,
            "n_keys": int(lights.keys.any(axis=1).sum()),
        }

    def _set_surface(self, scene: Scene) -> None:
        surface = scene.surface
        colours = np.zeros((MAX_COLOURS, 3))
        given = to_linear(np.clip(np.asarray(surface.colours, np.float64), 0, 1))[:MAX_COLOURS]
        colours[: len(given)] = given
        self._values |= {
            "palette": colours,
            "n_colours": len(given),
            "cells": float(surface.cells),
            "seed": surface.seed & 0xFFFFFFFF,
            "roughness": float(surface.roughness),
        }

    def _set_directions(self, lights: Lights, geometry: Geometry) -> None:
        centre = (geometry.low + geometry.high) / 2
        radius = max(1.01 * float(np.linalg.norm(geometry.high - geometry.low)) / 2, 1e-6)
        rows = np.zeros((3, DIRECTIONS, 4))
        for row, axes in zip(rows, (*frame_of(lights.directions), lights.directions), strict=True):
            row[:, :3], row[:, 3] = axes / radius, -(axes @ centre) / radius
        scale = np.array([1 / TILES[0], 1 / TILES[1]])
        place = np.stack(np.divmod(np.arange(DIRECTIONS), TILES[0])[::-1], axis=1)
        tiles = np.concatenate([np.tile(scale * GUTTER, (DIRECTIONS, 1)), (2 * place + 1) * scale - 1], axis=1)
        self._values |= {"across": rows[0], "along": rows[1], "toward": rows[2], "tiles": tiles}
        self._values |= {"shadow_step": 2 * radius / (GUTTER * TILE)}

    def _set_ground(self, ground: Ground | None, lights: Lights, geometry: Geometry) -> None:
        self._values |= {"has_ground": int(ground is not None)}
        if ground is None:
            return
        self._values |= {"height": float(ground.height), "side": float(ground.side)}
        self._values |= {"ground_roughness": float(ground.roughness), "has_bumps": int(ground.bumps is not None)}
        self._textures[UNITS["albedo"]] = self._albedo(ground.albedo)
        if ground.bumps is not None:
            self._textures[UNITS["slopes"]] = self._slopes(ground)
        casters = _casters(lights)
        toward, shares = (np.zeros((CASTERS, 4)) for _ in range(2))
        toward[: len(casters), :3] = lights.ground_directions[casters]
        shares[: len(casters), : 1 + KEYS] = lights.ground_weights[casters]
        reach = shadow_reach(lights.ground_directions[casters], geometry, ground.height)
        self._values |= {"caster_toward": toward, "shares": shares, "reach": reach}

    # ---- shadows

    def _shadow_atlas(self, mesh: Any, lights: Lights) -> Any:
        import moderngl

        ctx = context()
        depth = self._own(ctx.depth_texture((TILE * TILES[0], TILE * TILES[1])))
        depth.compare_func = "<="
        depth.filter = (moderngl.LINEAR, moderngl.LINEAR)
        depth.repeat_x = depth.repeat_y = False
        target = self._own(ctx.framebuffer(depth_attachment=depth))
        used = np.flatnonzero(lights.weights > 0)
        set_value(program("shadow"), "used", _padded(used))
        target.use()
        target.clear(depth=1.0)
        ctx.enable_only(moderngl.DEPTH_TEST)
        ctx.depth_func = "<"
        mesh.render(moderngl.TRIANGLES, instances=len(used))
        return depth

    def _cast(self, mesh: Any, lights: Lights) -> Any:
        """Shares of smooth light and of the key lights that the object keeps from the ground: (CAST, CAST, 4)."""
        import moderngl

        ctx = context()
        texture = self._own(ctx.texture((CAST, CAST), 4, dtype="f4"))
        texture.repeat_x = texture.repeat_y = False
        depth = self._own(ctx.depth_renderbuffer((CAST, CAST)))
        target = self._own(ctx.framebuffer([texture], depth))
        count = len(_casters(lights))
        target.use()
        target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        ctx.depth_func = "<"
        ctx.blend_func = moderngl.ONE, moderngl.ONE
        if count:
            mesh.render(moderngl.TRIANGLES, instances=count)
        texture.build_mipmaps(0, 2)
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        return texture

    # ---- textures and buffers

    def _own(self, made: Any) -> Any:
        self._stack.callback(made.release)
        return made

    def _mesh(self, name: str, vertices: Any, indices: Any) -> Any:
        content = [(vertices, "3f 20x", "position")]
        return self._own(context().vertex_array(program(name), content, index_buffer=indices, index_element_size=4))

    def _albedo(self, picture: NDArray[np.uint8]) -> Any:
        """Square roots of linear light in 8 bits: as fine as sRGB, and cheap to undo after the filter."""
        picture = np.ascontiguousarray(picture)
        levels = [cv2.LUT(picture, _ROOTS_OF_SRGB)]
        light: NDArray[Any] = cv2.LUT(picture, _LINEAR)
        while max(light.shape[:2]) > 1:
            light = _halved(light)
            levels.append(np.take(_ROOTS, light >> 4))
        return self._levels([cv2.cvtColor(level, cv2.COLOR_RGB2RGBA) for level in levels])

    def _slopes(self, ground: Ground) -> Any:
        assert ground.bumps is not None
        levels = [slopes_of(ground.bumps, ground.side)]
        while max(levels[-1].shape[:2]) > 1:
            levels.append(_halved(levels[-1]))
        return self._levels(levels)

    def _panorama(self, panorama: NDArray[np.float32]) -> Any:
        """With levels that are blurred before they are halved, so that wide highlights have no corners."""
        level = cv2.cvtColor(np.ascontiguousarray(panorama), cv2.COLOR_RGB2RGBA)
        levels = [level]
        while max(level.shape[:2]) > 1:
            if min(level.shape[:2]) >= 4:
                wide = cv2.copyMakeBorder(level, 0, 0, 2, 2, cv2.BORDER_WRAP)
                level = cv2.GaussianBlur(wide, (5, 5), 0.9, borderType=cv2.BORDER_REPLICATE)[:, 2:-2]
            level = _halved(level)
            levels.append(level)
        made = self._levels(levels)
        made.repeat_y = False
        return made

    def _texture_array(self, textures: NDArray[np.uint8]) -> Any:
        import moderngl

        count, height, width, _ = textures.shape
        made = self._own(context().texture_array((width, height, count), 4, textures.tobytes()))
        made.build_mipmaps()
        made.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        return made

    def _levels(self, levels: list[NDArray[Any]]) -> Any:
        """A texture of mip levels, from the process's stock: to make one anew takes longer than to fill it."""
        first = levels[0]
        made = take_texture(first.shape[1], first.shape[0], first.shape[2], first.dtype)
        self._stack.callback(give_texture, made)
        for number, level in enumerate(levels):
            made.write(np.ascontiguousarray(level), level=number, alignment=1)
        return made


def set_value(target: Any, key: str, value: Any) -> None:
    """Set a uniform that a program has; arrays as float32 unless they are integers. Others are passed over."""
    uniform = target.get(key, None)  # `in` would go through all names
    if uniform is None:
        return
    if isinstance(value, np.ndarray):
        data = np.ascontiguousarray(value, None if value.dtype.kind == "i" else np.float32).tobytes()
        uniform.write(data[: 4 * uniform.array_length * uniform.dimension])  # a compiler drops ends that are not read
    else:
        uniform.value = value


def slopes_of(bumps: NDArray[np.float32], side: float) -> NDArray[np.float32]:
    """(S, S', 2) derivatives of heights along the ground's x and y; rows go against y."""
    wide = cv2.copyMakeBorder(bumps, 1, 1, 1, 1, cv2.BORDER_WRAP)
    x = (wide[1:-1, 2:] - wide[1:-1, :-2]) * np.float32(bumps.shape[1] / (2 * side))
    y = (wide[:-2, 1:-1] - wide[2:, 1:-1]) * np.float32(bumps.shape[0] / (2 * side))
    return np.stack([x, y], axis=-1)


def shadow_reach(directions: Floats, geometry: Geometry, height: float) -> float:
    """Half the side of the square of ground around the origin that shadows along directions (N, 3) fall on."""
    corners = geometry.corners()
    far = float(np.abs(corners[:, :2]).max())
    if len(directions):
        up = np.maximum(corners[:, 2] - height, 0)
        feet = corners[None, :, :2] - directions[:, None, :2] * (up[None] / directions[:, None, 2:])[..., None]
        far = max(far, float(np.abs(feet).max()))
    return min(1.05 * far, MAX_REACH)


def _kind(scene: Scene, geometry: Geometry) -> int:
    return {"own": TEXTURED if len(geometry.textures) else 0, "colour": 1, "voronoi": 2}[scene.surface.kind]


def _casters(lights: Lights) -> NDArray[np.intp]:
    """Which of the ground's directions throw a shadow: the lowest throw them out of sight."""
    return np.flatnonzero((lights.ground_directions[:, 2] > LOWEST_CASTER) & lights.ground_weights.any(axis=1))


def _halved(level: NDArray[Any]) -> NDArray[Any]:
    height, width = max(1, level.shape[0] // 2), max(1, level.shape[1] // 2)
    return np.asarray(cv2.resize(level, (width, height), interpolation=cv2.INTER_AREA))


def _padded(numbers: NDArray[np.intp]) -> NDArray[np.int32]:
    out = np.zeros(DIRECTIONS, np.int32)
    out[: len(numbers)] = numbers
    return out


_LINEAR = np.rint(65535 * to_linear(np.arange(256) / 255)).astype(np.uint16)
_ROOTS_OF_SRGB = np.rint(255 * np.sqrt(to_linear(np.arange(256) / 255))).astype(np.uint8)
_ROOTS = np.rint(255 * np.sqrt((np.arange(4096) + 0.5) / 4096)).astype(np.uint8)
