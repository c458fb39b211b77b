"""The process that has Blender: takes requests as JSON lines on stdin and answers each with one line on stdout.

    python worker.py PARENT_PID MEMORY_BYTES

{"do": "scene", "file": NPZ, ...} builds a scene; {"do": "shot", ...} renders one shot of it into an EXR file. The
answer is {"ok": true}, or {"error": TEXT}, with the "number" of the request (0: it is ready). Ends when stdin does, or
when its parent dies.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import signal
import sys
import traceback
from typing import Any


def take_descriptors() -> tuple[Any, Any]:
    """Requests and answers; what Blender or a library prints on stdout goes to stderr from now on."""
    requests, answers = os.fdopen(os.dup(0), "r", encoding="utf-8"), os.fdopen(os.dup(1), "w", encoding="utf-8")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    return requests, answers


def limit_process(parent: int, memory: int) -> None:
    """Die with the parent, leave Ctrl-C to it, and use no more than so many bytes of private memory."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:
            os._exit(1)  # it died before this was asked for
    above = resource.getrlimit(resource.RLIMIT_DATA)[1]  # the parent's, which only root may raise
    memory = memory if above == resource.RLIM_INFINITY else min(memory, above)
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main() -> None:
    requests, answers = take_descriptors()
    limit_process(int(sys.argv[1]), int(sys.argv[2]))

    def answer(number: int, message: dict[str, Any]) -> None:
        answers.write(json.dumps(message | {"number": number}) + "\n")
        answers.flush()

    try:
        import bpy
    except ImportError as error:
        answer(0, {"error": f"no bpy: {error}"})
        os._exit(1)
    import build
    import numpy as np

    answer(0, {"ok": True, "blender": bpy.app.version_string})
    ground: Any = None
    for line in requests:
        request = json.loads(line)
        try:
            if request["do"] == "scene":
                with np.load(request["file"]) as file:
                    ground = build.build(request, dict(file))
            else:
                build.place_shot(bpy.context.scene, request, ground)
                build.render_shot(bpy.context.scene, request["file"])
            answer(request["number"], {"ok": True})
        except Exception as error:
            traceback.print_exc()
            answer(request["number"], {"error": f"{type(error).__name__}: {error}"})
    with contextlib.suppress(Exception):
        sys.stderr.flush()
    os._exit(0)  # Blender's exit handlers have crashed after good work


if __name__ == "__main__":
    main()
