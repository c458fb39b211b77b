"""The photoreal renderer: scenes to pictures by Cycles."""

from __future__ import annotations

import time
import weakref
from collections.abc import Iterator
from typing import Any

from dope.common.errors import BadInput
from pipeline.children import Limits
from pipeline.render.config import CyclesConfig
from pipeline.render.cycles import process
from pipeline.render.cycles.exchange import read_picture, scene_message, shot_message
from pipeline.render.cycles.folders import PrivateFolder
from pipeline.render.exposure import expose, white_under
from pipeline.render.scene import RENDERER_VERSIONS, Picture, Scene

REUSE = 100
"""Objects that a process renders before the next one takes its place."""


class CyclesRenderer:
    """Blender's path tracer in a process of its own (a `Renderer`).

    Views of an object share their scene. The process is ended with this one, after an error, and after `REUSE` objects.

    Args:
        config: samples, denoiser, bounces, and whose Blender.
        limits: minutes for each object; memory and threads of the process.

    Raises:
        DopeError: there is no Blender; it says how to get it.
    """

    def __init__(self, config: CyclesConfig, limits: Limits | None = None) -> None:
        self._config, self._limits = config, limits or Limits(minutes=10.0)
        self._python = process.find_python(config.python)
        self._folder = PrivateFolder()
        self._process: process.BlenderProcess | None = None
        self._objects = self._begun = 0
        self._cleanup = weakref.finalize(self, self._folder.close)
        try:
            blender = self._ready().blender
        except BaseException:
            self.close()
            raise
        self.version = f"cycles {RENDERER_VERSIONS['cycles']}, Blender {blender}"

    def render(self, scene: Scene) -> Iterator[Picture]:
        """A picture for each shot, in order.

        Raises:
            BadInput: Blender could not render it, crashed on it or took too long; the next scene gets a new process.
            DopeError: Blender could not be started.
        """
        folder = self._folder.path
        exposure = expose(white_under(scene.light, scene.ground), scene.ground, scene.light.strength)
        message = scene_message(scene, exposure, self._config, self._limits.threads, folder / "scene.npz")
        requests = [shot_message(shot, folder / "shot.exr") for shot in scene.shots]
        blender = self._ready()
        self._objects += 1
        self._begun = begun = self._begun + 1
        left = self._ask(blender, message, self._limits.minutes * 60)
        (folder / "scene.npz").unlink()
        for shot, request in zip(scene.shots, requests, strict=True):
            if begun != self._begun:
                raise RuntimeError("another scene was begun before this one was done")
            left = self._ask(blender, request, left)
            try:
                picture = read_picture(folder / "shot.exr", shot, exposure)
            except (OSError, ValueError) as error:
                self._end()
                raise BadInput(f"Blender's picture cannot be read: {error}") from None
            (folder / "shot.exr").unlink()  # so that it cannot be taken for the next
            yield picture

    def close(self) -> None:
        """End Blender and remove what it left."""
        self._end()
        self._cleanup()

    def _ready(self) -> process.BlenderProcess:
        if self._process is not None and (self._objects >= REUSE or not self._process.is_alive):
            self._end()
        if self._process is None:
            self._process = process.BlenderProcess(self._python, self._folder.path, self._limits)
            self._objects = 0
        self._process.forget()
        return self._process

    def _ask(self, blender: process.BlenderProcess, message: dict[str, Any], left: float) -> float:
        """Ask, with so many seconds left for the object; returns how many are left then."""
        start = time.monotonic()
        try:
            answer = blender.ask(message, start + left)
        except BaseException:
            self._end()
            raise
        if "error" not in answer:
            return left - (time.monotonic() - start)
        self._end()
        if "MemoryError" in answer["error"]:
            raise BadInput(f"Blender needed more than {self._limits.memory_gib:g} GiB of memory")
        raise BadInput(f"Blender could not render it: {answer['error']}")

    def _end(self) -> None:
        if self._process is not None:
            self._process.close()
            self._process = None
