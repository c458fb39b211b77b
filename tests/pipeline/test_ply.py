"""PLY files of all kinds, whole and broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dope.common.errors import BadInput
from pipeline.ply import read_ply
from tests.pipeline.co3d_tree import write_ply


def test_ply_files_of_all_kinds_are_read_and_broken_ones_refused(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    path = tmp_path / "a.ply"
    write_ply(path, points)
    binary = path.read_bytes()
    np.testing.assert_array_equal(read_ply(path).xyz, points)
    assert (read_ply(path).rgb == [200, 0, 0]).all()
    lines = "\n".join(f"{x} {y} {z} 0.5 1 0" for x, y, z in points.tolist())
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "red", "green", "blue"))
    head = f"ply\nformat ascii 1.0\ncomment by hand\nelement vertex 50\n{properties}element face 0\nend_header\n"
    path.write_text(head + lines + "\n")
    np.testing.assert_allclose(read_ply(path).xyz, points, rtol=1e-6)
    assert (read_ply(path).rgb == [128, 255, 0]).all()
    for content in (
        binary[:-1],
        binary.replace(b"vertex 50", b"vertex 1" + b"0" * 400),
        binary.replace(b"vertex 50", b"vertex 2000000000"),
        head.encode().replace(b"vertex 50", b"vertex 2000000000") + lines.encode(),
        head.encode().replace(b"vertex 50", b"vertex 1" + b"0" * 30) + lines.encode(),
        (head + lines[: len(lines) // 2]).encode(),
        (head + lines.replace("0.5", "red")).encode(),
        binary.replace(b"vertex", b"face", 1),
        binary.replace(b"float x", b"float y", 1),
        binary.replace(b"float x", b"list x", 1),
        binary[:40],
        b"",
    ):
        path.write_bytes(content)
        with pytest.raises(BadInput, match=r"a\.ply"):
            read_ply(path)


def test_a_ply_file_without_points_is_empty_and_points_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    for points, expected in (
        (np.zeros((0, 3)), 0),
        (np.full((3, 3), np.nan), 0),
        (np.array([[1, 2, 3], [1, np.inf, 3], [4, 5, 6]]), 2),
    ):
        write_ply(path, points)
        found = read_ply(path)
        assert found.xyz.shape == (expected, 3) and found.rgb is not None and found.rgb.shape == (expected, 3)
    path.write_bytes(path.read_bytes().replace(b"binary_little_endian", b"ascii").replace(b"vertex 3", b"vertex 0"))
    assert read_ply(path).xyz.shape == (0, 3)
