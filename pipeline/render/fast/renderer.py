"""The fast renderer: what is seen by rasterisation, how it looks by one pass over the pixels.

1. Rasterise the numbers of the faces, at the pixel centres and, with supersampling, at s x s samples a pixel.
2. For every pixel, cut the ray through the sample with the plane of the face that it sees, and shade that point.

With the pinhole camera X_cam = R X + t, K and pixel (x, y) (centres at +0.5), the ray is eye + z d with
eye = -R^T t and d = R^T K^-1 (x, y, 1); as the third coordinate of K^-1 (x, y, 1) is 1, z is the z-depth. On a face
with vertices A, B, C and n = (B - A) x (C - A) it is z = n.(A - eye) / n.d, on the ground z = (height - eye_z) / d_z.
So depth does not depend on how a driver interpolates. Which face a pixel sees does, by what drivers round vertices to
(1/256 pixel).

The image is the mean of s x s samples as a display shows them: tone-mapped, in linear light, before sRGB's curve. So an
edge between bright and dark keeps its place and its steps, which the mean of unbounded radiance would not.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np

from dope.common.errors import BadInput
from pipeline.geometry import Camera, Floats
from pipeline.render.config import FastConfig
from pipeline.render.fast.context import context
from pipeline.render.fast.geometry import Geometry, geometry_of
from pipeline.render.fast.targets import Targets
from pipeline.render.fast.upload import SceneOnDevice
from pipeline.render.scene import RENDERER_VERSIONS, Picture, Scene, Shot

NEAREST = 1e-3
"""Nothing nearer to the camera is seen."""
MAX_FACES = 1 << 24
MAX_SIDE = 16384


class FastRenderer:
    """`Renderer` by OpenGL; see the module. Not for use from several threads.

    Raises:
        DopeError: moderngl is not installed, or there is no EGL with OpenGL 4.3.
    """

    version = f"fast {RENDERER_VERSIONS['fast']}"

    def __init__(self, config: FastConfig | None = None) -> None:
        self.config = config or FastConfig()
        self._targets: dict[tuple[int, int], Targets] = {}
        context()

    def render(self, scene: Scene) -> Iterator[Picture]:
        """A picture for each shot. Raises BadInput for a mesh that is empty or holds numbers that are none."""
        geometry = geometry_of(scene.model)
        if len(geometry.faces) >= MAX_FACES:
            raise BadInput(f"the mesh has {len(geometry.faces)} faces, more than {MAX_FACES - 1}")
        with ExitStack() as stack:
            device = SceneOnDevice(scene, geometry, stack)
            for shot in scene.shots:
                yield self._shoot(shot, device, geometry)

    def close(self) -> None:
        """Give the memory of the targets back. The context stays for the next renderer of the process."""
        for targets in self._targets.values():
            targets.release()
        self._targets.clear()

    def _shoot(self, shot: Shot, device: SceneOnDevice, geometry: Geometry) -> Picture:
        camera, scale = shot.camera, self.config.supersample
        if camera.is_distorted:
            raise BadInput("the renderer takes pinhole cameras only, this one has distortion")
        if max(camera.width, camera.height) * scale > MAX_SIDE:
            raise BadInput(f"images of {camera.width} x {camera.height} with supersample {scale} are too large")
        targets = self._targets.get((camera.width, camera.height))
        if targets is None:
            self.close()  # sizes seldom change
            targets = self._targets[camera.width, camera.height] = Targets(camera.width, camera.height, scale)
        device.make_current()
        return targets.shoot(shot, device, clip_from_world(camera, geometry))


def clip_from_world(camera: Camera, geometry: Geometry) -> Floats:
    """OpenGL's matrix (4, 4) of a camera: pixel (x, y) of K lands on (x, y) of the target, its first row at the top.

    Planes near and far are as tight as the model's box lets them be: depth is sharpest so.
    """
    depths = geometry.corners() @ camera.R[2] + camera.t[2]
    near = max(0.98 * float(depths.min()), NEAREST)
    far = max(1.02 * float(depths.max()), 2 * near)
    P = np.zeros((4, 4))
    P[0, :3] = 2 / camera.width * camera.K[0] - camera.K[2]
    P[1, :3] = 2 / camera.height * camera.K[1] - camera.K[2]
    P[2, 2:] = (far + near) / (far - near), -2 * far * near / (far - near)
    P[3, 2] = 1
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = camera.R, camera.t
    return P @ world
