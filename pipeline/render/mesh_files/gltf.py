"""glTF 2.0: the triangles of a scene with the transforms of its nodes, a part a primitive."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.geometry import Floats
from pipeline.render.mesh_files.gltf_file import GltfFile, Json
from pipeline.render.mesh_files.text import damaged, read, require_faces, require_indices, simplify
from pipeline.render.scene import Part

TRIANGLES, STRIP, FAN = 4, 5, 6
MOST_NODES, DEEPEST = 10_000, 1000
"""That are visited, and one below the other: nodes that share their children spell out far more than a file holds."""
SPARE = 4
"""Most vertices a face of the most faces: triangles use three at most."""


def read_gltf(path: Path, max_faces: int) -> list[Part]:
    """The triangles of a glTF file's scene, still with y up. Skins, morph targets and animations are left at rest.

    Raises:
        BadInput: it is no glTF 2.0, is cut off, is compressed, refers to files outside its folder or to ones that are
            missing, or has too many faces.
    """
    file = GltfFile(path, read(path, max_faces))
    with np.errstate(all="ignore"):  # what is not finite is refused later
        return _read(file, max_faces)


def _read(file: GltfFile, max_faces: int) -> list[Part]:
    try:
        placed = [(primitive, matrix) for mesh, matrix in _placed(file) for primitive in _primitives(file, mesh)]
        require_faces(sum(_claimed(file, primitive) for primitive, _ in placed), max_faces, file.path)
        vertices = sum(file.count(primitive["attributes"]["POSITION"]) for primitive, _ in placed)
        if vertices > SPARE * max_faces:  # one that is used by many nodes counts for each
            what = f"spells out {vertices} vertices, more than {SPARE} a face"
            raise BadInput(what, where=file.path, remedy=simplify(max_faces))
        return [_part(file, primitive, matrix) for primitive, matrix in placed]
    except (TypeError, ValueError, KeyError, AttributeError, IndexError, OverflowError) as error:
        raise damaged(file.path, f"its JSON is not as glTF 2.0 asks ({error})") from error


def _placed(file: GltfFile) -> Iterator[tuple[Json, Floats]]:
    """Meshes of the scene with (4, 4) transforms to the file's world."""
    visited = 0
    stack = [(node, np.eye(4), 0) for node in reversed(_roots(file))]
    while stack:
        index, above, depth = stack.pop()
        node = file.item("nodes", index)
        visited += 1
        if depth > DEEPEST or visited > MOST_NODES:
            raise damaged(file.path, "its nodes run in a circle, or are too many")
        matrix = above @ _matrix(node)
        if "mesh" in node:
            yield file.item("meshes", node["mesh"]), (np.eye(4) if "skin" in node else matrix)
        stack += [(child, matrix, depth + 1) for child in reversed(node.get("children", []))]


def _roots(file: GltfFile) -> list[int]:
    if file.json.get("scenes"):
        return list(file.item("scenes", file.json.get("scene", 0)).get("nodes", []))
    nodes = file.json.get("nodes") or []
    children = {child for node in nodes for child in node.get("children", [])}
    return [index for index in range(len(nodes)) if index not in children]


