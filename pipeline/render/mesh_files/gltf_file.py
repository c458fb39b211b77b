"""What a glTF 2.0 file holds, GLB or JSON with files beside it: its JSON, buffers, accessors and pictures.

Source: the glTF 2.0 specification, sections 3.6 (buffers, accessors, sparse ones), 3.8.3 (images), 4 (GLB).
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.geometry import Floats
from pipeline.render.mesh_files.beside import decode_texture, read_beside
from pipeline.render.mesh_files.text import damaged

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
COMPRESSED = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
    "KHR_texture_basisu": "Basis Universal textures",
}
READ = frozenset({"KHR_texture_transform", "KHR_mesh_quantization", "EXT_texture_webp", "KHR_lights_punctual"})
"""Extensions that a file may require, besides those of materials: the others would change the shape."""
MOST_ZEROS = 1 << 22
"""Elements of an accessor without bytes, which stands for zeros."""
GLB_JSON, GLB_BINARY = 0x4E4F534A, 0x004E4942

Json = dict[str, Any]


class GltfFile:
    """An open glTF file. Whatever it lacks, or refers to and may not, is a `BadInput` that names it."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path = path
        self.binary: bytes | None = None
        self.json = self._parse(data)
        self._buffers: dict[int, bytes] = {}
        self._pictures: dict[int, NDArray[np.uint8]] = {}
        self._require_readable()

    def _parse(self, data: bytes) -> Json:
        text = data
        if data[:4] == b"glTF":
            if len(data) < 20:
                raise damaged(self.path, "shorter than the head of a GLB file")
            version, length = struct.unpack_from("<II", data, 4)
            if version != 2:
                raise BadInput(f"is glTF {version}; only 2 is read", where=self.path, remedy="Convert it to glTF 2.0")
            if length > len(data):
                raise damaged(self.path, f"claims {length} bytes, has {len(data)}")
            at, text = 12, b""
            while at + 8 <= length:
                size, kind = struct.unpack_from("<II", data, at)
                if at + 8 + size > length:
                    raise damaged(self.path, "a chunk is not whole")
                chunk = data[at + 8 : at + 8 + size]
                if kind == GLB_JSON and not text:
                    text = chunk.rstrip(b"\0")  # spaces would be right
                elif kind == GLB_BINARY and self.binary is None:
                    self.binary = chunk
                at += 8 + size
        try:
            value = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise damaged(self.path, f"its JSON: {error}") from None
        if not isinstance(value, dict):
            raise damaged(self.path, "its JSON is no object")
        version_text = str(value.get("asset", {}).get("version", "")) if isinstance(value.get("asset"), dict) else ""
        if not version_text.startswith("2"):
            raise BadInput("is no glTF 2.0 file", where=self.path, remedy="Convert it to glTF 2.0")
        return value

    def _require_readable(self) -> None:
        required = self.json.get("extensionsRequired", [])
        for name in required if isinstance(required, list) else []:
            if name in COMPRESSED:
                raise self.compressed(name)
            if name not in READ and not str(name).startswith("KHR_materials_"):
                what = f"needs the glTF extension {str(name)[:60]}, which is not read"
                raise BadInput(what, where=self.path, remedy="Export it without")

    def compressed(self, extension: str) -> BadInput:
        """The error of a file that is compressed by an extension."""
        what = f"is compressed with {COMPRESSED[extension]} ({extension})"
        return BadInput(what, where=self.path, remedy="Export it without compression")

    def item(self, kind: str, index: Any) -> Json:
        """Entry `index` of the list `kind` of the file."""
        entries = self.json.get(kind)
        if not isinstance(entries, list) or type(index) is not int or not 0 <= index < len(entries):
            raise damaged(self.path, f"there is no {kind}[{index!s:.20}]")
        if not isinstance(entries[index], dict):
            raise damaged(self.path, f"{kind}[{index}] is no object")
        return entries[index]

    def count(self, accessor: int) -> int:
        """Elements that an accessor claims."""
        return self.whole(self.item("accessors", accessor).get("count", 0))

    def whole(self, value: Any) -> int:
        """A number that must be whole and not negative."""
        if type(value) is not int or value < 0:
            raise damaged(self.path, f"{value!s:.20} is no number of bytes or elements")
        return value

    def buffer(self, index: Any) -> bytes:
        """The bytes of a buffer: in the file, in a data URI, or in a file beside it."""
        buffer = self.item("buffers", index)
        if index not in self._buffers:
            uri = buffer.get("uri")
            if uri is None:
                if index != 0 or self.binary is None:
                    raise damaged(self.path, f"buffers[{index}] is not there")
                self._buffers[index] = self.binary
            else:
                self._buffers[index] = self.uri(uri, "buffer")
        return self._buffers[index]

    def uri(self, uri: Any, kind: str) -> bytes:
        """What a URI stands for: data in it, or a file in the mesh's folder."""
        if not isinstance(uri, str):
            raise damaged(self.path, f"a URI of a {kind} is no text")
        if not uri.startswith("data:"):
            return read_beside(self.path, unquote(uri), kind)
        head, comma, body = uri.partition(",")
        if not comma or not head.endswith(";base64"):
            raise damaged(self.path, f"a data URI of a {kind} is not base64")
        try:
            return base64.b64decode(body, validate=True)
        except (binascii.Error, ValueError):
            raise damaged(self.path, f"a data URI of a {kind} is not base64") from None

    def view(self, index: Any) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride (0 = tightly packed)."""
        view = self.item("bufferViews", index)
        for extension in COMPRESSED.keys() & _object(view.get("extensions")).keys():
            raise self.compressed(extension)
        data = self.buffer(view.get("buffer"))
        start, size = self.whole(view.get("byteOffset", 0)), self.whole(view.get("byteLength", 0))
        if start + size > len(data):
            raise damaged(self.path, f"bufferViews[{index}] ends after its buffer")
        return memoryview(data)[start : start + size], self.whole(view.get("byteStride", 0))

    def accessor(self, index: Any) -> NDArray[Any]:
        """(count, components) of an accessor in the type it has; normalised integers become floats."""
        accessor = self.item("accessors", index)
        dtype, width = COMPONENTS.get(accessor.get("componentType", 0)), WIDTHS.get(str(accessor.get("type")))
        if dtype is None or width is None:
            raise damaged(self.path, f"accessors[{index}] is of an unknown type")
        count = self.whole(accessor.get("count", 0))
        if "bufferView" in accessor:
            offset = self.whole(accessor.get("byteOffset", 0))
            values = self._strided(accessor["bufferView"], offset, dtype, count, width)
        elif count <= MOST_ZEROS:
            values = np.zeros((count, width), dtype)
        else:
            raise damaged(self.path, f"an accessor claims {count!s:.20} elements without holding any")
        if isinstance(sparse := accessor.get("sparse"), dict):
            values = self._with_sparse(values, sparse, dtype)
        if accessor.get("normalized") is True and dtype[1] != "f":
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def _strided(self, view: Any, offset: int, dtype: str, count: int, width: int) -> NDArray[Any]:
        data, stride = self.view(view)
        size = np.dtype(dtype).itemsize * width
        stride = stride or size
        if stride < size or (count and offset + (count - 1) * stride + size > len(data)):
            raise damaged(self.path, f"an accessor claims {count!s:.20} elements, its bufferView holds fewer")
        return np.ndarray((count, width), dtype, data, offset, (stride, np.dtype(dtype).itemsize))

    def _with_sparse(self, values: NDArray[Any], sparse: Json, dtype: str) -> NDArray[Any]:
        count = self.whole(sparse.get("count", 0))
        where, what = _object(sparse.get("indices")), _object(sparse.get("values"))
        index_type = COMPONENTS.get(where.get("componentType", 0), "")
        if index_type[1:2] != "u":
            raise damaged(self.path, "the indices of a sparse accessor are of an unknown type")
        offsets = [self.whole(each.get("byteOffset", 0)) for each in (where, what)]
        indices = self._strided(where.get("bufferView"), offsets[0], index_type, count, 1)[:, 0].astype(np.int64)
        if count and int(indices.max()) >= len(values):
            raise damaged(self.path, "a sparse accessor is longer than its accessor")
        values = values.copy()
        values[indices] = self._strided(what.get("bufferView"), offsets[1], dtype, count, values.shape[1])
        return values

    def floats(self, index: Any, width: int) -> Floats:
        """(count, `width`) of an accessor, further components left out."""
        values = self.accessor(index)
        if values.shape[1] < width:
            raise damaged(self.path, f"accessors[{index}] has {values.shape[1]} components")
        return np.ascontiguousarray(values[:, :width], dtype=np.float64)

    def picture(self, texture: Any) -> NDArray[np.uint8]:
        """(H, W, 3) of `textures[texture]`."""
        entry = self.item("textures", texture)
        extensions = _object(entry.get("extensions"))
        index = _object(extensions.get("EXT_texture_webp")).get("source", entry.get("source"))
        if index is None and "KHR_texture_basisu" in extensions:
            raise self.compressed("KHR_texture_basisu")
        image = self.item("images", index)
        assert isinstance(index, int)
        if index not in self._pictures:
            if "uri" in image:
                name = str(image["uri"]) if not str(image["uri"]).startswith("data:") else f"images[{index}]"
                data = self.uri(image["uri"], "texture")
            else:
                name, data = f"images[{index}]", bytes(self.view(image.get("bufferView"))[0])
            self._pictures[index] = decode_texture(data, self.path, name)
        return self._pictures[index]


def _object(value: Any) -> Json:
    return value if isinstance(value, dict) else {}
