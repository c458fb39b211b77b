"""Stands in for blender/worker.py: answers as it does with a picture made beforehand, and misbehaves when asked to.

What a scene does is in its seed: 0 behaves; see `MISDEEDS`.
"""

import json
import os
import shutil
import signal
import sys
import time
from pathlib import Path

MISDEEDS = (
    "none",
    "crash",
    "leave",
    "hang",
    "garbage",
    "twice",
    "list",
    "no_file",
    "half_file",
    "complain",
    "deaf",
    "other",
)


def main() -> None:
    picture = Path(__file__).with_name("picture.exr")
    print(json.dumps({"ok": True, "number": 0, "blender": "0.0 fake"}), flush=True)
    misdeed = "none"
    for line in sys.stdin:
        request = json.loads(line)
        good = json.dumps({"ok": True, "number": request["number"]})
        if request["do"] == "scene":
            misdeed = MISDEEDS[request["seed"]]
        elif misdeed == "crash":
            print("what the crash was about", file=sys.stderr, flush=True)
            os.kill(os.getpid(), signal.SIGSEGV)
        elif misdeed == "leave":
            sys.exit(3)
        elif misdeed == "hang":
            time.sleep(60)
        elif misdeed == "garbage":
            print("Blender quit", flush=True)
        elif misdeed == "twice":
            shutil.copy(picture, request["file"])
            print(good, flush=True)
        elif misdeed == "list":
            print("[]", flush=True)
        elif misdeed == "half_file":
            Path(request["file"]).write_bytes(picture.read_bytes()[:-100])
        elif misdeed == "complain":
            print(json.dumps({"error": "ValueError: no such thing", "number": request["number"]}), flush=True)
        elif misdeed != "no_file":
            shutil.copy(picture, request["file"])
        if misdeed == "other" and request["do"] == "shot":
            good = json.dumps({"ok": True, "number": request["number"] - 1})
        if misdeed not in ("garbage", "list", "complain") or request["do"] == "scene":
            print(good, flush=True)
        if misdeed == "deaf":
            os.close(1)
            time.sleep(60)


if __name__ == "__main__":
    main()
