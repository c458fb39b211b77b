"""What objects stand on: materials that are made here, and materials in a folder. All wrap around without a seam."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.inputs.photos import PHOTO_SUFFIXES, decode
from pipeline.render.floors import COUNT, SIZE, floor
from pipeline.render.scene import Ground

CACHE = 64  # materials of 1 to 2 MB
FILE_SIDE = 2.0
"""Length of the world that one period of a picture of a file covers."""
FILE_BUMPS = 0.02
"""Height of the world that black to white of a height map of a file covers."""
MAX_SIDE = 1024
ROLES = {
    "albedo": ("color", "colour", "albedo", "basecolor", "diffuse", "diff", "col"),
    "bumps": ("displacement", "disp", "height", "bump"),
    "roughness": ("roughness", "rough"),
}
"""Words of file names, as ambientCG (Wood051_1K-JPG_Color.jpg) and Poly Haven (brown_planks_diff_1k.jpg) have them."""


@dataclass(frozen=True)
class Material:
    """How a plane looks. Arrays are not to be written to.

    Attributes:
        albedo: (S, S', 3) uint8 sRGB, wraps around.
        bumps: (S, S') float32 heights in units of length, or None.
        roughness: of the whole plane, 0 = mirror, 1 = matt.
        side: length of the world that one period of the picture covers.
    """

    albedo: NDArray[np.uint8]
    bumps: NDArray[np.float32] | None = None
    roughness: float = 0.8
    side: float = 2.0

    def at(self, height: float) -> Ground:
        """The plane z = height of this material."""
        return Ground(height, self.albedo, self.bumps, self.roughness, self.side)


def ground_material(number: int) -> Material:
    """The procedural material of a number (0 ... COUNT - 1; others take part modulo COUNT), SIZE pixels square."""
    return _ground_material(number % COUNT)


@lru_cache(maxsize=CACHE)
def _ground_material(number: int) -> Material:
    made = floor(number)
    return _frozen(Material(made.albedo, made.bumps, made.roughness, made.side))


def find_materials(folder: Path) -> list[Path]:
    """The materials of a folder, sorted: every picture in it, and every folder in it that holds a picture of an albedo.

    A folder that is a material itself, by the names of its files, gives itself.

    Raises:
        BadInput: there is no such folder, or it holds none.
    """
    remedy = "--set look.materials= takes a folder of pictures, or of folders with files like *_Color.jpg, *_Height.png"
    if not folder.is_dir():
        raise BadInput("is no folder of materials", where=folder, remedy=remedy)
    pictures = _pictures(folder)
    roles = {_role(path) for path in pictures}
    if "albedo" in roles and len(roles - {None}) > 1 and sum(_role(path) == "albedo" for path in pictures) == 1:
        return [folder]
    inner = [path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    found = [path for path in pictures if _role(path) not in ("bumps", "roughness")]
    found += [path for path in inner if _albedo_of(path) is not None]
    if not found:
        raise BadInput("holds no material", where=folder, remedy=remedy)
    return sorted(found)


def read_material(path: Path) -> Material:
    """A material of a picture or of a folder of pictures; see `find_materials`.

    Pictures are shrunk to at most 1024 px a side. Height maps count as FILE_BUMPS from black to white; of a roughness
    map the mean is taken.

    Raises:
        BadInput: a file cannot be read or is no picture.
    """
    files = sorted(path.iterdir()) if path.is_dir() else [path] if path.exists() else []
    return _read_material(path, tuple(file.stat().st_mtime_ns for file in files))


@lru_cache(maxsize=CACHE)
def _read_material(path: Path, changed: tuple[int, ...]) -> Material:
    if not path.is_dir():
        return _frozen(Material(_picture(path), side=FILE_SIDE))
    source = _albedo_of(path)
    if source is None:
        raise BadInput("holds no picture of a colour", where=path, remedy="Name it *_Color, *_diff or *_albedo")
    albedo = _picture(source)
    others = {role: next((file for file in _pictures(path) if _role(file) == role), None) for role in ROLES}
    bumps, roughness = None, Material.roughness
    if others["bumps"] is not None:
        height = cv2.resize(_grey(others["bumps"]), albedo.shape[1::-1], interpolation=cv2.INTER_AREA)
        bumps = ((height - height.mean()) * FILE_BUMPS).astype(np.float32)
    if others["roughness"] is not None:
        roughness = float(_grey(others["roughness"]).mean())
    return _frozen(Material(albedo, bumps, roughness, FILE_SIDE))


def _pictures(folder: Path) -> list[Path]:
    paths = (path for path in folder.iterdir() if path.suffix.lower() in PHOTO_SUFFIXES)
    return sorted(path for path in paths if path.is_file() and not path.name.startswith("."))


def _albedo_of(folder: Path) -> Path | None:
    pictures = _pictures(folder)
    named = [path for path in pictures if _role(path) == "albedo"]
    return named[0] if named else pictures[0] if len(pictures) == 1 else None


def _role(path: Path) -> str | None:
    """Which of a material's pictures a file is by the last word of its name that says so, or None."""
    words = re.split(r"[^a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", path.stem).lower())
    for word in reversed(words):
        for role, names in ROLES.items():
            if word in names:
                return role
    return None


def _decoded(path: Path, flags: int) -> NDArray[Any]:
    try:
        return decode(path.read_bytes(), flags)
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror or error})", where=path) from error
    except BadInput as error:
        raise BadInput(error.what, where=path, remedy=error.remedy) from error


def _shrunk(picture: NDArray[Any]) -> NDArray[Any]:
    scale = min(1.0, MAX_SIDE / max(picture.shape[:2]))
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    return picture if scale == 1 else np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def _picture(path: Path) -> NDArray[np.uint8]:
    return np.ascontiguousarray(_shrunk(_decoded(path, cv2.IMREAD_COLOR))[..., ::-1], np.uint8)


def _grey(path: Path) -> NDArray[np.float32]:
    """A picture's brightness in [0, 1], of 8 or 16 bits."""
    picture = _decoded(path, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
    top = np.iinfo(picture.dtype).max if picture.dtype.kind == "u" else 1.0
    return np.nan_to_num(_shrunk(picture).astype(np.float32) / np.float32(top))


def _frozen(material: Material) -> Material:
    material.albedo.flags.writeable = False
    if material.bumps is not None:
        material.bumps.flags.writeable = False
    return material


__all__ = ["COUNT", "SIZE", "Material", "find_materials", "ground_material", "read_material"]
