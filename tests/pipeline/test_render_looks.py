"""Colours, textures and the files that meshes refer to."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import mesh_writers as w
import numpy as np
import pytest

from dope.common.errors import BadInput
from pipeline.render.load import load_model
from pipeline.render.mesh_files.beside import LARGEST_TEXTURE, decode_texture
from pipeline.render.scene import Part

pytest.importorskip("scipy", reason="needs the extra `render`")
RED, GREEN = (255, 0, 0), (0, 255, 0)
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)
SQUARE_OBJ = "mtllib m.mtl\n" + w.lines(SQUARE, "v ") + w.lines(SQUARE[:, :2], "vt ")
TEXTURED = SQUARE_OBJ + "usemtl skin\nf 1/1 2/2 3/3 4/4\n"


def load(path: Path, data: str | bytes) -> tuple[Part, ...]:
    return load_model(w.write(path, data), max_faces=1000).parts


def refusal(path: Path, data: str | bytes) -> str:
    with pytest.raises(BadInput) as caught:
        load(path, data)
    assert path.name in str(caught.value) and caught.value.remedy
    return str(caught.value)


def seen(part: Part, x: float, y: float) -> tuple[int, ...]:
    """The texture's colour at the vertex nearest to (x, y)."""
    assert part.texture is not None and part.uv is not None
    u, v = part.uv[np.abs(part.vertices[:, :2] - (x, y)).sum(axis=1).argmin()]
    height, width = part.texture.shape[:2]
    return tuple(part.texture[min(int((1 - v) * height), height - 1), min(int(u * width), width - 1)].tolist())


def test_obj_materials_become_parts_with_colours_and_textures(tmp_path: Path) -> None:
    w.write(tmp_path / "my wood.png", w.png(RED, GREEN))
    w.write(tmp_path / "m.mtl", "newmtl plain\nKd 0.2 0.4 0.6\nnewmtl skin\nKd 0 0 0\nmap_Kd -s 1 1 1 my wood.png\n")
    faces = "f 1/1 2/2 3/3\nusemtl plain\nf 1/1 3/3 4/4\nusemtl absent\nf 1/1 2/2 4/4\n"
    skin, plain, absent = load(tmp_path / "x.obj", SQUARE_OBJ + "usemtl skin\n" + faces)
    assert (seen(skin, 0, 0), seen(skin, 1, 0)) == (RED, GREEN) and skin.colour == (1, 1, 1), "Kd is for those without"
    assert plain.texture is None and plain.colour == (0.2, 0.4, 0.6)
    assert not absent.has_look


def test_a_missing_library_is_no_look_and_a_missing_texture_is_refused(tmp_path: Path) -> None:
    assert not load(tmp_path / "x.obj", TEXTURED)[0].has_look
    w.write(tmp_path / "m.mtl", "newmtl skin\nmap_Kd wood.png\nnewmtl unused\nmap_Kd nowhere.png\n")
    assert "texture 'wood.png' is missing" in refusal(tmp_path / "x.obj", TEXTURED)
    w.write(tmp_path / "wood.png", b"no picture")
    assert "cannot be decoded" in refusal(tmp_path / "x.obj", TEXTURED)
    w.write(tmp_path / "wood.png", w.png(RED))
    assert load(tmp_path / "x.obj", TEXTURED)[0].texture is not None, "one that no face uses need not be there"


def test_files_outside_the_folder_are_refused(tmp_path: Path) -> None:
    picture = w.write(tmp_path / "out/t.png", w.png(RED))
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "link.png").symlink_to(picture)
    (folder / "out").symlink_to(picture.parent)
    names = [str(picture), "../out/t.png", "..\\out\\t.png", "link.png", "out/t.png", "http://a.b/t.png", "C:/t.png"]
    value, data = w.gltf_json(SQUARE, [[0, 1, 2]])
    for name in names:
        w.write(folder / "m.mtl", f"newmtl skin\nmap_Kd {name}\n")
        assert "outside its folder" in refusal(folder / "x.obj", TEXTURED), name
        assert "outside its folder" in refusal(folder / "y.obj", TEXTURED.replace("m.mtl", name)), name
        outside = value | {"buffers": [{"byteLength": 99, "uri": name}]}
        assert "outside its folder" in refusal(folder / "x.gltf", json.dumps(outside)), name
        assert "outside its folder" in refusal(folder / "x.ply", textured_ply(name)), name
    escaped = value | {"buffers": [{"byteLength": 99, "uri": "%2e%2e/out/t.png"}]}
    assert "outside its folder" in refusal(folder / "x.gltf", json.dumps(escaped))
    w.write(folder / "m.mtl", "newmtl skin\nmap_Kd sub/../t.png\n")
    w.write(folder / "sub/x", b"")
    w.write(folder / "t.png", w.png(GREEN))
    assert load(folder / "x.obj", TEXTURED)[0].texture is not None, "this one comes back"
    assert data


