from __future__ import annotations

import os
import struct
import warnings
from dataclasses import replace
from pathlib import Path

import mesh_writers as w
import numpy as np
import pytest
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.render.load import load_model
from pipeline.render.scene import Model, Part

pytest.importorskip("scipy", reason="needs the extra `render`")

MESHES = Path(__file__).parents[2].parent / "shared/data"


def load(path: Path, data: str | bytes, max_faces: int = 1000) -> Model:
    return load_model(w.write(path, data), max_faces=max_faces)


def refusal(path: Path, data: str | bytes, max_faces: int = 1000) -> str:
    with pytest.raises(BadInput) as caught:
        load(path, data, max_faces)
    assert str(path) in str(caught.value) and caught.value.remedy
    return str(caught.value)


def area(model: Model) -> float:
    return sum(float(np.linalg.norm(cross(part), axis=1).sum()) / 2 for part in model.parts)


def cross(part: Part) -> NDArray[np.float64]:
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("name", list(w.every_format()))
def test_a_box_is_the_same_from_every_format_and_has_sharp_edges(tmp_path: Path, name: str) -> None:
    (part,) = load(tmp_path / f"x.{name}", w.every_format()[name]).parts
    assert part.faces.shape == (12, 3) and part.vertices.dtype == np.float64
    assert np.array_equal(np.unique(part.vertices, axis=0), np.unique(w.BOX, axis=0))
    flat = cross(part)
    assert np.linalg.norm(flat, axis=1).sum() / 2 == pytest.approx(w.AREA)
    assert ((part.vertices[part.faces].mean(axis=1) - w.BOX.mean(axis=0)) * flat).sum(axis=1).min() > 0, "outwards"
    assert part.normals is not None
    expected = np.repeat(flat / np.linalg.norm(flat, axis=1, keepdims=True), 3, axis=0)
    assert np.allclose(part.normals[part.faces.ravel()], expected)
    assert not part.has_look


def ring(sides: int) -> str:
    """A prism without its ends."""
    angle = 2 * np.pi * np.arange(sides) / sides
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate([np.insert(around, 2, z, axis=1) for z in (0, 1)])
    return w.obj([[i, (i + 1) % sides, sides + (i + 1) % sides, sides + i] for i in range(sides)], vertices)


def test_gentle_edges_are_smooth_and_others_are_not(tmp_path: Path) -> None:
    (round_,) = load(tmp_path / "a.obj", ring(24)).parts
    assert len(round_.vertices) == 48 and round_.normals is not None
    assert np.allclose(round_.normals[:, :2], round_.vertices[:, :2], atol=1e-6), "radial, by the angles at corners"
    (sharp,) = load(tmp_path / "b.obj", ring(8)).parts
    assert len(sharp.vertices) == 32, "each side has its own"


def test_normals_of_the_file_are_kept_unless_they_are_means_over_sharp_edges(tmp_path: Path) -> None:
    turned = "vn 0.6 0 0.8\n"
    (part,) = load(tmp_path / "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + turned + "f 1//1 2//1 3//1\n").parts
    assert part.normals is not None and np.allclose(part.normals, (0.6, 0, 0.8))
    (part,) = load(tmp_path / "b.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 0\nf 1//1 2//1 3//1\n").parts
    assert part.normals is not None and np.allclose(part.normals, (0, 0, 1)), "a zero normal is none"
    means = w.lines((w.BOX - w.BOX.mean(axis=0)) / 2, "vn ")
    faces = "".join("f " + " ".join(f"{i + 1}//{i + 1}" for i in quad) + "\n" for quad in w.QUADS)
    (box,) = load(tmp_path / "c.obj", w.lines(w.BOX, "v ") + means + faces).parts
    assert box.normals is not None and np.allclose(np.abs(box.normals).max(axis=1), 1), "no balloons"


def test_concave_polygons_are_covered_once(tmp_path: Path) -> None:
    star = [[np.cos(a) * r, np.sin(a) * r, 0] for a, r in zip(np.arange(10) * np.pi / 5, [2, 0.5] * 5, strict=True)]
    x, y = np.array(star)[:, :2].T
    expected = float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)
    around = (star, [[z, a, b] for a, b, z in star], [[b, z, a] for a, b, z in star])
    for turned in (*around, *(points[::-1] for points in around)):
        model = load(tmp_path / "star.obj", w.obj([list(range(10))], np.array(turned)))
        assert model.n_faces == 8 and area(model) == pytest.approx(expected)
    arrow = np.array([[0, 0, 0], [2, 1, 0], [0, 2, 0], [1, 1, 0]])
    for shift in range(4):
        assert area(load(tmp_path / "arrow.obj", w.obj([[0, 1, 2, 3]], np.roll(arrow, shift, 0)))) == pytest.approx(1)


