"""Files that a mesh refers to (materials, textures, buffers): those of its own folder, and no others."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.inputs.image_size import refuse_huge

LARGEST_TEXTURE = 1024
"""Longest side of a texture in pixels; larger ones are shrunk: an image of 224 pixels shows no more."""


def home(mesh: Path) -> Path:
    """The folder that a mesh may refer into: its own; in ShapeNetCore v2 the one that holds `images` and `models`."""
    folder = mesh.absolute().parent
    return folder.parent if folder.name == "models" and mesh.stem == "model_normalized" else folder


def beside(mesh: Path, name: str) -> Path:
    """Where the file lies that a mesh names; it need not exist.

    Raises:
        BadInput: a URL, an absolute path, or one that leads out of the mesh's folder, also by a link.
    """
    name = name.replace("\\", "/")
    path = mesh.absolute().parent / name
    try:
        inside = path.resolve().is_relative_to(home(mesh).resolve())
    except (OSError, RuntimeError, ValueError):  # links in a circle, a zero byte
        inside = False
    if not inside or name.startswith("/") or re.match(r"[A-Za-z][\w+.-]*:", name):
        what = f"refers to {name[:120]!r}, outside its folder"
        raise BadInput(what, where=mesh, remedy="Put the file into the mesh's folder and let the mesh name it there")
    return path


def read_beside(mesh: Path, name: str, kind: str) -> bytes:
    """The bytes of a file that a mesh names; `kind` says what it is. Raises `BadInput` where it is absent."""
    path = beside(mesh, name)
    try:
        if not path.is_file():
            raise BadInput(
                f"its {kind} {name[:120]!r} is missing",
                where=mesh,
                remedy="Put it where the mesh names it, or remove the reference to it",
            )
        return path.read_bytes()
    except OSError as error:
        raise BadInput(f"its {kind} {name[:120]!r} cannot be read ({error.strerror})", where=mesh) from error


def decode_texture(data: bytes, mesh: Path, name: str) -> NDArray[np.uint8]:
    """(H, W, 3) RGB of an encoded picture, first row at the top, at most `LARGEST_TEXTURE` long; alpha is left out."""
    try:
        refuse_huge(data)
    except BadInput as error:
        raise BadInput(f"its texture {name[:120]!r} {error.what}", where=mesh, remedy=error.remedy) from None
    image = None
    if data:
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error:
            image = None
    if image is None:
        what = f"its texture {name[:120]!r} cannot be decoded"
        raise BadInput(what, where=mesh, remedy="Write it again as PNG or JPEG")
    height, width = image.shape[:2]
    scale = LARGEST_TEXTURE / max(height, width)
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image[..., ::-1])
