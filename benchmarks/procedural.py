"""How varied the procedural objects are, and how much of a folder of real meshes they cover; what an object costs.

    python -m benchmarks.procedural                # 400 objects and as many of ../shared/data/meshes_unlabelled
    python -m benchmarks.procedural --meshes FOLDER --count 100

Prints JSON lines. Shapes are compared by three descriptors that need no training: "d2", the distribution of distances
between random surface points over their mean (Osada et al. 2002; distance: earth mover's); "extents", the sorted sides
of the box along the axes (sum of differences of logarithms); "normals", how much surface looks along which axis (area
over the two larger absolute components of the normal, axes sorted by extent; half the sum of differences). "all" adds
the three, each over the mean distance of a real mesh to its nearest real neighbour.

For each: `nearest_in_real` and `nearest_in_procedural`, mean distance to the nearest other object of the same set;
`real_to_procedural`, mean distance of a real mesh to the nearest procedural one; `covered`, share of the real meshes
whose nearest procedural object is no farther than the 90th percentile of real meshes' nearest real neighbours;
`matched`, share of the real meshes that are nearest to some procedural object (coverage of Achlioptas et al. 2018), and
`matched_by_real`, the same for one half of the real meshes by the other (a scale for it).
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dope.common import seeds
from pipeline.geometry import Floats
from pipeline.render.procedural import procedural_object
from pipeline.solids.mesh import Mesh, area_vectors

POINTS, PAIRS = 2048, 20_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", type=Path, default=Path("../shared/data/meshes_unlabelled"))
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    paths = sorted(args.meshes.glob("*.glb"))
    if len(paths) < 2:
        parser.error(f"{args.meshes}: no GLB files to compare with; --meshes names another folder")

    procedural_object(0, args.seed)  # imports are not counted
    times, meshes = [], []
    for number in range(args.count):
        start = time.process_time()
        model = procedural_object(number, args.seed)
        times.append(1e3 * (time.process_time() - start))
        starts = np.cumsum([0, *(len(part.vertices) for part in model.parts)])
        faces = [part.faces + first for part, first in zip(model.parts, starts, strict=False)]
        meshes.append(Mesh(model.vertices(), np.concatenate(faces)))
    n_faces = [len(mesh.faces) for mesh in meshes]
    cost = {f"cpu_ms_{q}": round(float(np.percentile(times, q)), 1) for q in (50, 95, 100)}
    about = {"faces_median": int(np.median(n_faces)), "faces_most": max(n_faces)}
    print(
        json.dumps(
            {"part": "generate", "objects": args.count, "cpu_ms_mean": round(float(np.mean(times)), 1), **cost, **about}
        )
    )

    chosen = seeds.generator("benchmark", args.seed).permutation(len(paths))[: args.count]
    real = [mesh for mesh in (read(paths[i]) for i in chosen) if mesh is not None]
    compare([describe(mesh, k) for k, mesh in enumerate(real)], [describe(mesh, k) for k, mesh in enumerate(meshes)])


def read(path: Path) -> Mesh | None:
    """A glTF mesh with z up, or None where it has no surface."""
    import trimesh

    found = trimesh.load(path, force="mesh")
    mesh = Mesh(np.asarray(found.vertices, float)[:, [0, 2, 1]] * (1, -1, 1), np.asarray(found.faces, np.int64))
    return mesh if len(mesh.faces) and np.abs(area_vectors(mesh)).sum() > 0 else None


def describe(mesh: Mesh, number: int) -> dict[str, Floats]:
    """The descriptors of a mesh."""
    rng = seeds.generator("describe", number)
    areas = area_vectors(mesh)
    size = np.linalg.norm(areas, axis=1)
    face = rng.choice(len(size), POINTS, p=size / size.sum())
    u, v = rng.random((2, POINTS, 1))
    a, b, c = mesh.vertices[mesh.faces[face].T]
    points = a + np.where(u + v > 1, 1 - u, u) * (b - a) + np.where(u + v > 1, 1 - v, v) * (c - a)
    one, two = rng.integers(0, POINTS, (2, PAIRS))
    distance = np.linalg.norm(points[one] - points[two], axis=1)
    d2 = np.histogram(np.minimum(distance / distance.mean(), 2.999), 48, (0, 3))[0] / PAIRS
    extents = np.ptp(mesh.vertices, axis=0)
    order = np.argsort(-extents)
    sides = np.maximum(extents[order] / extents.max(), 0.01)
    n = np.abs(areas[:, order]) / np.maximum(size[:, None], 1e-300)
    bins = np.histogram2d(n[:, 0], n[:, 1], 6, ((0, 1.0001), (0, 1.0001)), weights=size)[0].ravel() / size.sum()
    return {"d2": np.cumsum(d2) * 3 / 48, "extents": np.log(sides), "normals": 0.5 * bins}


def compare(real: list[dict[str, Floats]], made: list[dict[str, Floats]]) -> None:
    """Print a line for each descriptor."""
    names = ["d2", "extents", "normals"]
    total = [np.zeros((len(a), len(b))) for a, b in ((real, real), (made, made), (real, made))]
    for name in [*names, "all"]:
        if name == "all":
            within_real, within_made, between = total
        else:
            within_real, within_made = distances(real, real, name), distances(made, made, name)
            between = distances(real, made, name)
            scale = nearest(within_real).mean()
            total = [sums + more / scale for sums, more in zip(total, (within_real, within_made, between), strict=True)]
        to_real = nearest(within_real)
        half = len(real) // 2
        row = {
            "nearest_in_real": to_real.mean(),
            "nearest_in_procedural": nearest(within_made).mean(),
            "real_to_procedural": between.min(1).mean(),
            "covered": (between.min(1) <= np.percentile(to_real, 90)).mean(),
            "matched": len(np.unique(between.argmin(0))) / len(real),
            "matched_by_real": len(np.unique(within_real[:half, half:].argmin(0))) / half,
        }
        rounded = {key: round(float(value), 4) for key, value in row.items()}
        print(
            json.dumps({"part": "variety", "descriptor": name, "real": len(real), "procedural": len(made), **rounded})
        )


def distances(a: list[dict[str, Floats]], b: list[dict[str, Floats]], name: str) -> Floats:
    """(len(a), len(b)) sums of absolute differences of a descriptor."""
    left, right = np.stack([item[name] for item in a]), np.stack([item[name] for item in b])
    return np.stack([np.abs(row - right).sum(1) for row in left])


def nearest(within: Floats) -> NDArray[np.float64]:
    """Distance of each object to the nearest other one."""
    return np.asarray((within + np.diag(np.full(len(within), np.inf))).min(1), np.float64)


if __name__ == "__main__":
    main()
