"""One OpenGL context a process, and the programs compiled in it."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from dope.common.errors import DopeError

if TYPE_CHECKING:
    import moderngl

MIN_VERSION = 430  # storage buffers
PACKAGES = "libegl1 libgl1-mesa-dri"


def context() -> moderngl.Context:
    """The process's context, made at the first call. A process forked after that makes its own.

    Mesa's llvmpipe is told to use no threads beside its one: a worker process is one core.

    Raises:
        DopeError: moderngl is not installed, or there is no EGL with OpenGL 4.3.
    """
    return _context(os.getpid())


def program(name: str) -> moderngl.Program:
    """The program `<name>.vert.glsl` + `<name>.frag.glsl` of this folder, compiled at the first call."""
    return _program(os.getpid(), name)


@lru_cache(maxsize=1)
def _context(process: int) -> moderngl.Context:
    try:
        import moderngl
    except ImportError as error:
        remedy = "Install it with `pip install 'dope-descriptors[render]'`"
        raise DopeError("rendering needs the package moderngl", remedy=remedy) from error
    os.environ.setdefault("LP_NUM_THREADS", "1")
    try:
        made = moderngl.create_context(standalone=True, backend="egl", require=MIN_VERSION)
    except Exception as error:  # what it raises is a bare Exception, of many causes
        remedy = f"On Debian: `apt-get install {PACKAGES}`; or render with --renderer cycles"
        raise DopeError(f"no OpenGL {MIN_VERSION / 100:.1f} through EGL ({error})", remedy=remedy) from error
    made.gc_mode = None  # released by hand, at once
    return made


@lru_cache(maxsize=8)
def _program(process: int, name: str) -> moderngl.Program:
    vertex, fragment = (
        Path(__file__).with_name(f"{name}.{stage}.glsl").read_text(encoding="utf-8") for stage in ("vert", "frag")
    )
    return _context(process).program(vertex_shader=vertex, fragment_shader=fragment)
