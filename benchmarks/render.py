"""The fast renderer's speed and memory: one JSON line a figure, CPU seconds of one process on one core.

    python -m benchmarks.render --meshes ../shared/data/meshes_labelled --count 40
    python -m benchmarks.render --sheet /tmp/sheet.png --meshes ../shared/data/meshes_unlabelled --count 12

Each object gets one of the procedural grounds and skies, a colour or Voronoi cells, and 20 views of 224 px at distances
of 1.75 to 4 times half its size. `views_per_cpu_second` counts RGB, mask and depth in the memory of the process;
`setup_ms` what a scene costs before its first view (upload, shadows). Programs are compiled and panoramas and floors
made before anything is measured (`first_use_s`). --sheet also writes some of the pictures.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.prep import say
from dope.common import seeds
from pipeline.geometry import Camera
from pipeline.render.config import FastConfig
from pipeline.render.fast import FastRenderer
from pipeline.render.grounds import ground_material
from pipeline.render.scene import Light, Model, Part, Scene, Shot, Surface
from pipeline.render.skies import sky

SIZE, VIEWS, KINDS = 224, 20, 12
SUFFIXES = (".obj", ".glb", ".off", ".ply", ".stl")


def find_meshes(folder: Path, count: int) -> list[Path]:
    """`count` meshes, evenly spread over the sorted paths of a folder."""
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    return [paths[i * len(paths) // count] for i in range(min(count, len(paths)))]


def load(path: Path) -> Part:
    import trimesh

    mesh: Any = trimesh.load(path, force="mesh", process=False)
    vertices = np.asarray(mesh.vertices, np.float64)
    if path.suffix.lower() == ".glb":  # y is up
        vertices = vertices[:, [0, 2, 1]] * [1, -1, 1]
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return Part(0.5 * vertices / np.abs(vertices).max(), np.asarray(mesh.faces, np.int64))


def bumpy_ball(faces: int) -> Part:
    """A closed surface of about as many faces."""
    rings = max(3, round(np.sqrt(faces / 4)))
    polar, around = np.meshgrid(
        np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings + 1), indexing="ij"
    )
    radius = 0.4 + 0.1 * np.sin(5 * polar) * np.cos(4 * around)
    flat = radius * np.sin(polar)
    vertices = np.stack([flat * np.cos(around), flat * np.sin(around), radius * np.cos(polar)], axis=-1).reshape(-1, 3)
    first = (np.arange(rings)[:, None] * (2 * rings + 1) + np.arange(2 * rings)).ravel()
    below = first + 2 * rings + 1
    return Part(
        vertices, np.concatenate([np.stack([first, below, first + 1], 1), np.stack([first + 1, below, below + 1], 1)])
    )


def look_from(azimuth: float, zenith: float, distance: float, target: np.ndarray) -> Camera:
    ahead = -np.array([np.cos(azimuth) * np.sin(zenith), np.sin(azimuth) * np.sin(zenith), np.cos(zenith)])
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(ahead, right), ahead])
    f = SIZE * 30 / 36
    K = np.array([[f, 0, SIZE / 2], [0, f, SIZE / 2], [0, 0, 1]])
    return Camera(SIZE, SIZE, K, np.zeros(4), R, -R @ (target - distance * ahead))


def scene_of(part: Part, number: int, views: int = VIEWS) -> Scene:
    rng = seeds.generator("benchmark", "render", number)
    shots = []
    for _ in range(views):
        angles = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(10, 80))
        camera = look_from(*angles, rng.uniform(1.75, 4) / 2 + 0.6, rng.uniform(-0.1, 0.1, 3))
        shots.append(Shot(camera, tuple(rng.uniform(-10, 10, 2))))
    colours = tuple(tuple(colour) for colour in rng.uniform(0.1, 0.9, (8, 3)))
    kind = ("colour", "voronoi")[number % 2]
    surface = Surface(kind, colours, float(rng.uniform(4, 12)), float(rng.uniform(0.3, 0.9)), number)  # type: ignore[arg-type]
    ground = ground_material(number % KINDS).at(float(part.vertices[:, 2].min()))
    light = Light(sky(number % KINDS), float(rng.uniform(0.4, 0.9)), float(rng.uniform(0, 6.28)))
    return Scene(Model((part,)), surface, ground, light, tuple(shots), number)


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def timed(renderer: FastRenderer, scene: Scene) -> tuple[float, float]:
    """CPU seconds of a scene before its first view, and of a view."""
    start = time.process_time()
    list(renderer.render(Scene(scene.model, scene.surface, scene.ground, scene.light, scene.shots[:1], scene.seed)))
    one = time.process_time()
    list(renderer.render(scene))
    view = (time.process_time() - one - (one - start)) / (len(scene.shots) - 1)
    return one - start - view, view


def measure(scenes: list[Scene], supersample: int) -> Iterator[tuple[float, float]]:
    renderer = FastRenderer(FastConfig(supersample=supersample))
    for number in range(2):  # programs of both kinds of surface
        list(renderer.render(scene_of(bumpy_ball(200), number, 2)))
    for scene in scenes:
        yield timed(renderer, scene)
    renderer.close()


def report(scenes: list[Scene], supersample: int, **more: Any) -> None:
    setup, view = np.array(list(measure(scenes, supersample))).T
    faces = [scene.model.n_faces for scene in scenes]
    say(
        "views_per_cpu_second",
        round(1 / view.mean(), 1),
        supersample=supersample,
        slowest=round(1 / view.max(), 1),
        **more,
    )
    say("setup_ms", round(1e3 * setup.mean(), 1), supersample=supersample, longest=round(1e3 * setup.max(), 1), **more)
    if len(faces) > 1:
        say("faces", int(np.median(faces)), largest=max(faces), objects=len(faces), **more)


def memory(scenes: list[Scene], objects: int) -> None:
    renderer = FastRenderer(FastConfig(supersample=2))
    at = {}
    for number in range(objects):
        scene = scenes[number % len(scenes)]
        list(renderer.render(Scene(scene.model, scene.surface, scene.ground, scene.light, scene.shots[:2], scene.seed)))
        at[number] = resident_mb()
    renderer.close()
    half = objects // 2
    say("resident_mb", round(at[objects - 1], 1), objects=objects, halfway=round(at[half], 1))


def draw(path: Path, scenes: list[Scene]) -> None:
    renderer = FastRenderer(FastConfig())
    rows = [np.hstack([picture.image for picture in renderer.render(scene)][:6]) for scene in scenes]
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.vstack(rows)[..., ::-1])
    renderer.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", type=Path, help="folder of meshes; without it only generated ones")
    parser.add_argument("--count", type=int, default=24, help="meshes of the folder, evenly spread")
    parser.add_argument("--objects", type=int, default=200, help="scenes after which memory is compared")
    parser.add_argument("--sheet", type=Path, help="only draw six views of each mesh into this PNG")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    parts = [load(path) for path in find_meshes(given.meshes, given.count)] if given.meshes else []
    start = time.process_time()
    for number in range(KINDS):
        sky(number), ground_material(number)
    if given.sheet:
        draw(given.sheet, [scene_of(part, number, 6) for number, part in enumerate(parts)])
        return
    renderer = FastRenderer(FastConfig(supersample=2))
    list(renderer.render(scene_of(bumpy_ball(200), 0, 1)))
    renderer.close()
    say("first_use_s", round(time.process_time() - start, 2), panoramas=KINDS, floors=KINDS)
    real = [scene_of(part, number) for number, part in enumerate(parts)]
    for supersample in (1, 2):
        if real:
            report(real, supersample, meshes=str(given.meshes))
        report([scene_of(bumpy_ball(2000), number) for number in range(8)], supersample, generated=2000)
    for faces in (200, 20_000, 200_000, 1_000_000):
        report([scene_of(bumpy_ball(faces), 0, 4)], 1, generated=faces)
    small = real or [scene_of(bumpy_ball(faces), number) for number, faces in enumerate((12, 500, 2000, 9000))]
    memory(small, given.objects)


if __name__ == "__main__":
    main()