def test_degenerate_and_repeated_faces_and_lone_vertices_go(tmp_path: Path) -> None:
    extra = "v 99 99 99\nv 1 0 0\nf 1 2 2\nf 1 3 3\nf 1 2 10\nf 3 4 1\nf 3 1 4\n"
    plain = w.obj(w.TRIANGLES)
    (part,) = load(tmp_path / "x.obj", plain + extra).parts
    assert len(part.faces) == 12 and part.vertices.max() == 3
    lone = w.off("OFF\n9 6 0\n").replace("1 2 3\n", "1 2 3\n1e9 nan 0\n", 1)
    assert load(tmp_path / "x.off", lone).parts[0].vertices.max() == 3, "nobody sees it"


def test_an_object_that_is_inside_out_is_turned_over(tmp_path: Path) -> None:
    (part,) = load(tmp_path / "x.off", w.off(quads=[quad[::-1] for quad in w.QUADS])).parts
    outwards = part.vertices[part.faces].mean(axis=1) - w.BOX.mean(axis=0)
    assert (outwards * cross(part)).sum(axis=1).min() > 0
    assert part.normals is not None and (outwards * part.normals[part.faces].sum(axis=1)).sum(axis=1).min() > 0
    inwards = "vn 0 0 1\nvn 0 0 -1\nvn 0 1 0\nvn 0 -1 0\nvn 1 0 0\nvn -1 0 0\n"
    faces = "".join("f " + " ".join(f"{i + 1}//{k + 1}" for i in q[::-1]) + "\n" for k, q in enumerate(w.QUADS))
    (part,) = load(tmp_path / "x.obj", w.lines(w.BOX, "v ") + inwards + faces).parts
    assert part.normals is not None
    assert np.allclose(part.normals[part.faces[:, 0]] * np.linalg.norm(cross(part), axis=1)[:, None], cross(part))


BROKEN = {
    "empty.obj": (b"", "empty file"),
    "text.obj": (b"hello\n", "no faces"),
    "points.obj": (w.lines(w.BOX, "v "), "no faces"),
    "points.ply": (w.ply_head("ascii", faces=0) + w.lines(w.BOX), "no faces"),
    "no_vertices.obj": ("f 1 2 3\n", "no vertices"),
    "nan.obj": (w.obj().replace("v 1 2 3", "v 1 nan 3"), "not finite"),
    "inf.off": (w.off().replace("1 2 3\n", "1 2 1e999\n", 1), "not finite"),
    "beyond.obj": (w.obj([[0, 1, 20]]), "refers to vertex 20"),
    "zero.obj": (w.obj([[0, 1, -1]]), "vertex 0 or below"),
    "beyond.off": (w.off(quads=[[0, 1, 8], *w.QUADS[1:]]), "refers to vertex 8"),
    "beyond.ply": (w.ply_binary(faces=[[0, 1, 900]]), "refers to vertex 900"),
    "beyond.glb": (w.glb(*w.gltf_json(indices=[[0, 1, 70]])), "refers to vertex 70"),
    "thin.obj": (w.obj([[0, 1, 2]], [[0, 0, 0], [1, 1, 1], [2, 2, 2]]), "no area"),
    "far.obj": (w.obj(vertices=w.BOX * 1e13), "absurd extent"),
    "denormal.obj": (w.obj(vertices=w.BOX * 1e-310), "absurd extent"),
    "away.obj": (w.obj(vertices=w.BOX * 1e-3 + 1e9), "lost to rounding"),
    "stray.obj": (w.obj([*w.QUADS, [0, 1, 8]], [*w.BOX, [0, 0, 5000]]), "vertices 5e+03 away"),
    "cut.obj": (w.obj()[:-4], "fewer than three corners"),
    "cut.off": (w.off()[:-30], "has 1"),
    "cut.stl": (w.stl_binary()[:-1], "claims 12 triangles, holds 11"),
    "cut_text.stl": (w.stl_text()[:-70], "not whole"),
    "longer.stl": (w.stl_binary() + bytes(50), "claims 12 triangles, holds 13"),
    "cut.ply": (w.ply_binary()[:-1], "is cut off"),
    "cut_text.ply": (w.ply_text()[:-12], "is cut off"),
    "cut.glb": (w.glb(*w.gltf_json())[:-8], "claims"),
    "huge.ply": (w.ply_head("binary_little_endian", vertices=2 * 10**9) + "x" * 99, "claims 2000000000 of vertex"),
    "huge_faces.ply": (w.ply_head("ascii", faces=2 * 10**9), "more than 1000"),
    "huge_text.ply": (w.ply_head("ascii", vertices=2 * 10**9), "claims 2000000006 lines"),
    "huge.off": (w.off("OFF\n2000000000 6 0\n"), "claims 2000000000 vertices"),
    "huge_faces.off": (w.off("OFF\n8 2000000000 0\n"), "more than 1000"),
    "huge.stl": (bytes(80) + struct.pack("<I", 2 * 10**9), "more than 1000"),
    "many.obj": (w.obj(w.QUADS * 200), "more than 1000"),
    "binary.off": (b"OFF BINARY\n\0\0\0\x08", "binary"),
    "other.off": (b"solid x", "not an OFF file"),
    "other.ply": (b"OFF", "not a PLY file"),
    "other.glb": (b"glTF\x01\0\0\0" + bytes(20), "is glTF 1"),
    "words.obj": (w.obj().replace("v 1 2 3", "v 1 two 3"), "could not convert"),
    "mesh.fbx": (b"Kaydara", "no mesh that can be read"),
}


