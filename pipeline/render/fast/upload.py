"""A scene on the device: buffers, textures and shadows that all its shots share."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Floats
from pipeline.render.fast import light as lighting
from pipeline.render.fast.context import context, program
from pipeline.render.fast.geometry import Geometry, linear, occluder_faces
from pipeline.render.fast.light import AMBIENT_SAMPLES, DIRECTIONS, KEY_SAMPLES, KEYS, Lights, lights_of
from pipeline.render.scene import Ground, Scene

TILE = 128
"""Side of a direction's shadow map."""
TILES = (8, -(-DIRECTIONS // 8))
GUTTER = 1.0 - 4.0 / TILE
"""Share of a tile that the object's ball fills, so that no tile's filter reads its neighbour."""
CAST = 256
"""Side of the picture of shadows on the ground."""
LOWEST_CASTER = 0.12
"""Height of the lowest direction that casts a shadow on the ground."""
MAX_REACH = 4.0
KINDS = {"own": 0, "colour": 1, "voronoi": 2}
MAX_COLOURS = 64
UNITS = {"seen": 0, "seen_centre": 1, "textures": 2, "atlas": 3, "blocked": 4, "panorama": 5, "albedo": 6, "slopes": 7}


class SceneOnDevice:
    """Uploads a scene; what it made is released when `stack` is closed."""

    def __init__(self, scene: Scene, geometry: Geometry, stack: ExitStack) -> None:
        self._stack = stack
        self._textures: dict[int, Any] = {}
        ctx = context()
        vertices = self._own(ctx.buffer(geometry.vertices.tobytes()))
        corners = np.ascontiguousarray(geometry.faces[:, :3])
        indices = self._own(ctx.buffer(corners.tobytes()))
        self.visible = self._mesh("visible", vertices, indices)
        occluders = occluder_faces(geometry)
        few = indices if len(occluders) == len(corners) else self._own(ctx.buffer(occluders.tobytes()))
        self._buffers = [
            vertices,
            *(
                self._own(ctx.buffer(np.ascontiguousarray(array).tobytes()))
                for array in (geometry.colours, geometry.faces, geometry.materials)
            ),
        ]
        self._picture = self._own(ctx.vertex_array(program("shade"), []))
        lights = lights_of(scene.light, scene.ground)
        self._values: dict[str, Any] = {}
        self._set_light(scene, lights)
        self._set_surface(scene)
        self._set_directions(lights, geometry)
        self._textures[UNITS["textures"]] = self._texture_array(geometry.textures)
        self._textures[UNITS["atlas"]] = self._shadow_atlas(self._mesh("shadow", vertices, few), lights)
        self._textures[UNITS["panorama"]] = self._panorama(scene.light.panorama)
        self._set_ground(scene.ground, lights, geometry, self._mesh("cast", vertices, few))
        self._write("shade")

    def use(self) -> None:
        """Draw the picture of the shot whose values are set into the target that is set."""
        import moderngl

        for unit, texture in self._textures.items():
            texture.use(unit)
        for binding, buffer in enumerate(self._buffers):
            buffer.bind_to_storage_buffer(binding)
        context().enable_only(moderngl.NOTHING)
        self._picture.render(moderngl.TRIANGLES, vertices=3)

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
        }

    def _set_surface(self, scene: Scene) -> None:
        surface = scene.surface
        colours = np.zeros((MAX_COLOURS, 3))
        given = linear(np.clip(np.asarray(surface.colours, np.float64), 0, 1))[:MAX_COLOURS]
        colours[: len(given)] = given
        self._values |= {
            "kind": KINDS[surface.kind],
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
        for number, direction in enumerate(lights.directions):
            for row, axis in zip(rows[:, number], (*lighting.frame_of(direction), direction), strict=True):
                row[:3], row[3] = axis / radius, -(axis @ centre) / radius
        scale = np.array([1 / TILES[0], 1 / TILES[1]])
        place = np.stack(np.divmod(np.arange(DIRECTIONS), TILES[0])[::-1], axis=1)
        tiles = np.concatenate([np.tile(scale * GUTTER, (DIRECTIONS, 1)), (2 * place + 1) * scale - 1], axis=1)
        self._values |= {"across": rows[0], "along": rows[1], "toward": rows[2], "tiles": tiles}
        self._values |= {"shadow_step": 2 * radius / (GUTTER * TILE), "radius": radius}

    def _set_ground(self, ground: Ground | None, lights: Lights, geometry: Geometry, mesh: Any) -> None:
        self._values |= {"has_ground": int(ground is not None), "has_bumps": 0, "height": 0.0, "side": 1.0}
        self._values |= {"ground_roughness": 1.0, "reach": 1.0}
        blank = np.zeros((1, 1, 3), np.uint8)
        self._textures[UNITS["albedo"]] = self._tiling(blank if ground is None else ground.albedo)
        self._textures[UNITS["slopes"]] = self._tiling(np.zeros((1, 1, 2), np.float32))
        self._textures[UNITS["blocked"]] = self._own(context().texture((1, 1), 4, bytes(16), dtype="f4"))
        if ground is None:
            return
        self._values |= {"height": ground.height, "side": ground.side, "ground_roughness": ground.roughness}
        if ground.bumps is not None:
            self._values["has_bumps"] = 1
            self._textures[UNITS["slopes"]] = self._tiling(slopes_of(ground.bumps, ground.side))
        self._textures[UNITS["blocked"]] = self._cast(mesh, lights, geometry, ground.height)

    def _write(self, name: str) -> None:
        target = program(name)
        for key, value in self._values.items():
            if key not in target:
                continue
            if isinstance(value, np.ndarray):
                target[key].write(np.ascontiguousarray(value, np.float32).tobytes())
            else:
                target[key].value = value
        if name == "shade":
            for key, unit in UNITS.items():
                if key in target:
                    target[key].value = unit

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
        self._write("shadow")
        program("shadow")["used"].write(_padded(used).tobytes())
        target.use()
        target.clear(depth=1.0)
        ctx.enable_only(moderngl.DEPTH_TEST)
        ctx.depth_func = "<"
        mesh.render(moderngl.TRIANGLES, instances=len(used))
        return depth

    def _cast(self, mesh: Any, lights: Lights, geometry: Geometry, height: float) -> Any:
        """Shares of smooth light and of the key lights that the object keeps from the ground: (CAST, CAST, 4)."""
        import moderngl

        ctx = context()
        z = lights.directions[:, 2]
        casts = (z > LOWEST_CASTER) & (lights.weights > 0)
        shares = np.zeros((DIRECTIONS, 4))
        for key in range(KEYS):
            chosen = slice(key * KEY_SAMPLES, (key + 1) * KEY_SAMPLES)
            shares[chosen, 1 + key] = lights.weights[chosen]
        smooth = slice(DIRECTIONS - AMBIENT_SAMPLES, DIRECTIONS)
        shares[smooth, 0] = lights.weights[smooth] * np.maximum(z[smooth], 0)
        shares[smooth, 0] /= max(shares[smooth, 0].sum(), 1e-12)
        reach = shadow_reach(lights.directions[casts], geometry, height)
        self._values["reach"] = reach
        self._values["shares"] = shares
        texture = self._own(ctx.texture((CAST, CAST), 4, dtype="f4"))
        texture.repeat_x = texture.repeat_y = False
        depth = self._own(ctx.depth_renderbuffer((CAST, CAST)))
        target = self._own(ctx.framebuffer([texture], depth))
        used = np.flatnonzero(casts)
        # `toward` is scaled for shadow maps; only its direction counts here
        self._write("cast")
        program("cast")["used"].write(_padded(used).tobytes())
        target.use()
        target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        ctx.depth_func = "<"
        ctx.blend_func = moderngl.ONE, moderngl.ONE
        if len(used):
            mesh.render(moderngl.TRIANGLES, instances=len(used))
        return texture

    # ---- textures and buffers

    def _own(self, made: Any) -> Any:
        self._stack.callback(made.release)
        return made

    def _mesh(self, name: str, vertices: Any, indices: Any) -> Any:
        content = [(vertices, "3f 20x", "position")]
        return self._own(context().vertex_array(program(name), content, index_buffer=indices, index_element_size=4))

    def _tiling(self, picture: NDArray[Any]) -> Any:
        """A picture that wraps around, with mip levels: uint8 sRGB, or float32 as it is."""
        import moderngl

        data = np.ascontiguousarray(picture)
        size = (data.shape[1], data.shape[0])
        if data.dtype == np.uint8:
            srgb8 = 0x8C41  # GL_SRGB8: linear before it is filtered
            made = self._own(context().texture(size, 3, data.tobytes(), alignment=1, internal_format=srgb8))
        else:
            half = data.astype(np.float16)
            made = self._own(context().texture(size, data.shape[2], half.tobytes(), alignment=1, dtype="f2"))
        made.build_mipmaps()
        made.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        return made

    def _texture_array(self, textures: NDArray[np.uint8]) -> Any:
        import moderngl

        if not len(textures):
            textures = np.full((1, 1, 1, 4), 255, np.uint8)
        count, height, width, _ = textures.shape
        made = self._own(context().texture_array((width, height, count), 4, textures.tobytes()))
        made.build_mipmaps()
        made.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        return made

    def _panorama(self, panorama: NDArray[np.float32]) -> Any:
        """With levels that are blurred before they are halved, so that wide highlights have no corners."""
        import moderngl

        level: NDArray[Any] = np.minimum(panorama, 6e4).astype(np.float32)
        height, width = level.shape[:2]
        made = self._own(context().texture((width, height), 3, level.astype(np.float16).tobytes(), dtype="f2", alignment=1))
        made.build_mipmaps()
        for number in range(1, max(height, width).bit_length()):
            level = _halved(level)
            made.write(level.astype(np.float16).tobytes(), level=number, alignment=1)
        made.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        made.repeat_y = False
        return made


def slopes_of(bumps: NDArray[np.float32], side: float) -> NDArray[np.float32]:
    """(S, S, 2) derivatives of heights along the ground's x and y; rows go against y."""
    step_x, step_y = side / bumps.shape[1], side / bumps.shape[0]
    x = (np.roll(bumps, -1, axis=1) - np.roll(bumps, 1, axis=1)) / (2 * step_x)
    y = (np.roll(bumps, 1, axis=0) - np.roll(bumps, -1, axis=0)) / (2 * step_y)
    return np.stack([x, y], axis=-1).astype(np.float32)


def shadow_reach(directions: Floats, geometry: Geometry, height: float) -> float:
    """Half the side of the square of ground, around the world's origin, that shadows along directions (N, 3) fall on."""
    corners = np.array(np.meshgrid(*zip(geometry.low, geometry.high, strict=True))).reshape(3, -1).T
    far = float(np.abs(corners[:, :2]).max())
    if len(directions):
        up = np.maximum(corners[:, 2] - height, 0)
        feet = corners[None, :, :2] - directions[:, None, :2] * (up[None] / directions[:, None, 2])[..., None]
        far = max(far, float(np.abs(feet).max()))
    return min(1.05 * far, MAX_REACH)


def _halved(level: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width = max(1, level.shape[0] // 2), max(1, level.shape[1] // 2)
    if min(level.shape[:2]) >= 4:
        wide = cv2.copyMakeBorder(level, 0, 0, 2, 2, cv2.BORDER_WRAP)
        level = cv2.GaussianBlur(wide, (5, 5), 0.9, borderType=cv2.BORDER_REPLICATE)[:, 2:-2]
    return cv2.resize(level, (width, height), interpolation=cv2.INTER_AREA)


def _padded(numbers: NDArray[np.intp]) -> NDArray[np.int32]:
    out = np.zeros(DIRECTIONS, np.int32)
    out[: len(numbers)] = numbers
    return out