def test_shapenet_keeps_images_beside_the_models_folder(tmp_path: Path) -> None:
    models = tmp_path / "02691156/abc/models"
    w.write(models / "m.mtl", "newmtl skin\nmap_Kd ../images/t.png\n")
    w.write(models.parent / "images/t.png", w.png(RED))
    assert load(models / "model_normalized.obj", TEXTURED)[0].texture is not None
    assert "outside its folder" in refusal(models / "other.obj", TEXTURED)
    w.write(models.parent / "m.mtl", "newmtl skin\nmap_Kd ../t.png\n")
    assert "outside its folder" in refusal(models.parent / "model_normalized.obj", TEXTURED)
    w.write(models / "m.mtl", "newmtl skin\nmap_Kd ../../t.png\n")
    assert "outside its folder" in refusal(models / "model_normalized.obj", TEXTURED)


def textured_ply(name: str) -> str:
    head = w.ply_head("ascii", vertices=4, faces=1, more=f"comment TextureFile {name}\n")
    head = head.replace("end_header", "property list uchar float texcoord\nend_header")
    return head + w.lines(SQUARE) + "4 0 1 2 3 8 0 0 1 0 1 1 0 1\n"


def test_ply_colours_of_vertices_and_faces_and_textures(tmp_path: Path) -> None:
    rgb = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    of_vertices = w.ply_head("ascii", vertices=4, faces=1).replace("element face", rgb + "element face")
    body = "".join(f"{x} {y} 0 {255 * x} 51 0\n" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))) + "4 0 1 2 3\n"
    (part,) = load(tmp_path / "v.ply", of_vertices + body)
    assert part.colours is not None and np.allclose(part.colours, [[x, 0.2, 0] for x in part.vertices[:, 0]])
    of_faces = w.ply_head("ascii", vertices=4, faces=2, of_face=rgb)
    (part,) = load(tmp_path / "f.ply", of_faces + w.lines(SQUARE) + "3 0 1 2 255 0 0\n3 0 2 3 0 255 0\n")
    assert part.colours is not None
    assert np.allclose(part.colours[part.faces], [[[1, 0, 0]] * 3, [[0, 1, 0]] * 3])
    w.write(tmp_path / "t.png", w.png(RED, GREEN))
    (part,) = load(tmp_path / "t.ply", textured_ply("t.png"))
    assert (seen(part, 0, 1), seen(part, 1, 1)) == (RED, GREEN)


def test_off_as_modelnet_writes_it_and_with_colours(tmp_path: Path) -> None:
    glued = load(tmp_path / "a.off", w.off("OFF8 6 0\n"))
    assert np.array_equal(glued[0].vertices, load(tmp_path / "b.off", w.off("OFF # c\n# more\n8 6 0\n"))[0].vertices)
    of_vertices = "COFF\n4 1 0\n" + "".join(f"{x} {y} 0 {x} 0.2 0 1\n" for x, y in SQUARE[:, :2]) + "4 0 1 2 3\n"
    (part,) = load(tmp_path / "c.off", of_vertices)
    assert part.colours is not None and np.allclose(part.colours, [[x, 0.2, 0] for x in part.vertices[:, 0]])
    (part,) = load(tmp_path / "f.off", "OFF\n4 2 0\n" + w.lines(SQUARE) + "3 0 1 2 255 0 0\n3 0 2 3 0 255 0\n")
    assert part.colours is not None
    assert np.allclose(part.colours[part.faces], [[[1, 0, 0]] * 3, [[0, 1, 0]] * 3])


