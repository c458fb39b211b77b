"""The door to COLMAP: what other modules count on, and the traps that it hides."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dope.common.errors import BadInput
from pipeline.cameras import colmap
from pipeline.cameras.colmap.base import pycolmap
from pipeline.cameras.colmap.model import _opencv_intrinsics

ROOT = Path(__file__).parents[2]


def run_python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=ROOT)


def test_zlib_survives_pycolmap():
    """If pycolmap's own deflate symbols win, compressing aborts the process."""
    done = run_python(
        "import pipeline.cameras.colmap, zlib, gzip, io, numpy as np, cv2\n"
        "data = np.random.default_rng(0).integers(0, 9, 1 << 20, dtype=np.uint8)\n"
        "assert zlib.decompress(zlib.compress(data.tobytes())) == data.tobytes()\n"
        "assert gzip.decompress(gzip.compress(data.tobytes())) == data.tobytes()\n"
        "np.savez_compressed(io.BytesIO(), data=data)\n"
        "assert cv2.imencode('.png', data.reshape(1024, 1024))[0]\n"
        "print('survived')\n"
    )
    assert done.returncode == 0 and done.stdout == "survived\n" and done.stderr == ""


def test_sigterm_still_ends_the_process():
    done = run_python(
        "import pipeline.cameras.colmap, os, signal; os.kill(os.getpid(), signal.SIGTERM); print('alive')"
    )
    assert done.returncode == -15 and done.stdout == ""


def test_nothing_else_imports_pycolmap():
    pattern = re.compile(r"^\s*(import|from)\s+pycolmap\b", re.MULTILINE)
    importers = [
        p.relative_to(ROOT).as_posix()
        for room in ("pipeline", "dope")
        for p in (ROOT / room).rglob("*.py")
        if pattern.search(p.read_text())
    ]
    assert importers == ["pipeline/cameras/colmap/base.py"]


@pytest.mark.parametrize(
    ("model", "parameters", "expected_focals", "expected_distortion"),
    [
        ("SIMPLE_PINHOLE", [500, 320, 240], (500, 500), (0, 0, 0, 0)),
        ("PINHOLE", [500, 510, 320, 240], (500, 510), (0, 0, 0, 0)),
        ("SIMPLE_RADIAL", [500, 320, 240, 0.1], (500, 500), (0.1, 0, 0, 0)),
        ("RADIAL", [500, 320, 240, 0.1, -0.02], (500, 500), (0.1, -0.02, 0, 0)),
        ("OPENCV", [500, 510, 320, 240, 0.1, -0.02, 0.001, 0.002], (500, 510), (0.1, -0.02, 0.001, 0.002)),
    ],
)
def test_intrinsics_project_as_colmap_does(model, parameters, expected_focals, expected_distortion):
    from pipeline.geometry import Camera

    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, 640, 480)
    camera.params = parameters
    K, distortion = _opencv_intrinsics(camera)
    assert (K[0, 0], K[1, 1]) == expected_focals and tuple(distortion) == expected_distortion
    xyz = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 2.0]])
    ours = Camera(640, 480, K, distortion, np.eye(3), np.zeros(3)).project(xyz)[0]
    np.testing.assert_allclose(ours, np.stack([camera.img_from_cam(point) for point in xyz]), atol=1e-9)


def test_a_fisheye_camera_is_refused():
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 500.0, 640, 480)
    with pytest.raises(colmap.ColmapError, match="OPENCV_FISHEYE"):
        _opencv_intrinsics(camera)


def test_a_folder_without_a_model_and_a_damaged_model_are_named(tmp_path):
    with pytest.raises(BadInput, match="holds no COLMAP model"):
        colmap.read_model(tmp_path)
    for name in ("cameras", "images", "points3D", "rigs", "frames"):
        (tmp_path / f"{name}.bin").write_bytes(b"\x05")
    with pytest.raises(colmap.ColmapError, match=re.escape(str(tmp_path))):
        colmap.read_model(tmp_path)


def test_patch_match_without_a_gpu_is_an_error_and_not_an_abort(tmp_path):
    if colmap.has_cuda_gpu():
        pytest.skip("there is a GPU here")
    with pytest.raises(colmap.ColmapError, match="CUDA"):
        colmap.patch_match(tmp_path)
