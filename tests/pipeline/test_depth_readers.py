"""Files of depth: those that lie are refused by name."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from depth_files import write_exr

from dope.common.errors import BadInput
from pipeline.depth.readers import MAX_PIXELS, read_depth_file


def npz_of(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def npy_head(shape: tuple[int, ...], dtype: str = "<f4") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"shape": shape, "fortran_order": False, "descr": dtype})
    return file.getvalue()


def npz_bomb() -> bytes:
    """A member that claims, and truly is when unpacked, far more than a depth map."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.npy", npy_head((60000, 60000)) + bytes(1 << 20))
    return file.getvalue()


def packed_by(method: int, name: str = "depth.npy") -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        archive.writestr(name, npy_head((6, 8)) + bytes(range(192)))
    return file.getvalue()


def damaged_lzma() -> bytes:
    data = bytearray(packed_by(zipfile.ZIP_LZMA))
    data[60:80] = bytes(20)
    return bytes(data)


GOOD = np.linspace(1, 2, 48, dtype=np.float32).reshape(6, 8)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.npy", b"", "is no NumPy array"),
        ("a.npy", npy_head((6, 8)).replace(b"}", b"{") + bytes(192), "is no NumPy array"),
        ("a.npy", npy_head((60000, 60000)), "claims too many numbers"),
        ("a.npy", npy_head((6, 8)) + bytes(100), "is cut off"),
        ("a.npy", npy_head((-6, -8)) + bytes(192), "."),
        ("a.npy", npy_head((2, 3, 8, 1)) + bytes(192), "is no depth map: 2 x 3 x 8 x 1"),
        ("a.npy", npy_head((6, 8), "<c8") + bytes(384), "is no depth map"),
        ("a.npy", npy_head((6, 8), "|u1") + bytes(48), "8 bits"),
        ("a.npy", npy_head((6, 8), "|O") + bytes(384), "Python objects"),
        ("a.npz", npz_of(depth=GOOD)[:-30], "is no NPZ"),
        ("a.npz", npz_of(rgb=GOOD, other=GOOD), "holds no array of depth, but other, rgb"),
        ("a.npz", damaged_lzma(), "is no NPZ"),
        ("a.npz", packed_by(zipfile.ZIP_STORED, "ä.npy").replace("ä".encode(), b"\xff\xff"), "is no NPZ"),
        ("a.npz", npz_bomb(), "claims too many numbers"),
        ("a.bin", b"60000&60000&1&" + bytes(64), "64 bytes for 60000 x 60000 x 1"),
        ("a.bin", b"8&6&1&" + bytes(4 * 47), "is not a depth map of COLMAP"),
        ("a.bin", b"-8&-6&1&" + bytes(4 * 48), "is not a depth map of COLMAP"),
        ("a.bin", b"\xff\xd8\xff\xe0", "is not a depth map of COLMAP"),
        ("a.png", cv2.imencode(".png", (GOOD * 100).astype(np.uint8))[1].tobytes(), "8 bits"),
        ("a.png", cv2.imencode(".png", np.ones((6, 8, 3), np.uint16))[1].tobytes(), "6 x 8 x 3"),
        ("a.png", cv2.imencode(".png", (GOOD * 100).astype(np.uint16))[1].tobytes()[:-20], "cut off"),
        ("a.tiff", cv2.imencode(".tiff", GOOD)[1].tobytes()[:40], "decoded"),
        ("a.tiff", b"not a tiff", "decoded"),
        ("a.exr", b"not an exr", "is no EXR"),
        ("a.xyz", b"", "is no kind of depth map"),
    ],
)
def test_files_that_lie_are_refused_by_name(tmp_path: Path, name: str, data: bytes, message: str) -> None:
    path = tmp_path / f"spaces & ü {name}"
    path.write_bytes(data)
    if name.endswith("exr"):
        pytest.importorskip("OpenEXR")
    with pytest.raises(BadInput, match=message) as caught:
        read_depth_file(path)
    assert caught.value.where == str(path)


def test_a_png_that_claims_more_than_memory_is_refused(tmp_path: Path) -> None:
    import struct
    import zlib

    data = cv2.imencode(".png", (GOOD * 100).astype(np.uint16))[1].tobytes()
    head = b"IHDR" + struct.pack(">II", 60000, 60000) + data[24:29]
    bomb = data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:]
    (tmp_path / "bomb.png").write_bytes(bomb)
    with pytest.raises(BadInput):
        read_depth_file(tmp_path / "bomb.png")
    assert MAX_PIXELS < 60000 * 60000


@pytest.mark.parametrize("channel", ["Z", "depth", "V", "Y", "R", "distance"])
def test_exr_channels_of_depth(tmp_path: Path, channel: str) -> None:
    write_exr(tmp_path / "a.exr", GOOD, channel)
    assert np.array_equal(read_depth_file(tmp_path / "a.exr").values, GOOD)


def test_exr_that_is_cut_off_or_without_depth_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    exr = pytest.importorskip("OpenEXR")
    write_exr(tmp_path / "a.exr", GOOD)
    whole = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(whole[:-60])
    with pytest.raises(BadInput):
        read_depth_file(tmp_path / "a.exr")
    assert not capfd.readouterr().out
    with exr.File({"type": exr.scanlineimage}, {"A": GOOD, "B": GOOD}) as file:
        file.write(str(tmp_path / "b.exr"))
    with pytest.raises(BadInput, match="no channel of depth, but A, B"):
        read_depth_file(tmp_path / "b.exr")


def test_exr_with_a_part_of_the_image_is_refused(tmp_path: Path) -> None:
    exr = pytest.importorskip("OpenEXR")
    whole = np.array([0, 0], np.int32), np.array([20, 20], np.int32)
    part = np.array([3, 2], np.int32), np.array([10, 7], np.int32)
    header = {"type": exr.scanlineimage, "displayWindow": whole, "dataWindow": part}
    with exr.File(header, {"Z": GOOD}) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(BadInput, match="a part of its image only"):
        read_depth_file(tmp_path / "a.exr")


def test_exr_without_its_package_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    (tmp_path / "a.exr").write_bytes(b"x")
    with pytest.raises(BadInput, match=r"pip install 'dope-descriptors\[exr\]'"):
        read_depth_file(tmp_path / "a.exr")