@pytest.mark.parametrize("name", list(BROKEN))
def test_broken_meshes_are_refused_by_name_with_a_reason(tmp_path: Path, name: str) -> None:
    data, reason = BROKEN[name]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert reason in refusal(tmp_path / name, data)


def test_more_faces_than_allowed_are_refused_with_the_setting(tmp_path: Path) -> None:
    for name, data in w.every_format().items():
        assert "mesh.max_faces" in refusal(tmp_path / f"x.{name}", data, max_faces=11 if "stl" in name else 5)
        load(tmp_path / f"x.{name}", data, max_faces=12)
    assert "mesh.max_faces" in refusal(tmp_path / "x.off", w.off(), max_faces=11), "counted in triangles, too"


@pytest.mark.parametrize("name", list(w.every_format()))
def test_a_damaged_file_is_read_or_refused_and_never_anything_else(tmp_path: Path, name: str) -> None:
    rng, data = np.random.default_rng(0), w.every_format()[name]
    words = [b"-1", b"1e400", b"nan", b"99999999999999999999", b"[", b"null", b'"', b"0", b"\n", b"/", b"\xff", b"{}"]
    refused = 0
    for _ in range(100):
        at, length = int(rng.integers(len(data))), int(rng.integers(4))
        damaged = data[:at] if length == 3 else data[:at] + words[rng.integers(len(words))] + data[at + length :]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                load(tmp_path / f"x.{name}", damaged)
        except BadInput:
            refused += 1
    assert refused > 50


def test_a_file_far_too_large_is_refused_unread(tmp_path: Path) -> None:
    path = w.write(tmp_path / "x.obj", w.obj())
    os.truncate(path, 300 << 20)  # of which the disk holds one block
    with pytest.raises(BadInput, match=r"huge \(300 MiB"):
        load_model(path, max_faces=1000)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.obj").mkdir()
    for name in ("absent.obj", "folder.obj"):
        with pytest.raises(BadInput, match=name):
            load_model(tmp_path / name, max_faces=10)


@pytest.mark.skipif(bool(os.environ.get("CI")) or not (MESHES / "meshes_unlabelled").exists(), reason="needs ../shared")
def test_real_meshes_agree_with_another_reader() -> None:
    trimesh = pytest.importorskip("trimesh")
    paths = sorted((MESHES / "meshes_labelled").glob("*/*.obj"))[::100]
    for path in [*paths, *sorted((MESHES / "meshes_unlabelled").glob("*.glb"))[::100]]:
        model, other = load_model(path, max_faces=10**6), trimesh.load(path, force="mesh", process=False)
        vertices = model.vertices()
        scale = np.ptp(other.bounds, axis=0).max()
        used = other.vertices[np.unique(other.faces)]
        assert np.allclose([vertices.min(axis=0), vertices.max(axis=0)], [used.min(0), used.max(0)], atol=1e-6 * scale)
        places = np.unique(other.vertices, axis=0, return_inverse=True)[1].reshape(-1)[other.faces]
        once = np.unique(np.sort(places, axis=1), axis=0, return_index=True)[1]
        assert area(model) == pytest.approx(float(other.area_faces[once].sum()), rel=1e-5), path


def test_a_model_does_not_depend_on_what_was_loaded_before(tmp_path: Path) -> None:
    first = load(tmp_path / "a.obj", ring(24))
    load(tmp_path / "b.obj", ring(7))
    again = load(tmp_path / "a.obj", ring(24))
    for one, other in zip(first.parts, again.parts, strict=True):
        assert one.vertices.tobytes() == other.vertices.tobytes() and one.faces.tobytes() == other.faces.tobytes()
        assert replace(one, vertices=other.vertices).normals.tobytes() == other.normals.tobytes()  # type: ignore[union-attr]
