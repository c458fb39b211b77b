"""Small meshes in every format, written by hand."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

BOX = np.array([[x, y, z] for z in (0, 3) for y in (0, 2) for x in (0, 1)], dtype=np.float64)
"""Corners of a box of 1 x 2 x 3."""
QUADS = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
"""Its faces, counter-clockwise from outside."""
TRIANGLES = np.array([[q[0], q[i], q[i + 1]] for q in QUADS for i in (1, 2)])
AREA = 22.0


def write(path: Path, data: str | bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def lines(rows: Any, before: str = "", after: str = "") -> str:
    return "".join(before + " ".join(f"{value:.17g}" for value in row) + after + "\n" for row in rows)


def off(head: str = "OFF\n8 6 12\n", quads: Any = QUADS) -> str:
    return head + lines(BOX) + lines([[len(quad), *quad] for quad in quads])


def obj(faces: Any = QUADS, vertices: Any = BOX) -> str:
    return lines(vertices, "v ") + lines([[index + 1 for index in face] for face in faces], "f ")


def stl_binary() -> bytes:
    records = (struct.pack("<12f", 0, 0, 0, *BOX[face].ravel()) + b"\0\0" for face in TRIANGLES)
    return bytes(80) + struct.pack("<I", len(TRIANGLES)) + b"".join(records)


def stl_text() -> str:
    facets = (f"facet normal 0 0 0\nouter loop\n{lines(BOX[f], 'vertex ')}endloop\nendfacet\n" for f in TRIANGLES)
    return "solid box\n" + "".join(facets) + "endsolid box\n"


def ply_head(kind: str, *, vertices: int = 8, faces: int = 6, more: str = "", of_face: str = "") -> str:
    return (
        f"ply\nformat {kind} 1.0\n{more}element vertex {vertices}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {faces}\nproperty list uchar int vertex_indices\n{of_face}end_header\n"
    )


def ply_text() -> str:
    return ply_head("ascii") + lines(BOX) + lines([[4, *quad] for quad in QUADS])


def ply_binary(order: str = "<", faces: Any = QUADS) -> bytes:
    kind = "binary_little_endian" if order == "<" else "binary_big_endian"
    body = BOX.astype(order + "f4").tobytes()
    body += b"".join(struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in faces)
    return ply_head(kind, faces=len(faces)).encode() + body


def gltf_json(positions: Any = BOX, indices: Any = TRIANGLES) -> tuple[dict[str, Any], bytes]:
    """A glTF file's JSON and its buffer: one node, one mesh."""
    first = np.asarray(positions, "<f4").tobytes()
    second = np.asarray(indices, "<u2").tobytes()
    value: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(positions), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": np.size(indices), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(first)},
            {"buffer": 0, "byteOffset": len(first), "byteLength": len(second)},
        ],
        "buffers": [{"byteLength": len(first) + len(second)}],
    }
    return value, first + second


def add_accessor(value: dict[str, Any], data: bytes, array: Any, kind: str = "VEC2", component: int = 5126) -> bytes:
    """The buffer with one accessor more; `value` tells of it."""
    raw = np.ascontiguousarray(array).tobytes()
    data += bytes(-len(data) % 4)
    value["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": len(raw)})
    value["accessors"].append(
        {"bufferView": len(value["bufferViews"]) - 1, "componentType": component, "count": len(array), "type": kind}
    )
    value["buffers"][0]["byteLength"] = len(data) + len(raw)
    return data + raw


def glb(value: dict[str, Any], data: bytes) -> bytes:
    text = json.dumps(value).encode()
    text += b" " * (-len(text) % 4)
    data += bytes(-len(data) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def gltf(value: dict[str, Any], data: bytes) -> str:
    value["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return json.dumps(value)


def png(*colours: tuple[int, int, int], size: int = 4) -> bytes:
    """A picture of stripes from left to right, RGB."""
    row = np.repeat(np.array(colours, np.uint8), size, axis=0)
    return bytes(cv2.imencode(".png", np.repeat(row[None], size, axis=0)[..., ::-1])[1])


def every_format() -> dict[str, bytes]:
    """The box in all of them, by suffix (and a word before it where there are several)."""
    texts = {"off": off(), "obj": obj(), "text.stl": stl_text(), "text.ply": ply_text(), "gltf": gltf(*gltf_json())}
    binaries = {"stl": stl_binary(), "ply": ply_binary(), "big.ply": ply_binary(">"), "glb": glb(*gltf_json())}
    return {name: text.encode() for name, text in texts.items()} | binaries
