"""Render calls and nothing else, in Blender's interpreter: what benchmarks/render_cycles.py compares with.

Takes the messages of pipeline/render/cycles on stdin. Answers each shot with the CPU seconds of
`bpy.ops.render.render()` alone, which writes and reads nothing: scene and camera were made outside that time.
"""

import json
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "pipeline/render/cycles/blender"))
answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)

import bpy  # noqa: E402
import build  # noqa: E402
import numpy as np  # noqa: E402


def main() -> None:
    print(json.dumps({"ok": True, "number": 0, "blender": bpy.app.version_string}), file=answers, flush=True)
    ground = None
    for line in sys.stdin:
        request, seconds = json.loads(line), 0.0
        if request["do"] == "scene":
            with np.load(request["file"]) as file:
                ground = build.build(request, dict(file))
        else:
            build.place_shot(bpy.context.scene, request, ground)
            start = time.process_time()
            bpy.ops.render.render()
            seconds = time.process_time() - start
        print(json.dumps({"ok": True, "number": request["number"], "seconds": seconds}), file=answers, flush=True)


if __name__ == "__main__":
    main()