def test_obj_counts_back_continues_lines_and_takes_colours(tmp_path: Path) -> None:
    (part,) = load(tmp_path / "a.obj", "v 0 0 0 1 0 0\nv 1 0 0 \\\n 1 0 0\nv 0 1 0 1 0 0\nf -3 -2 -1\nv 9 9 9 0 0 0\n")
    assert part.colours is not None and np.allclose(part.colours, (1, 0, 0))
    assert sorted(part.vertices.tolist()) == [[0, 0, 0], [0, 1, 0], [1, 0, 0]]
    seam = w.lines(SQUARE, "v ") + w.lines(SQUARE[:, :2], "vt ") + "f 1/1 2/2 3/3\nf 1/4 3/3 4/4\n"
    (part,) = load(tmp_path / "s.obj", seam)
    assert part.uv is not None
    assert np.array_equal(part.uv[part.faces], SQUARE[[[0, 1, 2], [3, 2, 3]], :2]), "vertex 1 has two coordinates"
    mixed = w.lines(SQUARE, "\tv\t") + "vt 0 0\nf 1/1 2/1 3/1 # first\nf 1//  3 4\r\n"
    (part,) = load(tmp_path / "b.obj", mixed)
    assert len(part.faces) == 2 and part.uv is None, "texture coordinates of some corners only are none"


def textured_gltf(picture: bytes | str, **texture_info: Any) -> tuple[dict[str, Any], bytes]:
    value, data = w.gltf_json(SQUARE, [[0, 1, 2], [0, 2, 3]])
    uv = SQUARE[:, :2] * (1, -1) + (0, 1)  # the origin at the top left
    data = w.add_accessor(value, data, uv.astype("<f4"))
    primitive = value["meshes"][0]["primitives"][0]
    primitive["attributes"]["TEXCOORD_0"], primitive["material"] = 2, 0
    surface = {"baseColorTexture": {"index": 0} | texture_info, "baseColorFactor": [0.21404, 1, 0, 0.5]}
    uri = picture if isinstance(picture, str) else "data:image/png;base64," + base64.b64encode(picture).decode()
    return value | {
        "materials": [{"pbrMetallicRoughness": surface}],
        "textures": [{"source": 0}],
        "images": [{"uri": uri}],
    }, data