def _matrix(node: Json) -> Floats:
    """(4, 4) of a node: its matrix (columns first), or translation, rotation (x, y, z, w) and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    length = float(np.sqrt(x * x + y * y + z * z + w * w)) or 1.0
    x, y, z, w = x / length, y / length, z / length, w / length
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64).reshape(3)
    matrix[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64).reshape(3)
    return matrix


def _primitives(file: GltfFile, mesh: Json) -> Iterator[Json]:
    """Those of triangles; points and lines are left out."""
    for primitive in mesh.get("primitives", []):
        if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
            position = file.item("accessors", primitive["attributes"].get("POSITION"))
            if "bufferView" not in position:  # else an uncompressed copy is there
                raise file.compressed("KHR_draco_mesh_compression")
        if primitive.get("mode", TRIANGLES) in (TRIANGLES, STRIP, FAN):
            yield primitive


def _claimed(file: GltfFile, primitive: Json) -> int:
    corners = file.count(primitive["indices"] if "indices" in primitive else primitive["attributes"]["POSITION"])
    return corners // 3 if primitive.get("mode", TRIANGLES) == TRIANGLES else max(corners - 2, 0)


def _part(file: GltfFile, primitive: Json, matrix: Floats) -> Part:
    attributes = primitive["attributes"]
    vertices = file.floats(attributes["POSITION"], 3)
    faces = _faces(file, primitive, len(vertices))
    vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    normals = _attribute(file, attributes, "NORMAL", 3, len(vertices))
    if normals is not None:
        normals = normals @ _cofactors(matrix[:3, :3]).T
    if np.linalg.det(matrix[:3, :3]) < 0:  # a mirror turns the winding round
        faces = faces[:, ::-1].copy()
    colours = _attribute(file, attributes, "COLOR_0", 3, len(vertices))
    texture, colour, uv = _material(file, primitive, len(vertices))
    return Part(
        vertices,
        faces,
        normals,
        uv,
        None if colours is None else _srgb(colours),
        texture,
        colour,
    )


def _cofactors(m: Floats) -> Floats:
    """(3, 3) by which normals turn, with the sign of the determinant: mirrored normals still point outwards."""
    cofactors = np.stack([np.cross(m[1], m[2]), np.cross(m[2], m[0]), np.cross(m[0], m[1])])
    return cofactors * np.sign(np.linalg.det(m))


def _faces(file: GltfFile, primitive: Json, n_vertices: int) -> NDArray[np.int64]:
    if "indices" in primitive:
        flat = file.accessor(primitive["indices"])[:, 0].astype(np.int64)
    else:
        flat = np.arange(n_vertices)
    require_indices(flat, n_vertices, file.path)
    mode = primitive.get("mode", TRIANGLES)
    if mode == TRIANGLES:
        if len(flat) % 3:
            raise damaged(file.path, "the last triangle is not whole")
        return flat.reshape(-1, 3)
    if len(flat) < 3:
        return np.empty((0, 3), np.int64)
    first, second, third = flat[:-2], flat[1:-1], flat[2:]
    if mode == FAN:
        return np.stack([np.full(len(second), flat[0]), second, third], axis=1)
    odd = np.arange(len(first)) % 2 == 1
    return np.stack([first, np.where(odd, third, second), np.where(odd, second, third)], axis=1)


def _attribute(file: GltfFile, attributes: Json, name: str, width: int, count: int) -> Floats | None:
    if name not in attributes:
        return None
    values = file.floats(attributes[name], width)
    if len(values) != count:
        raise damaged(file.path, f"{name} has {len(values)} elements, POSITION {count}")
    return values


def _material(
    file: GltfFile, primitive: Json, n_vertices: int
) -> tuple[NDArray[np.uint8] | None, tuple[float, float, float] | None, Floats | None]:
    """Texture, colour and (V, 2) texture coordinates, their origin at the bottom left; alpha is left out."""
    attributes = primitive["attributes"]
    if "material" not in primitive:
        return None, None, None
    material = file.item("materials", primitive["material"])
    surface, names = material.get("pbrMetallicRoughness", {}), ("baseColorFactor", "baseColorTexture")
    old = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if old is not None:
        surface, names = old, ("diffuseFactor", "diffuseTexture")
    factor = np.array(surface.get(names[0], (1, 1, 1, 1)), np.float64)[:3].reshape(1, 3)
    r, g, b = _srgb(factor)[0].tolist()
    info = surface.get(names[1])
    if info is None:
        said = names[0] in surface  # a material that says nothing is none
        return None, (r, g, b) if said else None, None
    transform: Any = info.get("extensions", {}).get("KHR_texture_transform", {})
    uv = _attribute(file, attributes, f"TEXCOORD_{transform.get('texCoord', info.get('texCoord', 0))}", 2, n_vertices)
    picture = file.picture(info.get("index"))
    if uv is None:
        return None, (r, g, b), None
    scale, turn = np.array(transform.get("scale", (1, 1)), np.float64), float(transform.get("rotation", 0))
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    uv = (uv * scale) @ rotation.T + np.array(transform.get("offset", (0, 0)), np.float64)
    uv[:, 1] = 1 - uv[:, 1]
    return picture, (r, g, b), uv


def _srgb(linear: Floats) -> Floats:
    linear = np.clip(np.nan_to_num(linear), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
