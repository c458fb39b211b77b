"""One OpenGL context a process, and the programs compiled in it."""

from __future__ import annotations

import os
import re
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dope.common.errors import DopeError
from pipeline.render import exposure
from pipeline.render.fast import light

if TYPE_CHECKING:
    import moderngl

MIN_VERSION = 430  # storage buffers
PACKAGES = "libegl1 libgl1-mesa-dri"
FOLDER = Path(__file__).parent
MAX_COLOURS = 64
CONSTANTS = {
    "KEYS": light.KEYS,
    "KEY_SAMPLES": light.KEY_SAMPLES,
    "DIRECTIONS": light.DIRECTIONS,
    "CASTERS": light.CASTERS,
    "MAX_COLOURS": MAX_COLOURS,
    "SHOULDER": exposure.SHOULDER,
    "FADE": exposure.FADE,
}
"""Macros of every shader."""


def context() -> moderngl.Context:
    """The process's context, made at the first call. A process forked after that makes its own.

    Mesa's llvmpipe is told to use no threads beside its one: a worker process is one core.

    Raises:
        DopeError: moderngl is not installed, or there is no EGL with OpenGL 4.3.
    """
    return _context(os.getpid())


def program(name: str, kind: int = 0) -> moderngl.Program:
    """A program of this folder, compiled at the first call.

    `<name>.frag.glsl` goes with `<name>.vert.glsl`, or where there is none with `screen.vert.glsl`, which covers the
    whole target. `kind` is its macro KIND.
    """
    return _program(os.getpid(), name, kind)


_stock: dict[tuple[object, ...], list[moderngl.Texture]] = {}


def take_texture(width: int, height: int, components: int, dtype: np.dtype[Any]) -> moderngl.Texture:
    """A trilinear, repeating texture with room for all mip levels, of uint8 or float32. Its content is left over."""
    import moderngl

    key = (os.getpid(), width, height, components, {"u": "f1", "f": "f4"}[dtype.kind])
    if _stock.get(key):
        made = _stock[key].pop()
    else:
        made = context().texture((width, height), components, dtype=str(key[-1]), alignment=1)
        made.extra = key
        made.build_mipmaps()
        made.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    made.repeat_x = made.repeat_y = True
    return made


def give_texture(texture: moderngl.Texture) -> None:
    """Put a texture back; of a size that few scenes have it is released."""
    kept = _stock.setdefault(texture.extra, [])
    if len(kept) < 2 and len(_stock) <= 8:
        kept.append(texture)
    else:
        texture.release()


@lru_cache(maxsize=1)
def _context(process: int) -> moderngl.Context:
    try:
        import moderngl
    except ImportError as error:
        remedy = "Install it with `pip install 'dope-descriptors[render]'`"
        raise DopeError("rendering needs the package moderngl", remedy=remedy) from error
    os.environ.setdefault("LP_NUM_THREADS", "1")
    try:
        made: Any = moderngl.create_context(standalone=True, backend="egl", require=MIN_VERSION)  # type: ignore[arg-type]
    except Exception as error:  # what it raises is a bare Exception, of many causes
        remedy = f"On Debian: `apt-get install {PACKAGES}`; or render with --renderer cycles"
        raise DopeError(f"no OpenGL {MIN_VERSION / 100:.1f} through EGL ({error})", remedy=remedy) from error
    made.gc_mode = None  # released by hand, at once
    return made


@cache
def _program(process: int, name: str, kind: int) -> moderngl.Program:
    vertex = f"{name}.vert.glsl" if (FOLDER / f"{name}.vert.glsl").exists() else "screen.vert.glsl"
    return _context(process).program(
        vertex_shader=_source(vertex, kind), fragment_shader=_source(f"{name}.frag.glsl", kind)
    )


def _source(name: str, kind: int) -> str:
    """A shader with its `#include`s and macros."""
    text = (FOLDER / name).read_text(encoding="utf-8")
    text = re.sub(r'#include "(.+)"', lambda found: _source(found[1], kind), text)
    given = "\n".join(f"#define {key} {value}" for key, value in (CONSTANTS | {"KIND": kind}).items())
    return re.sub(r"^#version .*$", rf"\g<0>\n{given}", text, count=1, flags=re.MULTILINE)
