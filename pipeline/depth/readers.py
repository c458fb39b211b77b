"""Depth maps as other tools write them: PNG, TIFF, EXR, NPY, NPZ and COLMAP's dense arrays, read into float32 arrays.

Nothing is trusted: a file that is cut off, of another kind than its name says, or that claims more pixels than any
camera has, is refused before memory is taken for it.
"""

from __future__ import annotations

import io
import lzma
import zipfile
import zlib
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.inputs.photos import decode

MAX_PIXELS = 1 << 27  # 134 megapixels
NPZ_KEYS = ("depth", "arr_0")
EXR_CHANNELS = ("Z", "depth", "depth.Z", "V", "Y", "R")


@dataclass(frozen=True)
class RawDepth:
    """What a file holds, as it stands there.

    Attributes:
        values: (h, w) float32 in the file's own unit; what is not a positive finite number is unknown.
        whole_numbers: the file counts steps (16-bit PNG or TIFF, integer arrays), whose length it does not tell.
    """

    values: NDArray[np.float32]
    whole_numbers: bool


def read_depth_file(path: Path) -> RawDepth:
    """Read a depth map by its suffix: .png .tif .tiff .exr .npy .npz .bin (COLMAP's dense array).

    Raises:
        BadInput: the file cannot be read, is cut off, too large, or holds something else than one depth a pixel; for
            EXR also where the optional OpenEXR is not installed.
    """
    try:
        if path.stat().st_size > 8 * MAX_PIXELS:
            raise BadInput(f"is larger than a depth map of {MAX_PIXELS / 1e6:.0f} megapixels")
        array = READERS[path.suffix.lower()](path)
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror or error})", where=path) from error
    except BadInput as error:
        raise BadInput(error.what, where=path, remedy=error.remedy) from error
    except KeyError:
        known = ", ".join(READERS)
        raise BadInput("is no kind of depth map that is known", where=path, remedy=f"Known are {known}") from None
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[2]):
        array = array.squeeze(axis=2 if array.shape[2] == 1 else 0)
    if array.ndim != 2 or array.dtype.kind not in "fui" or min(array.shape) < 2:
        shape = " x ".join(map(str, array.shape))
        remedy = "One number a pixel is expected: integers or floats of shape (height, width)"
        raise BadInput(f"is no depth map: {shape} values of type {array.dtype}", where=path, remedy=remedy)
    if array.dtype.itemsize == 1:
        remedy = "Write 16-bit PNG or a format with floats; disparity for display is not depth"
        raise BadInput("has 8 bits, too few for depth", where=path, remedy=remedy)
    with np.errstate(over="ignore"):
        return RawDepth(np.ascontiguousarray(array, np.float32), array.dtype.kind != "f")


def read_colmap_array(path: Path) -> NDArray[np.float32]:
    """COLMAP's dense array, (h, w) or (h, w, channels): a text head `width&height&channels&`, then float32 columns.

    Raises:
        BadInput: the head or the size is not that of such a file.
    """
    data = path.read_bytes()
    head = data[:64].split(b"&", 3)
    try:
        width, height, channels = (int(number) for number in head[:3])
        start = sum(len(number) + 1 for number in head[:3])
        if min(width, height, channels) < 1 or 4 * width * height * channels != len(data) - start:
            raise ValueError(f"{len(data) - start} bytes for {width} x {height} x {channels} numbers")
    except ValueError as error:
        raise BadInput(f"is not a depth map of COLMAP ({error})", where=path) from error
    values = np.frombuffer(data, "<f4", offset=start).reshape((width, height, channels), order="F")
    return np.ascontiguousarray(values.transpose(1, 0, 2).squeeze(axis=2) if channels == 1 else values.swapaxes(0, 1))


def _read_picture(path: Path) -> NDArray[Any]:
    return decode(path.read_bytes(), cv2.IMREAD_UNCHANGED)


def _read_npy(path: Path) -> NDArray[Any]:
    with path.open("rb") as file:
        return _read_array(file, path.stat().st_size)


def _read_npz(path: Path) -> NDArray[Any]:
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.removesuffix(".npy"): name for name in archive.namelist()}
            key = next((key for key in NPZ_KEYS if key in names), None)
            if key is None and len(names) == 1:
                key = next(iter(names))
            if key is None:
                remedy = f"The array's name is one of {', '.join(NPZ_KEYS)}, or it is the only one"
                raise BadInput(
                    f"holds no array of depth, but {', '.join(sorted(names)[:5]) or 'nothing'}", remedy=remedy
                )
            with archive.open(names[key]) as member:
                return _read_array(member, archive.getinfo(names[key]).file_size)
    except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, RuntimeError, ValueError, LookupError) as error:
        raise BadInput(f"is no NPZ that can be read ({error})") from error


def _read_array(file: IO[bytes], size: int) -> NDArray[Any]:
    """An array in NumPy's format out of `size` bytes: its head is judged before memory is taken for it."""
    try:
        version = np.lib.format.read_magic(file)
        read_head = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, columns_first, dtype = read_head(file)
        if dtype.hasobject or dtype.itemsize == 0:
            raise BadInput("holds Python objects instead of numbers")
        sides = " x ".join(map(str, shape))
        count = int(np.prod([int(side) for side in shape], dtype=object))
        if not 0 <= count <= MAX_PIXELS or count * dtype.itemsize > size:
            raise BadInput(f"is cut off, or claims too many numbers ({sides})")
        data = file.read(count * dtype.itemsize)
        if len(data) < count * dtype.itemsize:
            raise BadInput(f"is cut off: {len(data)} bytes of {sides} numbers")
        return np.frombuffer(data, dtype, count).reshape(shape, order="F" if columns_first else "C")
    except (ValueError, TypeError, SyntaxError, TokenError, RecursionError, MemoryError) as error:
        raise BadInput(f"is no NumPy array that can be read ({error})") from error


def _read_exr(path: Path) -> NDArray[Any]:
    try:
        import OpenEXR
    except ImportError as error:
        remedy = "Install it with `pip install 'dope-descriptors[exr]'`"
        raise BadInput("reading EXR needs the package OpenEXR", remedy=remedy) from error
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            window, shown = (np.asarray(file.header()[name], np.int64) for name in ("dataWindow", "displayWindow"))
            low, high = window
            if (high < low).any() or int(np.prod(high - low + 1)) > MAX_PIXELS:
                raise BadInput("is empty or claims too many pixels")
            if (window != shown).any():
                raise BadInput("holds a part of its image only (data window), the whole is needed")
        # of damaged data it prints a warning among the rows of --json
        with redirect_stdout(io.StringIO()), OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, KeyError, MemoryError) as error:
        raise BadInput(f"is no EXR that can be read ({error})") from error
    named = {name.casefold(): pixels for name, pixels in channels.items()}
    for wanted in EXR_CHANNELS:
        if wanted.casefold() in named:
            return np.asarray(named[wanted.casefold()])
    if len(channels) == 1:
        return np.asarray(next(iter(channels.values())))
    remedy = f"Depth is the channel {', '.join(EXR_CHANNELS)}, or the only one"
    raise BadInput(f"has no channel of depth, but {', '.join(sorted(channels))}", remedy=remedy)


READERS: dict[str, Callable[[Path], NDArray[Any]]] = {
    ".png": _read_picture,
    ".tif": _read_picture,
    ".tiff": _read_picture,
    ".exr": _read_exr,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".bin": read_colmap_array,
}
