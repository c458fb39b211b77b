"""What the photoreal renderer costs beside a bare render call, and whether its memory stays flat.

    python -m benchmarks.render_cycles --python bpyenv/bin/python

Objects are tori of some 2,000 faces with a texture, on a plane with bumps, under a sky. Each view is rendered twice
in turn: by `CyclesRenderer`, and by bare calls of `bpy.ops.render.render()` with the same settings in a scene that was
built outside the time that counts (benchmarks/bare_cycles.py). Ours has everything in it but the start of the process:
arrays written and read, scene built, pictures converted, on both sides of the pipe. CPU seconds are user and system
time, of all threads. Memory is measured with tiny, cheap pictures and without the renewal of the process.

Prints one JSON line a figure.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from pathlib import Path

import numpy as np

from pipeline.children import Limits
from pipeline.geometry import Camera
from pipeline.render.config import CyclesConfig
from pipeline.render.cycles import process, renderer
from pipeline.render.cycles.exchange import scene_message, shot_message
from pipeline.render.cycles.folders import PrivateFolder
from pipeline.render.cycles.renderer import CyclesRenderer
from pipeline.render.exposure import expose, white_under
from pipeline.render.scene import Ground, Light, Model, Part, Scene, Shot, Surface


def torus(n: int, m: int, thickness: float) -> Part:
    """2nm triangles, with normals and texture coordinates."""
    a, b = np.meshgrid(np.arange(n) / n, np.arange(m) / m, indexing="ij")
    u, v = 2 * np.pi * a.ravel(), 2 * np.pi * b.ravel()
    normals = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], 1)
    middle = np.stack([np.cos(u), np.sin(u), 0 * u], 1) * (0.5 - thickness)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    right, up, both = (i + 1) % n * m + j, i * m + (j + 1) % m, (i + 1) % n * m + (j + 1) % m
    corner = i * m + j
    faces = np.concatenate([np.stack([corner, right, both], 1), np.stack([corner, both, up], 1)])
    texture = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    uv = np.stack([a.ravel(), b.ravel()], 1)
    return Part(middle + thickness * normals, faces, normals=normals, uv=uv, texture=texture)


def scene(number: int, views: int, size: int) -> Scene:
    rng = np.random.default_rng(number)
    part = torus(60, 18, float(rng.uniform(0.1, 0.2)))
    albedo = rng.integers(60, 200, (512, 512, 3), dtype=np.uint8)
    bumps = rng.normal(0, 0.002, (512, 512)).astype(np.float32)
    up = np.sin(np.pi / 2 - (np.arange(256) + 0.5) / 256 * np.pi)
    panorama = np.repeat((1 + up)[:, None, None], 512, 1).repeat(3, 2).astype(np.float32)
    panorama[60:64, 100:104] = 200.0
    shots = []
    for _ in range(views):
        azimuth, zenith, distance = rng.uniform((0, 0.17, 1.75), (6.28, 1.4, 4.0))
        towards = np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
        x = np.cross(-towards, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(-towards, x), -towards])
        f = size * 30 / 36
        K = np.array([[f, 0, size / 2], [0, f, size / 2], [0, 0, 1.0]])
        place = (float(rng.uniform(-10, 10)), float(rng.uniform(-10, 10)))
        shots.append(Shot(Camera(size, size, K, np.zeros(4), R, -R @ towards * distance), place))
    ground = Ground(float(part.vertices[:, 2].min()), albedo, bumps)
    return Scene(Model((part,)), Surface(), ground, Light(panorama), tuple(shots), seed=number)


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_mib(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def pid_of(blender: CyclesRenderer) -> int:
    assert blender._process is not None
    return blender._process._process.pid


def measure_cost(config: CyclesConfig, objects: int, views: int, size: int) -> None:
    folder = PrivateFolder()
    limits = Limits(minutes=60)
    bare = process.BlenderProcess(
        process.find_python(config.python), folder.path, limits, Path(__file__).parent / "bare_cycles.py"
    )
    before = time.process_time()
    blender = CyclesRenderer(config, limits)
    start = cpu_seconds(pid_of(blender)) + time.process_time() - before
    ours, theirs = [], []
    for number in range(objects):
        one = scene(number, views, size)
        deadline = time.monotonic() + 3600
        exposure = expose(white_under(one.light, one.ground), one.ground, one.light.strength)
        bare.ask(
            scene_message(one, exposure, config, limits.threads, folder.path / "scene.npz"),
            deadline,
        )
        spent, spent_bare = 0.0, 0.0
        pictures = blender.render(one)
        for shot in one.shots:  # a view of each in turn: what else the machine does slows both
            begun = cpu_seconds(pid_of(blender)) + time.process_time()
            next(pictures)
            spent += cpu_seconds(pid_of(blender)) + time.process_time() - begun
            spent_bare += bare.ask(shot_message(shot, folder.path / "unused.exr"), deadline)["seconds"]
        ours.append(spent / views)
        theirs.append(spent_bare / views)
    settings = {"samples": config.samples, "denoise": config.denoise, "size": size, "objects": objects, "views": views}
    result = {
        "figure": "cycles_cpu_s_a_view",
        "value": round(statistics.mean(ours), 3),
        "bare": round(statistics.mean(theirs), 3),
        "ratio": round(sum(ours) / sum(theirs), 3),
        "ratios": [round(a / b, 3) for a, b in zip(ours, theirs, strict=True)],
        "start_s": round(start, 2),
        "renderer": blender.version,
        **settings,
    }
    print(json.dumps(result), flush=True)
    blender.close()
    bare.close()
    folder.close()


def measure_memory(config: CyclesConfig, objects: int) -> None:
    renderer.REUSE = objects + 1
    blender = CyclesRenderer(config)
    sizes = []
    for number in range(objects):
        for _ in blender.render(scene(number, 2, 32)):
            pass
        sizes.append(resident_mib(pid_of(blender)))
    result = {
        "figure": "cycles_memory_mib",
        "value": round(max(sizes), 1),
        "after_10": round(sizes[9], 1),
        "after_all": round(sizes[-1], 1),
        "objects": objects,
    }
    print(json.dumps(result), flush=True)
    blender.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", default=None, help="interpreter with bpy; default: $DOPE_BPY_PYTHON, or this one")
    parser.add_argument("--objects", type=int, default=3)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--size", type=int, default=224)
    parser.add_argument("--samples", type=int, default=8)
    parser.add_argument("--memory-objects", type=int, default=200)
    given = parser.parse_args()
    measure_cost(CyclesConfig(samples=given.samples, python=given.python), given.objects, given.views, given.size)
    if given.memory_objects:
        cheap = CyclesConfig(samples=1, denoise=False, bounces=1, python=given.python)
        measure_memory(cheap, max(given.memory_objects, 10))


if __name__ == "__main__":
    main()
