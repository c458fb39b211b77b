from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_media import encode, pan, texture, with_orientation, write_photos

from dope.common.errors import BadInput
from pipeline.inputs.frames import FramesConfig, extract_frames
from pipeline.inputs.image_size import MAX_MEGAPIXELS, claimed_size, refuse_huge
from pipeline.inputs.photos import decode, read_photo
from pipeline.inputs.sources import Source
from pipeline.masks.mask_io import read_mask_values
from pipeline.sequence import Sequence, read_image

HUGE = 60_000


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_bomb(side: int = HUGE) -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0" * 5000)) + chunk(b"IEND", b"")


def jpeg_bomb(gap: bytes = b"") -> bytes:
    data = encode(texture(64, 64))
    frame = next(i for i in range(2, len(data)) if data[i : i + 2] == b"\xff\xc0")
    return data[:frame] + gap + data[frame : frame + 5] + struct.pack(">HH", HUGE, HUGE) + data[frame + 9 :]


def tiff_bomb() -> bytes:
    entries = struct.pack("<HHII", 256, 4, 1, HUGE) + struct.pack("<HHII", 257, 4, 1, HUGE)
    return b"II*\0" + struct.pack("<IH", 8, 2) + entries + struct.pack("<I", 0)


def exr_bomb() -> bytes:
    window = struct.pack("<4i", 0, 0, HUGE - 1, HUGE - 1)
    return b"\x76\x2f\x31\x01\2\0\0\0dataWindow\0box2i\0" + struct.pack("<I", 16) + window


def bmp_bomb() -> bytes:
    data = bytearray(encode(texture(64, 64), ".bmp"))
    data[18:26] = struct.pack("<ii", HUGE, -HUGE)
    return bytes(data)


BOMBS = {
    "png": png_bomb(),
    "jpeg": jpeg_bomb(),
    "jpeg with bytes between its segments": jpeg_bomb(b"\0\0\0"),
    "tiff": tiff_bomb(),
    "exr": exr_bomb(),
    "bmp": bmp_bomb(),
}


@pytest.mark.parametrize("kind", BOMBS)
def test_an_image_that_claims_too_much_is_refused(kind: str) -> None:
    with pytest.raises(BadInput, match="claims 60000x60000 pixels, more than the 200 megapixels"):
        decode(BOMBS[kind], cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".webp"])
@pytest.mark.parametrize("size", [(64, 96), (301, 77)])
def test_the_claimed_size_of_real_files_is_theirs(suffix: str, size: tuple[int, int]) -> None:
    assert claimed_size(encode(texture(*size), suffix)) == size[::-1]


def test_other_ways_to_write_a_header_are_read() -> None:
    image = texture(64, 96)
    assert claimed_size(with_orientation(encode(image), 6)) == (96, 64)
    _, progressive = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    assert claimed_size(progressive.tobytes()) == (96, 64)
    _, lossy = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 50])
    assert claimed_size(lossy.tobytes()) == (96, 64)
    big = b"MM\0+" + struct.pack(">HHQQ", 8, 0, 16, 2)
    big += struct.pack(">HHQQ", 256, 16, 1, 7) + struct.pack(">HHQI4x", 257, 4, 1, 9)
    assert claimed_size(big) == (7, 9)


def test_the_limit_lies_where_it_says() -> None:
    refuse_huge(png_bomb(int((MAX_MEGAPIXELS * 1e6) ** 0.5)))
    with pytest.raises(BadInput):
        refuse_huge(png_bomb(int((MAX_MEGAPIXELS * 1e6) ** 0.5) + 1))


@pytest.mark.parametrize("kind", BOMBS)
def test_headers_that_are_cut_off_anywhere_are_left_to_the_decoder(kind: str) -> None:
    for length in range(min(len(BOMBS[kind]), 200)):
        try:
            refuse_huge(BOMBS[kind][:length])
        except BadInput as error:
            assert "claims" in error.what


def test_every_reader_names_the_file_and_does_not_allocate_it(tmp_path: Path) -> None:
    bomb = tmp_path / "small png, ünï\ncode.png"
    bomb.write_bytes(png_bomb(20_000))  # OpenCV itself would take this one
    for read in (read_image, read_mask_values, lambda path: read_photo(path, 640)):
        with pytest.raises(BadInput, match="claims 20000x20000") as caught:
            read(bomb)
        assert caught.value.where == str(bomb) and caught.value.remedy
    code = (
        "import resource, sys; from pathlib import Path; from pipeline.sequence import read_image\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try: read_image(Path(sys.argv[1]))\n"
        "except Exception as error: print(type(error).__name__)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    out = subprocess.run([sys.executable, "-c", code, str(bomb)], capture_output=True, text=True, check=True).stdout
    name, grown = out.split()
    assert name == "BadInput" and int(grown) < 50_000, "KiB; the image would have taken a gigabyte"


def test_a_bomb_among_photos_is_a_row(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "a", pan(6))
    (folder / "IMG_0099.png").write_bytes(png_bomb())
    sequence = Sequence(tmp_path / "out/a")
    details = extract_frames(Source(folder, "a", "photos"), sequence, FramesConfig())
    assert details["kept"] == 6
    assert sequence.read_frames()[-1].dropped.startswith("claims 60000x60000")  # type: ignore[union-attr]
    assert np.array([frame.dropped is None for frame in sequence.read_frames()]).sum() == 6
