"""Light from all around: panoramas that are made here (skies, studios, rooms), and panoramas in a folder.

All are (ROWS, 2 ROWS, 3) float32 linear RGB, laid out as `scene.Light` says and divided by their mean over the sphere.
"""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common import seeds
from dope.common.errors import BadInput
from pipeline.geometry import Floats
from pipeline.render import indoors
from pipeline.render.noise import smooth_step, wrapping_noise

ROWS = 256
COUNT = 48
"""Procedural panoramas that are told apart: half skies of all weathers, half studios and rooms."""
SUFFIXES = frozenset({".hdr", ".exr"})
MAX_PIXELS = 1 << 27
CACHE = 64  # panoramas of 1.5 MB

Panorama = NDArray[np.float32]


def directions_of(rows: int, turn: float = 0.0) -> tuple[Floats, Floats]:
    """Unit directions (rows, 2 rows, 3) and solid angles (rows, 1) of a panorama's pixels, turned about z by `turn`."""
    elevation = np.pi / 2 - (np.arange(rows) + 0.5) * np.pi / rows
    azimuth = (0.5 - (np.arange(2 * rows) + 0.5) / (2 * rows)) * 2 * np.pi + turn
    flat, up = np.cos(elevation)[:, None], np.sin(elevation)[:, None]
    xyz = np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), up)
    return np.stack(xyz, axis=-1), flat * (np.pi / rows) ** 2


def sky(number: int) -> Panorama:
    """The procedural panorama of a number (0 ... COUNT - 1; others take part modulo COUNT). Not to be written to."""
    return _sky(number % COUNT)


@lru_cache(maxsize=CACHE)
def _sky(number: int) -> Panorama:
    rng = seeds.generator("sky", number)
    toward, _ = directions_of(ROWS)
    kind = _KINDS[number % len(_KINDS)]
    made = kind(toward.astype(np.float32), rng)
    return normalised(made)


def find_skies(folder: Path) -> list[Path]:
    """The panoramas (.hdr, .exr) of a folder and of those in it, sorted by path. Hidden files are none.

    Raises:
        BadInput: there is no such folder, or it holds none.
    """
    remedy = "--set look.hdris= takes a folder of equirectangular .hdr or .exr files"
    if not folder.is_dir():
        raise BadInput("is no folder of panoramas", where=folder, remedy=remedy)
    paths = (path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    found = sorted(path for path in paths if path.is_file() and not path.name.startswith("."))
    if not found:
        raise BadInput("holds no panorama", where=folder, remedy=remedy)
    return found


def read_sky(path: Path) -> Panorama:
    """A panorama of a file, resized to ROWS rows by area. Not to be written to.

    Pixels that are no numbers or negative count as black.

    Raises:
        BadInput: the file cannot be read, is not twice as wide as high, or is black; for EXR also where the optional
            OpenEXR is not installed.
    """
    return _read_sky(path, path.stat().st_mtime_ns if path.exists() else 0)


def normalised(panorama: NDArray[Any]) -> Panorama:
    """Cleaned of what is no light and divided by its mean over the sphere. Raises BadInput where it is black."""
    light = np.nan_to_num(np.asarray(panorama, np.float64), nan=0, posinf=0, neginf=0).clip(0, None)
    _, angle = directions_of(len(light))
    mean = float((light.mean(axis=2) * angle).sum() / (angle.sum() * light.shape[1]))
    if mean <= 0:
        raise BadInput("is black")
    out: Panorama = np.ascontiguousarray(light / mean, np.float32)
    out.flags.writeable = False
    return out


# ---- files


@lru_cache(maxsize=CACHE)
def _read_sky(path: Path, changed: int) -> Panorama:
    try:
        if path.stat().st_size > 16 * MAX_PIXELS:
            raise BadInput("is larger than any panorama that is needed")
        pixels = _read_exr(path) if path.suffix.lower() == ".exr" else _read_hdr(path)
        height, width = pixels.shape[:2]
        if abs(width - 2 * height) > 0.02 * width:
            remedy = "An equirectangular panorama is twice as wide as high"
            raise BadInput(f"is no panorama: {width} x {height} pixels", remedy=remedy)
        clean = np.nan_to_num(pixels.astype(np.float32), nan=0, posinf=0, neginf=0).clip(0, None)
        return normalised(cv2.resize(clean, (2 * ROWS, ROWS), interpolation=cv2.INTER_AREA))
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror or error})", where=path) from error
    except BadInput as error:
        raise BadInput(error.what, where=path, remedy=error.remedy) from error


