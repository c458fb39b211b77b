"""Tiny videos, photos and broken files for the tests of the input side."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np

cv2.setNumThreads(1)


def texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Blobs of several sizes, BGR, so that a shift of a few pixels changes every part of the picture."""
    rng = np.random.default_rng(seed)
    picture = np.zeros((height, width, 3), np.float32)
    for cell in (40, 16, 6):
        small = rng.uniform(-1, 1, (height // cell + 2, width // cell + 2, 3)).astype(np.float32)
        picture += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 50 * picture, 0, 255).astype(np.uint8)


def pan(n: int, width: int = 192, height: int = 128, step: int = 6, seed: int = 0) -> list[np.ndarray]:
    """A camera that moves over a texture by `step` px a frame."""
    wide = texture(height, width + n * step, seed)
    return [np.ascontiguousarray(wide[:, i * step : i * step + width]) for i in range(n)]


def write_video(path: Path, frames: list[np.ndarray], fps: float = 25.0) -> Path:
    code = {".mp4": "mp4v", ".mov": "mp4v", ".avi": "MJPG", ".mkv": "mp4v", ".webm": "VP80"}[path.suffix.lower()]
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), fps, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def write_photos(folder: Path, frames: list[np.ndarray], name: str = "IMG_{:04d}.jpg") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / name.format(i)), frame, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return folder


def with_rotation(data: bytes, quarter_turns: int, width: int, height: int) -> bytes:
    """An MP4 whose track header (tkhd) says: turn clockwise by so many quarters, as phones write it."""
    one = 0x10000
    matrix = {1: (0, one, 0, -one, 0, 0, height * one, 0), 2: (-one, 0, 0, 0, -one, 0, width * one, height * one)}
    matrix[3] = (0, -one, 0, one, 0, 0, 0, width * one)
    start = data.index(b"tkhd") + 4 + 40
    return data[:start] + struct.pack(">9i", *matrix[quarter_turns], 0x40000000) + data[start + 36 :]


def index_first(data: bytes) -> bytes:
    """An MP4 with its index (moov) before the frames, as streamed videos have it, so that a cut leaves it readable."""
    boxes, position = {}, 0
    while position < len(data):
        size, kind = struct.unpack(">I4s", data[position : position + 8])
        boxes[kind] = data[position : position + size]
        position += size
    moov = boxes[b"moov"]
    start = moov.index(b"stco") + 8
    (count,) = struct.unpack_from(">I", moov, start)
    offsets = struct.unpack_from(f">{count}I", moov, start + 4)
    moved = struct.pack(f">{count}I", *(offset + len(moov) for offset in offsets))
    moov = moov[: start + 4] + moved + moov[start + 4 + 4 * count :]
    return boxes[b"ftyp"] + moov + b"".join(box for kind, box in boxes.items() if kind not in (b"ftyp", b"moov"))


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    """A JPEG with an EXIF orientation, as phones write it."""
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    segment = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def encode(image: np.ndarray, suffix: str = ".jpg") -> bytes:
    ok, data = cv2.imencode(suffix, image)
    assert ok
    return data.tobytes()
