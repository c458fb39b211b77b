"""What a shot is drawn into, and the passes that draw it.

The depth buffer of the first pass sorts pixels for those that follow: sky and ground run where it was not written, the
object's shader where it was. (A CPU's rasteriser takes both sides of every `if`: what is not drawn is what is saved.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.geometry import Floats
from pipeline.render.fast.context import context, program
from pipeline.render.fast.upload import SceneOnDevice, set_value
from pipeline.render.scene import Picture, Shot

if TYPE_CHECKING:
    import moderngl

CLIP = 0x3000  # GL_CLIP_DISTANCE0
UNSEEN, SEEN = "<=", ">"  # of depth 1.0 against the buffer: where nothing was written, and where something was
EVERYWHERE = (0.0, 0.0, 1.0)


class Targets:
    """Targets for images of one size."""

    def __init__(self, width: int, height: int, supersample: int) -> None:
        self.size, self.supersample = (width, height), supersample
        self._made: list[Any] = []
        ctx = context()
        self.faces = self._texture(1, "f4")
        self.depth_buffer = self._own(ctx.depth_renderbuffer(self.size))
        self.centre = self._own(ctx.framebuffer([self.faces], self.depth_buffer))
        self.colour, self.depth = self._texture(4, "f1"), self._texture(1, "f4")
        self.depth_only = self._own(ctx.framebuffer([self.depth], self.depth_buffer))
        if supersample == 1:
            self.picture = self._own(ctx.framebuffer([self.colour, self.depth], self.depth_buffer))
        else:
            self.picture = self._own(ctx.framebuffer([self.colour]))
            self.behind = self._texture(4, "f2")
            self.behind_target = self._own(ctx.framebuffer([self.behind, self.depth]))
            self.sample_faces = self._texture(1, "f4", supersample)
            self.object = self._texture(4, "f2", supersample)
            depth = self._own(ctx.depth_renderbuffer((width * supersample, height * supersample)))
            self.samples = self._own(ctx.framebuffer([self.sample_faces], depth))
            self.object_target = self._own(ctx.framebuffer([self.object], depth))
            self.object_target.depth_mask = False
        self.depth_only.depth_mask = self.picture.depth_mask = False

    def shoot(self, shot: Shot, device: SceneOnDevice, matrix: Floats) -> Picture:
        """Draw a shot. `matrix` (4, 4): clip coordinates from the world."""
        ctx, scale = context(), self.supersample
        ctx.enable_direct(CLIP)
        above = 0.0 if device.height is None else 1.0 if shot.camera.centre[2] >= device.height else -1.0
        visible = program("visible")
        set_value(visible, "clip_from_world", matrix.T)
        set_value(visible, "ground", (device.height or 0.0, above))
        values = _camera_values(shot) | {"supersample": scale, "step_px": 1.0, "encode": int(scale == 1)}
        values["size"] = tuple(map(float, self.size))
        self._see(self.centre, device)
        if scale == 1:
            self._behind(self.picture, device, values, UNSEEN)
            self.faces.use(0)
            self._over(self.picture, device, "object", values | {"seen": 0}, SEEN)
        else:
            self._behind(self.behind_target, device, values, None)
            self.faces.use(0)
            self._over(self.depth_only, device, "depth", values | {"seen_centre": 0}, SEEN)
            self._see(self.samples, device)
            self.object_target.clear(0.0, 0.0, 0.0, 0.0)
            self.sample_faces.use(0)
            self._over(self.object_target, device, "object", values | {"seen": 0, "step_px": 1 / scale}, SEEN)
            for unit, texture in enumerate((self.object, self.behind)):
                texture.use(unit)
            self.faces.use(8)
            self._over(self.picture, device, "resolve", values | {"object": 0, "behind": 1, "seen_centre": 8}, None)
        ctx.disable_direct(CLIP)
        return self._read()

    def release(self) -> None:
        """Give the memory back."""
        for part in reversed(self._made):
            part.release()

    def _see(self, target: moderngl.Framebuffer, device: SceneOnDevice) -> None:
        """Numbers of the faces that are seen."""
        import moderngl

        target.use()
        target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        context().enable_only(moderngl.DEPTH_TEST)
        context().depth_func = "<"
        device.visible.render(moderngl.TRIANGLES)

    def _behind(self, target: Any, device: SceneOnDevice, values: dict[str, Any], where: str | None) -> None:
        """Sky, and over it the ground: each on its side of the horizon."""
        up = 0.0 if device.height is None else np.sign(device.height - values["eye"][2])
        ground = up * values["world_from_pixel"].T[2]
        margin = 2 * np.abs(ground[:2]).sum()  # a pixel or two of both, else the rounding of edges leaves gaps
        horizon = EVERYWHERE if up == 0 else tuple(margin * np.array([0, 0, 1]) - ground)
        self._over(target, device, "sky", values | {"kept": horizon}, where)
        if up:
            self._over(target, device, "ground", values | {"kept": tuple(ground)}, where)

    def _over(self, target: Any, device: SceneOnDevice, name: str, values: dict[str, Any], where: str | None) -> None:
        import moderngl

        target.use()
        context().enable_only(moderngl.NOTHING if where is None else moderngl.DEPTH_TEST)
        context().depth_func = where or "<"
        device.draw(name, {"kept": EVERYWHERE} | values)

    def _read(self) -> Picture:
        width, height = self.size
        rgba = np.frombuffer(self.picture.read(components=4), np.uint8).reshape(height, width, 4)
        data = self.depth_only.read(components=1, dtype="f4")
        depth = np.frombuffer(data, np.float32).reshape(height, width).copy()
        return Picture(np.ascontiguousarray(rgba[..., :3]), rgba[..., 3] > 127, depth)

    def _own(self, made: Any) -> Any:
        self._made.append(made)
        return made

    def _texture(self, components: int, dtype: str, scale: int = 1) -> Any:
        import moderngl

        size = (self.size[0] * scale, self.size[1] * scale)
        made = self._own(context().texture(size, components, dtype=dtype))
        made.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return made


def _camera_values(shot: Shot) -> dict[str, Any]:
    camera = shot.camera
    rays = camera.R.T @ np.linalg.inv(camera.K)
    values = {"world_from_pixel": rays.T, "eye": camera.centre, "forward": camera.direction}
    return values | {"place": tuple(map(float, shot.place))}