def _read_hdr(path: Path) -> NDArray[np.float32]:
    data = np.frombuffer(path.read_bytes(), np.uint8)
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    except cv2.error as error:
        raise BadInput(f"is no HDR that can be read ({error.err})") from error
    if pixels is None or pixels.ndim != 3 or pixels.dtype != np.float32:
        raise BadInput("is no HDR that can be read")
    return np.asarray(pixels[..., 2::-1], np.float32)


def _read_exr(path: Path) -> NDArray[Any]:
    try:
        import OpenEXR
    except ImportError as error:
        remedy = "Install it with `pip install 'dope-descriptors[exr]'`"
        raise BadInput("reading EXR needs the package OpenEXR", remedy=remedy) from error
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            low, high = (np.asarray(corner, np.int64) for corner in file.header()["dataWindow"])
            if (high < low).any() or int(np.prod(high - low + 1)) > MAX_PIXELS:
                raise BadInput("is empty or claims too many pixels")
        # of damaged data it prints a warning among the rows of --json
        with redirect_stdout(io.StringIO()), OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name.upper(): np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, KeyError, MemoryError) as error:
        raise BadInput(f"is no EXR that can be read ({error})") from error
    names = next((names for names in ("RGB", "YYY") if set(names) <= channels.keys()), None)
    if names is None:
        raise BadInput(f"has no channels R, G, B, but {', '.join(sorted(channels))}")
    return np.stack([channels[name] for name in names], axis=-1)


# ---- skies

_Rng = np.random.Generator
_Plane = NDArray[Any]  # (ROWS, 2 ROWS) or (ROWS, 2 ROWS, 3)


def _mix(a: Any, b: Any, share: Any) -> _Plane:
    return np.asarray(a + (b - a) * np.asarray(share)[..., None], np.float32)


def _outdoors(toward: _Plane, rng: _Rng, sun_deg: float, cover: float, sharp: float) -> _Plane:
    """A sky with its sun at a height, clouds that cover a share of it, and land.

    sharp: how strong the sun is, 1 on a clear day and 0 behind clouds.
    """
    up = toward[..., 2]
    sun = _direction(rng.uniform(0, 2 * np.pi), np.radians(sun_deg))
    near = toward @ sun
    low = float(np.clip(1 - sun_deg / 25, 0, 1))  # how much of a sunset it is
    zenith = _mix(np.array([0.16, 0.34, 0.85]), np.array([0.20, 0.26, 0.52]), low)
    horizon = _mix(np.array([0.72, 0.86, 1.05]), np.array([1.25, 0.72, 0.42]), low)
    height = np.maximum(up, 0) ** rng.uniform(0.42, 0.6)
    light = _mix(horizon, zenith, height)
    warm = np.array([1.0, 0.62, 0.30]) if low > 0.2 else np.array([1.0, 0.95, 0.85])
    glow = np.exp(6 * (near - 1)) * (0.5 + 1.2 * low) + np.exp(60 * (near - 1)) * 1.5
    light = light + (sharp * glow)[..., None] * warm
    clouds, body = _clouds(toward, rng, cover)
    lit = 0.55 + 0.9 * np.maximum(near, 0) ** 3 * (1 - 0.5 * body) + 0.25 * (1 - body)
    colour = _mix(np.array([0.86, 0.89, 0.95]), np.array([1.15, 0.74, 0.55]), low)
    light = _mix(light, lit[..., None] * colour * (1.1 + 0.5 * sharp), clouds)
    disc = smooth_step(np.cos(np.radians(2.2)), np.cos(np.radians(1.4)), near)
    power = sharp * (1500 - 700 * low)
    hue = np.array([1.0, 0.55, 0.22]) if low > 0.5 else warm
    light = light + (disc * power * (1 - 0.85 * clouds))[..., None] * hue
    return _with_land(toward, light, rng, sharp, low)