def test_gltf_textures_and_colours(tmp_path: Path) -> None:
    upright = w.png(RED, GREEN)
    (part,) = load(tmp_path / "x.glb", w.glb(*textured_gltf(upright)))
    assert (seen(part, 0, 0), seen(part, 1, 0)) == (RED, GREEN)
    assert part.colour == pytest.approx((0.5, 1, 0), abs=1e-4), "linear factors become sRGB"
    assert part.uv is not None and np.allclose(part.uv, part.vertices[:, :2]), "(0, 0) at the bottom left"
    half = {"extensions": {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [0.5, 1]}}}
    (part,) = load(tmp_path / "t.glb", w.glb(*textured_gltf(upright, **half)))
    assert (seen(part, 0, 0), seen(part, 1, 0)) == (GREEN, GREEN)
    w.write(tmp_path / "a b.png", upright)
    assert load(tmp_path / "x.gltf", w.gltf(*textured_gltf("a%20b.png")))[0].texture is not None
    assert "texture 'c.png' is missing" in refusal(tmp_path / "x.gltf", w.gltf(*textured_gltf("c.png")))
    value, data = w.gltf_json(SQUARE, [[0, 1, 2]])
    data = w.add_accessor(value, data, np.full((4, 4), (255, 0, 55, 255), np.uint8), "VEC4", 5121)
    value["accessors"][2]["normalized"] = True
    value["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 2
    (part,) = load(tmp_path / "c.glb", w.glb(value, data))
    assert part.colours is not None and part.colours[0] == pytest.approx((1, 0, 0.5), abs=0.01)


def test_gltf_nodes_place_turn_and_mirror(tmp_path: Path) -> None:
    value, data = w.gltf_json()
    half = 0.5**0.5
    value["nodes"] = [
        {"children": [1, 2], "translation": [10, 0, 0]},
        {"mesh": 0, "rotation": [0, 0, half, half], "scale": [2, 1, 1]},
        {"mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 100, 1]},
        {"mesh": 0},
    ]
    turned, mirrored = load(tmp_path / "x.glb", w.glb(value, data))
    assert turned.vertices.min(axis=0) == pytest.approx([8, 0, 0]), "2 x 2 x 3, a quarter round z"
    assert turned.vertices.max(axis=0) == pytest.approx([10, 2, 3])
    assert mirrored.vertices.min(axis=0) == pytest.approx([9, 0, 100])
    for part in (turned, mirrored):
        corners = part.vertices[part.faces]
        away = corners.mean(axis=1) - (part.vertices.min(axis=0) + part.vertices.max(axis=0)) / 2
        assert (away * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).sum(axis=1).min() > 0


def test_gltf_normals_turn_with_their_surface(tmp_path: Path) -> None:
    slope = np.array([[0, 0, 0], [1, 0, 1], [0, 1, 0]], dtype=np.float64)
    value, data = w.gltf_json(slope, [[0, 1, 2]])
    data = w.add_accessor(value, data, np.tile(np.array([-1, 0, 1], "<f4"), (3, 1)), "VEC3")
    value["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = 2
    for scale in ([1, 1, 5], [-1, 1, 5]):
        value["nodes"][0] = {"mesh": 0, "rotation": [0.5, 0.5, 0.5, 0.5], "scale": scale}
        (part,) = load(tmp_path / "x.glb", w.glb(value, data))
        corners = part.vertices[part.faces[0]]
        flat = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        assert part.normals is not None and np.allclose(part.normals, flat / np.linalg.norm(flat)), scale


def test_gltf_strips_fans_sparse_and_strided_accessors(tmp_path: Path) -> None:
    for mode, indices in ((5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])):
        value, data = w.gltf_json(SQUARE, indices)
        value["meshes"][0]["primitives"][0]["mode"] = mode
        (part,) = load(tmp_path / "x.glb", w.glb(value, data))
        assert len(part.faces) == 2 and part.normals is not None and np.allclose(part.normals, (0, 0, 1))
    value, data = w.gltf_json(np.insert(SQUARE, 3, 7, axis=1), [[0, 1, 2]])  # a fourth number that belongs to none
    value["bufferViews"][0]["byteStride"] = 16
    assert load(tmp_path / "s.glb", w.glb(value, data))[0].vertices.max() == 1
    value, data = w.gltf_json(SQUARE, [[0, 1, 2]])
    data = w.add_accessor(value, data, np.array([2], "<u2"), "SCALAR", 5123)
    data = w.add_accessor(value, data, np.array([[5, 5, 5]], "<f4"), "VEC3")
    sparse = {"indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 3}}
    value["accessors"][0]["sparse"] = sparse | {"count": 1}
    assert load(tmp_path / "p.glb", w.glb(value, data))[0].vertices.max() == 5


def changed_gltf(change: str) -> bytes:
    value, data = w.gltf_json()
    primitive = value["meshes"][0]["primitives"][0]
    match change:
        case "draco":
            value["extensionsRequired"] = ["KHR_draco_mesh_compression"]
        case "draco primitive":
            primitive["extensions"] = {"KHR_draco_mesh_compression": {}}
            del value["accessors"][0]["bufferView"]
        case "meshopt":
            value["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": {}}
        case "unknown extension":
            value["extensionsRequired"] = ["ACME_shape"]
        case "circle":
            value["nodes"][0] = {"children": [0]}
        case "bomb":  # 2 ** 40 boxes
            value["nodes"] = [{"children": [i + 1, i + 1]} for i in range(40)] + [{"mesh": 0}]
        case "vertices":
            value["nodes"] = [{"mesh": 0} for _ in range(600)]
            value["scenes"] = [{"nodes": list(range(600))}]
            value["accessors"][1]["count"] = 3
        case "nothing held":
            value["accessors"][0] = {"componentType": 5126, "count": 3 * 10**9, "type": "VEC3"}
        case "claims":
            value["accessors"][0]["count"] = 3 * 10**9
        case "faces":
            value["accessors"][1]["count"] = 3 * 10**9
        case "points":
            primitive["mode"] = 0
        case "no buffer":
            value["buffers"] = []
    return w.glb(value, data)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("draco", "Draco"),
        ("draco primitive", "Draco"),
        ("meshopt", "meshopt"),
        ("unknown extension", "ACME_shape"),
        ("circle", "circle"),
        ("bomb", "too many"),
        ("vertices", "spells out 4800 vertices"),
        ("nothing held", "vertices"),
        ("claims", "vertices"),
        ("faces", "more than 1000"),
        ("points", "no faces"),
        ("no buffer", "no buffers[0]"),
    ],
)
def test_gltf_that_cannot_be_read_is_refused_by_name(tmp_path: Path, change: str, reason: str) -> None:
    assert reason in refusal(tmp_path / "x.glb", changed_gltf(change))


def test_textures_are_shrunk_and_huge_ones_refused(tmp_path: Path) -> None:
    picture = decode_texture(w.png(RED, size=3000), tmp_path / "x.obj", "t.png")
    assert picture.shape == (LARGEST_TEXTURE, LARGEST_TEXTURE, 3) and (picture == RED).all()
    claims = w.png(RED)[:16] + (60000).to_bytes(4, "big") * 2 + w.png(RED)[24:]
    with pytest.raises(BadInput, match=r"x\.obj: its texture 't\.png' claims 60000x60000 pixels"):
        decode_texture(claims, tmp_path / "x.obj", "t.png")
