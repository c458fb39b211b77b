"""Panoramas and materials: made here and of files, different from each other, without seams, equal bytes."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from dope.common.errors import BadInput
from pipeline.render import grounds, skies
from pipeline.render.grounds import Material, find_materials, ground_material, read_material
from pipeline.render.skies import ROWS, directions_of, find_skies, read_sky, sky

ROOT = Path(__file__).parents[2]
SOME = (0, 1, 3, 6)


def weighted_mean(panorama: np.ndarray) -> float:
    _, angle = directions_of(len(panorama))
    return float((panorama.mean(axis=2) * angle).sum() / (angle.sum() * panorama.shape[1]))


def write_hdr(path: Path, panorama: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.ascontiguousarray(panorama[..., ::-1], np.float32))
    return path


def seams(picture: np.ndarray) -> list[float]:
    """Difference across the wrapped edges by the largest difference of neighbouring rows or columns within."""
    values = np.atleast_3d(picture).astype(float)
    out = []
    for axis in (0, 1):
        steps = np.abs(np.diff(values, axis=axis, append=values.take([0], axis=axis)))
        by_line = steps.mean(axis=(1 - axis, 2))
        out.append(by_line[-1] / by_line[:-1].max())
    return out


# ---- panoramas


def test_directions_of_a_panorama_follow_its_convention() -> None:
    toward, angle = directions_of(64)
    assert toward[0, 0, 2] > 0.99 and toward[-1, 0, 2] < -0.99
    assert toward[32, 64] @ [1, 0, 0] > 0.99 and toward[32, 32] @ [0, 1, 0] > 0.99  # clockwise from above
    assert (angle.sum() * 128) == pytest.approx(4 * np.pi, rel=1e-3)
    assert directions_of(64, np.pi / 2)[0][32, 64] @ [0, 1, 0] > 0.99


@pytest.mark.parametrize("number", SOME)
def test_procedural_panoramas_are_light(number: int) -> None:
    made = sky(number)
    assert made.shape == (ROWS, 2 * ROWS, 3) and made.dtype == np.float32 and not made.flags.writeable
    assert np.isfinite(made).all() and made.min() >= 0
    assert weighted_mean(made) == pytest.approx(1, abs=1e-4)
    assert seams(np.minimum(made, 3))[1] <= 1.1  # it closes behind the viewer
    toward, _ = directions_of(ROWS)
    above = (toward[..., 2] > 0.05) * np.maximum(toward[..., 2], 0)
    light = (made.mean(axis=2) * above).sum() / above.sum()
    assert 0.3 < light < 6


def test_there_are_as_many_panoramas_and_materials_as_the_paper_has() -> None:
    assert skies.COUNT >= 46 and grounds.COUNT >= 25
    small = [cv2.resize(sky(number), (16, 8), interpolation=cv2.INTER_AREA) for number in range(8)]
    apart = [np.abs(a - b).mean() for i, a in enumerate(small) for b in small[:i]]
    assert min(apart) > 0.02
    assert sky(3) is sky(3 + skies.COUNT)


def test_two_processes_make_the_same_bytes() -> None:
    code = (
        "import hashlib\nfrom pipeline.render.skies import sky\nfrom pipeline.render.grounds import ground_material\n"
        "whole = hashlib.sha256(sky(2).tobytes() + sky(1).tobytes() + ground_material(5).albedo.tobytes())\n"
        "print(whole.hexdigest())"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code]
    answer = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    ground_material(7)
    here = hashlib.sha256(sky(2).tobytes() + sky(1).tobytes() + ground_material(5).albedo.tobytes())
    assert answer.stdout.strip() == here.hexdigest()


def test_a_panorama_of_a_file_is_resized_cleaned_and_normalised(tmp_path: Path) -> None:
    given = np.full((100, 200, 3), 0.5, np.float32)
    given[:50] = [2.0, 1.0, 0.5]
    made = read_sky(write_hdr(tmp_path / "straße 1.hdr", given))
    assert made.shape == (ROWS, 2 * ROWS, 3) and weighted_mean(made) == pytest.approx(1, abs=1e-4)
    assert made[10, 10] == pytest.approx(made[10, 10, 2] * np.array([4, 2, 1]), rel=0.02)  # RGB, first row up
    assert made[-10, 10] == pytest.approx(made[10, 10, 2], rel=0.02)


def test_exr_panoramas_lose_what_is_no_light(tmp_path: Path) -> None:
    exr = pytest.importorskip("OpenEXR")
    given = np.ones((64, 128, 3), np.float32)
    given[0, 0], given[5, 5], given[9, 9] = np.nan, -5, np.inf
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    exr.File(header, {"RGB": given}).write(str(tmp_path / "a.exr"))
    made = read_sky(tmp_path / "a.exr")
    assert np.isfinite(made).all() and made.min() >= 0 and weighted_mean(made) == pytest.approx(1, abs=1e-4)


def test_folders_of_panoramas(tmp_path: Path) -> None:
    for name in ("b.hdr", "a.HDR", "inner/c.hdr", ".hidden.hdr"):
        write_hdr(tmp_path / name, np.ones((4, 8, 3)))
    (tmp_path / "readme.txt").write_text("")
    assert [path.name for path in find_skies(tmp_path)] == ["a.HDR", "b.hdr", "c.hdr"]
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "photo.jpg").write_bytes(b"")
    for folder in (empty, tmp_path / "nowhere"):
        with pytest.raises(BadInput, match=folder.name):
            find_skies(folder)


def test_files_that_are_no_panorama_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "cut.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 64 +X 128\n")
    (tmp_path / "text.hdr").write_text("hello")
    (tmp_path / "none.hdr").write_bytes(b"")
    (tmp_path / "text.exr").write_text("hello")
    write_hdr(tmp_path / "black.hdr", np.zeros((64, 128, 3)))
    write_hdr(tmp_path / "square.hdr", np.ones((64, 64, 3)))
    for path in (*sorted(tmp_path.iterdir()), tmp_path / "missing.hdr"):
        with pytest.raises(BadInput, match=path.name):
            read_sky(path)


# ---- materials


@pytest.mark.parametrize("number", range(16))
def test_procedural_materials_wrap_around(number: int) -> None:
    made = ground_material(number)
    assert made.albedo.shape == (grounds.SIZE, grounds.SIZE, 3) and made.albedo.dtype == np.uint8
    assert not made.albedo.flags.writeable and 0 < made.roughness <= 1 and made.side > 0
    assert max(seams(made.albedo)) <= 1.1
    assert 25 < made.albedo.mean() < 230
    if made.bumps is not None:
        assert made.bumps.shape == made.albedo.shape[:2] and made.bumps.dtype == np.float32
        assert max(seams(made.bumps)) <= 1.1
        slopes = np.abs(np.diff(made.bumps, axis=1)) / (made.side / grounds.SIZE)
        assert slopes.mean() < 0.5


def test_materials_differ() -> None:
    pictures = {hashlib.sha256(ground_material(number).albedo.tobytes()).digest() for number in range(16)}
    assert len(pictures) == 16
    assert ground_material(2).at(-0.3).height == -0.3


def write_picture(path: Path, colour: tuple[int, int, int], dtype: type = np.uint8, side: int = 40) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((side, side, 3), colour[::-1], dtype))
    return path


def test_materials_of_ambientcg_and_poly_haven_and_plain_pictures(tmp_path: Path) -> None:
    write_picture(tmp_path / "Wood051_1K-JPG/Wood051_1K-JPG_Color.jpg", (200, 120, 60))
    write_picture(tmp_path / "Wood051_1K-JPG/Wood051_1K-JPG_NormalGL.jpg", (128, 128, 255))
    write_picture(tmp_path / "Wood051_1K-JPG/Wood051_1K-JPG_Roughness.jpg", (51, 51, 51))
    haven = tmp_path / "brown planks ü"
    write_picture(haven / "brown_planks_diff_1k.jpg", (90, 60, 30))
    height = np.linspace(0, 65535, 40 * 40).reshape(40, 40).astype(np.uint16)
    cv2.imwrite(str(haven / "brown_planks_disp_1k.png"), height)
    write_picture(tmp_path / "plain.png", (10, 20, 250), side=3000)
    (tmp_path / "documents").mkdir()
    found = find_materials(tmp_path)
    assert [path.name for path in found] == ["Wood051_1K-JPG", "brown planks ü", "plain.png"]
    wood, planks, plain = map(read_material, found)
    assert np.abs(wood.albedo[5, 5].astype(int) - [200, 120, 60]).max() < 4
    assert wood.roughness == pytest.approx(0.2, abs=0.01) and wood.bumps is None
    assert planks.bumps is not None and planks.bumps.shape == (40, 40) and planks.roughness == Material.roughness
    assert np.ptp(planks.bumps) == pytest.approx(grounds.FILE_BUMPS, rel=0.02) and planks.bumps[0, 0] < 0
    assert plain.albedo.shape == (1024, 1024, 3) and plain.albedo[0, 0].tolist() == [10, 20, 250]
    assert find_materials(haven) == [haven]


def test_folders_without_materials_and_damaged_pictures_are_named(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "normals" / "a").mkdir(parents=True)
    write_picture(tmp_path / "normals" / "a" / "a_disp.png", (3, 3, 3))
    write_picture(tmp_path / "normals" / "a" / "a_rough.png", (3, 3, 3))
    for name in ("empty", "normals", "nowhere"):
        with pytest.raises(BadInput, match=name):
            find_materials(tmp_path / name)
    (tmp_path / "cut.jpg").write_bytes(b"\xff\xd8\xff\xe0 no picture")
    for path in (tmp_path / "cut.jpg", tmp_path / "missing.png", tmp_path / "normals" / "a"):
        with pytest.raises(BadInput, match=path.name):
            read_material(path)