def _clouds(toward: _Plane, rng: _Rng, cover: float) -> tuple[_Plane, _Plane]:
    """How much of a cloud and how deep in it each direction looks, in [0, 1]; a flat layer, so smaller far away."""
    tile = wrapping_noise(rng, 512, 512, 128, 6, fade=0.55)
    up = np.maximum(toward[..., 2], 0.02)
    scale = 512 / rng.uniform(5, 9)
    x, y = (toward[..., axis] / (up + 0.12) * scale for axis in (0, 1))
    shape: _Plane = cv2.remap(tile, x % 512, y % 512, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    edge = float(np.quantile(tile, 1 - cover)) if cover < 1 else float(tile.min()) - 0.6
    dense = smooth_step(edge - 0.15, edge + 0.55, shape)
    return dense * smooth_step(-0.02, 0.12, toward[..., 2]), smooth_step(edge, edge + 1.8, shape)


def _with_land(toward: _Plane, light: _Plane, rng: _Rng, sharp: float, low: float) -> _Plane:
    """Hills, trees or houses along the horizon, and land below it."""
    rows = len(toward)
    up = np.degrees(np.arcsin(np.clip(toward[..., 2], -1, 1)))
    land = np.array([[0.30, 0.27, 0.20], [0.16, 0.20, 0.10], [0.34, 0.33, 0.31], [0.40, 0.33, 0.23]])[rng.integers(4)]
    shine = (0.5 + 0.9 * sharp) * (1 - 0.55 * low)
    haze = np.asarray(light[int(rows * 0.47)].mean(axis=0))
    for layer in range(3):
        far = 1 - layer / 2.5
        line = wrapping_noise(rng, 16, 2 * rows, (128, 64, 32)[layer], 4 + layer)[8]
        top = (2.2 + 1.6 * line) * rng.uniform(0.6, 1.6)
        colour = land * rng.uniform(0.5, 1.1) * shine
        style = rng.integers(3)
        if layer and style == 1:  # trees
            top = np.maximum(top, 1) + np.abs(wrapping_noise(rng, 16, 2 * rows, 8, 3)[8]) * 2.2
            colour = np.array([0.07, 0.11, 0.045]) * shine * rng.uniform(0.8, 1.6)
        if layer and style == 2:  # houses
            widths = rng.integers(5, 22, 2 * rows // 8)
            which = np.repeat(np.arange(len(widths)), widths)[: 2 * rows]
            which = np.pad(which, (0, 2 * rows - len(which)), mode="edge")
            top = rng.uniform(1, 9, len(widths))[which] * (rng.random(len(widths)) < 0.75)[which]
            tint = np.array([0.45, 0.41, 0.37]) * rng.uniform(0.5, 1.3, (len(widths), 1)) * shine
            face = tint[which]
            windows = ((np.arange(2 * rows)[None] % 4 < 2) & (np.floor(up * 1.6) % 2 == 0))[..., None]
            colour = np.where(windows, 0.55 * face[None], face[None])
        colour = colour * (1 - 0.55 * far) + haze * (0.55 * far)
        light = _mix(light, colour, smooth_step(-0.4, 0.4, (top[None] - up).astype(np.float32)))
    grain = wrapping_noise(rng, rows, 2 * rows, 32, 5)
    below = land * (1 + 0.22 * grain[..., None]) * shine * 0.8
    below = _mix(below, haze * 0.6 + land * shine * 0.4, np.exp(np.minimum(up, 0) / 4).astype(np.float32))
    return _mix(light, below, smooth_step(0.4, -0.4, up.astype(np.float32)))


def _direction(azimuth: float, elevation: float) -> _Plane:
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], np.float32)


def _clear(toward: _Plane, rng: _Rng) -> _Plane:
    return _outdoors(toward, rng, rng.uniform(25, 65), rng.uniform(0.02, 0.2), 1.0)


def _cloudy(toward: _Plane, rng: _Rng) -> _Plane:
    return _outdoors(toward, rng, rng.uniform(25, 65), rng.uniform(0.35, 0.6), rng.uniform(0.4, 0.9))


def _overcast(toward: _Plane, rng: _Rng) -> _Plane:
    return _outdoors(toward, rng, rng.uniform(30, 60), 1.0, rng.uniform(0.0, 0.06))


def _sunset(toward: _Plane, rng: _Rng) -> _Plane:
    return _outdoors(toward, rng, rng.uniform(5, 14), rng.uniform(0.1, 0.5), rng.uniform(0.5, 1.0))


_KINDS = (
    _clear,
    indoors.room,
    _cloudy,
    indoors.studio,
    _sunset,
    indoors.room,
    _overcast,
    indoors.studio,
    _cloudy,
    indoors.room,
    _clear,
    indoors.studio,
)
