"""The rasteriser: OpenGL by moderngl in a standalone EGL context (Mesa's llvmpipe on a CPU, the driver on a GPU)."""

from pipeline.render.fast.renderer import FastRenderer

__all__ = ["FastRenderer"]
