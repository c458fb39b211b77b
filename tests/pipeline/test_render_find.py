from __future__ import annotations

import json
import os
from pathlib import Path

import mesh_writers as w
import pytest

from dope.common.errors import BadInput, UsageError
from pipeline.inputs.sources import input_errors_as_rows
from pipeline.render.find import RenderSource, find_meshes, mesh_fingerprint
from pipeline.render.layouts import SYNSETS
from pipeline.render.load import load_model
from pipeline.render.mesh_files.obj import LARGEST_LIBRARY
from pipeline.render.mesh_files.references import references

SPLITS = Path(__file__).parents[2] / "dope/splits"


def touch(path: Path, data: str | bytes = "x") -> Path:
    return w.write(path, data)


def found(*inputs: Path, **options: object) -> list[RenderSource]:
    sources, errors = find_meshes(inputs, **options)  # type: ignore[arg-type]
    assert not errors, errors
    return sources


def test_files_and_flat_folders_have_no_category(tmp_path: Path) -> None:
    for name in ("b10.GLB", "b9.gltf", "a.off", "c.obj", "d.ply", "e.Stl", "c.mtl", "t.png", ".hidden.obj"):
        touch(tmp_path / name)
    sources = found(tmp_path)
    assert [(s.id, s.up) for s in sources] == [
        ("a", "z"),
        ("b9", "y"),
        ("b10", "y"),
        ("c", "z"),
        ("d", "z"),
        ("e", "z"),
    ]
    assert all(s.category is None and s.instance == s.id and s.subset is None for s in sources)
    assert found(tmp_path / "c.obj")[0].category is None
    assert {s.up for s in found(tmp_path, up="x")} == {"x"}


def test_folders_below_the_given_one_are_categories(tmp_path: Path) -> None:
    for name in ("chair/1.obj", "chair/2.obj", "cup/1.obj", "loose.obj"):
        touch(tmp_path / name)
    sources = found(tmp_path)
    assert [(s.id, s.category) for s in sources] == [
        ("loose", None), ("chair_1", "chair"), ("2", "chair"), ("cup_1", "cup")
    ]  # fmt: skip
    assert [s.category for s in found(tmp_path / "chair")] == [None, None]
    assert [s.category for s in found(tmp_path / "chair", category_from="parent")] == ["chair", "chair"]
    assert {s.category for s in found(tmp_path, category_from="none")} == {None}
    assert {s.category for s in found(tmp_path, category="thing")} == {"thing"}
    with pytest.raises(UsageError, match="category-from"):
        find_meshes([tmp_path], category_from="folder")
    with pytest.raises(UsageError, match=r"mesh\.up"):
        find_meshes([tmp_path], up="w")


def test_modelnet_gives_category_object_and_subset(tmp_path: Path) -> None:
    for name in ("night_stand/train/night_stand_0001.off", "night_stand/test/night_stand_0201.off", "x/train/y.off"):
        touch(tmp_path / "ModelNet40" / name)
    expected = [("night_stand_0201", "night_stand", "test"), ("night_stand_0001", "night_stand", "train")]
    for given in (tmp_path / "ModelNet40", tmp_path / "ModelNet40/night_stand"):
        sources = found(given)[:2]
        assert [(s.id, s.category, s.subset) for s in sources] == expected and sources[0].instance == sources[0].id
    assert [(s.category, s.subset) for s in found(tmp_path / "ModelNet40")[2:]] == [("train", None)], "no such name"


def test_a_mesh_that_went_to_the_other_subset_is_made_anew(tmp_path: Path) -> None:
    train = touch(tmp_path / "chair/train/chair_0001.off")
    before = mesh_fingerprint(found(train)[0])
    (tmp_path / "chair/train").rename(tmp_path / "chair/test")
    assert mesh_fingerprint(found(tmp_path / "chair/test/chair_0001.off")[0]) != before


def test_shapenet_gives_the_synsets_name_in_both_versions(tmp_path: Path) -> None:
    for name in ("v1/02691156/ab1/model.obj", "v2/03001627/cd2/models/model_normalized.obj",
                 "v2/04379243/cd2/models/model_normalized.obj", "v2/04379243/cd2/images/t.jpg"):  # fmt: skip
        touch(tmp_path / name)
    sources = found(tmp_path)
    assert [(s.id, s.category, s.instance, s.up) for s in sources] == [
        ("02691156_ab1", "airplane", "ab1", "y"),
        ("03001627_cd2", "chair", "cd2", "y"),
        ("04379243_cd2", "table", "cd2", "y"),
    ]
    assert [s.id for s in found(tmp_path / "v2/03001627")] == ["03001627_cd2"], "whatever folder is given"
    assert found(tmp_path / "v1", category_from="parent")[0].category == "02691156"
    assert found(tmp_path / "v1", up="z")[0].up == "z"


def test_the_synsets_are_those_of_the_splits() -> None:
    splits = json.loads((SPLITS / "shapenet55_ls.json").read_text())
    assert sorted(SYNSETS.values()) == sorted([*splits["train"], *splits["val_test"]]) and len(SYNSETS) == 55


def test_abc_has_objects_and_no_categories(tmp_path: Path) -> None:
    touch(tmp_path / "abc/00000002/00000002_1ffb81a71e5b402e966b9341_trimesh_000.obj")
    (source,) = found(tmp_path / "abc")
    assert (source.id, source.category, source.instance, source.up) == ("00000002", None, "00000002", "z")


def test_names_with_spaces_and_unicode(tmp_path: Path) -> None:
    touch(tmp_path / "große Vase (2).obj")
    touch(tmp_path / "椅子.obj")
    assert [s.id for s in found(tmp_path)] == ["große_Vase_2", "椅子"]


@pytest.mark.skipif(os.name == "nt", reason="names are bytes elsewhere only")
def test_a_name_that_is_not_utf8_is_a_row(tmp_path: Path) -> None:
    try:
        touch(tmp_path / os.fsdecode(b"a\xff.obj"))
    except OSError:
        pytest.skip("this file system takes UTF-8 only")
    good = touch(tmp_path / "b.obj")
    sources, errors = find_meshes([tmp_path])
    assert [s.path for s in sources] == [good] and "not UTF-8" in str(errors[0][2])
    json.dumps([row.reason for row in input_errors_as_rows(errors)])


def test_ids_are_unique_and_do_not_depend_on_what_work_holds(tmp_path: Path) -> None:
    for name in ("a/x.obj", "b/X.obj", "b/x.stl", "b/y.obj", "c/y.obj"):
        touch(tmp_path / name)
    first = found(tmp_path)
    assert len({s.id.casefold() for s in first}) == 5
    known = {s.path.resolve(): s.id for s in first[1:3]}
    assert [s.id for s in found(tmp_path, known=known)] == [s.id for s in first]
    again = found(tmp_path / "b/y.obj", tmp_path / "b/../b/y.obj", tmp_path / "b/y.obj")
    assert [s.id for s in again] == ["y"], "the same mesh three times is one object"
    kept = {(tmp_path / "b/y.obj").resolve(): "mine"}
    assert found(tmp_path / "b/y.obj", known=kept)[0].id == "mine"
    other = {(tmp_path / "elsewhere.obj"): "y"}
    assert found(tmp_path / "b/y.obj", known=other)[0].id == "b_y", "nobody gets the id of another"


def test_what_cannot_be_used_is_a_row_and_the_others_go_on(tmp_path: Path) -> None:
    good = touch(tmp_path / "good/a.obj")
    (tmp_path / "empty").mkdir()
    touch(tmp_path / "text/readme.txt")
    touch(tmp_path / "blender/a.FBX")
    touch(tmp_path / "work/a/sequence.json")
    touch(tmp_path / "work/a/b.obj")
    names = ["absent.obj", "empty", "text", "blender", "text/readme.txt", "work/a"]
    sources, errors = find_meshes([*(tmp_path / name for name in names), good])
    assert [s.path for s in sources] == [good]
    assert [path for _, path, _ in errors] == [tmp_path / name for name in names]
    reasons = [str(error) for _, _, error in errors]
    for reason, expected in zip(
        reasons, ["spelt", "empty folder", "off, obj, ply, stl, glb, gltf", ".fbx", "no mesh", "prepared"], strict=True
    ):
        assert expected in reason
    assert [row.status for row in input_errors_as_rows(errors)] == ["failed"] * len(names)
    sources, errors = find_meshes([tmp_path])
    assert [s.path for s in sources] == [good], "what was made is no input"
    assert [path for _, path, _ in errors] == [tmp_path / "blender"], (
        "of the folders below, only what could be converted"
    )


def test_links_in_a_circle_end(tmp_path: Path) -> None:
    mesh = touch(tmp_path / "a/x.obj")
    (tmp_path / "a/up").symlink_to(tmp_path)
    assert [s.path for s in found(tmp_path)] == [mesh]


def test_links_to_nothing_and_pipes_are_rows(tmp_path: Path) -> None:
    mesh = touch(tmp_path / "a/x.obj")
    (tmp_path / "a/gone.obj").symlink_to("nowhere.obj")
    (tmp_path / "a/loop.stl").symlink_to("loop.stl")
    os.mkfifo(tmp_path / "a/pipe.ply")
    sources, errors = find_meshes([tmp_path])
    assert [s.path for s in sources] == [mesh]
    reasons = {path.name: str(error) for _, path, error in errors}
    assert sorted(reasons) == ["gone.obj", "loop.stl", "pipe.ply"]
    assert "is a link to nothing" in reasons["gone.obj"] and "no regular file" in reasons["pipe.ply"]


def test_the_fingerprint_is_of_all_that_is_read(tmp_path: Path) -> None:
    def of(name: str) -> dict[str, object]:
        value = mesh_fingerprint(found(tmp_path / name)[0])
        assert json.loads(json.dumps(value)) == value
        return value

    touch(tmp_path / "x.obj", "mtllib m.mtl\nv 0 0 0\n")
    absent = of("x.obj")
    touch(tmp_path / "m.mtl", "newmtl a\nmap_Kd wood.png\nnewmtl b\nmap_Kd ../out.png\n")
    with_library = of("x.obj")
    touch(tmp_path / "wood.png")
    with_picture = of("x.obj")
    touch(tmp_path / "wood.png", "y")
    assert len({json.dumps(v) for v in (absent, with_library, with_picture, of("x.obj"))}) == 4
    assert list(with_library["files"]) == ["x.obj", "m.mtl", "wood.png", "../out.png"]  # type: ignore[call-overload]
    value, data = w.gltf_json()
    for name, content in (
        ("g.gltf", json.dumps(value | {"buffers": [{"uri": "a%20b.bin"}]})),
        ("h.glb", w.glb(value, data)),
    ):
        touch(tmp_path / name, content)
        assert ("a b.bin" in of(name)["files"]) == (name == "g.gltf")  # type: ignore[operator]
    touch(tmp_path / "p.ply", w.ply_head("ascii", more="comment TextureFile wood.png\n"))
    assert "wood.png" in of("p.ply")["files"]  # type: ignore[operator]
    touch(tmp_path / "damaged.glb", b"glTF\xff\xff")
    touch(tmp_path / "none.obj", b"")
    of("damaged.glb")
    of("none.obj")
    source = found(tmp_path / "none.obj")[0]
    (tmp_path / "none.obj").unlink()
    with pytest.raises(BadInput, match=r"none\.obj"):
        mesh_fingerprint(source)


def test_names_are_found_in_little_time_and_memory_whatever_a_file_holds(tmp_path: Path) -> None:
    spaces = touch(tmp_path / "spaces.obj", f"mtllib a{' ' * 1_000_000}b.mtl\nmtllib  \nmtllib\tc d.mtl \r\nv 0 0 0\n")
    assert [name for name, _ in references(spaces)] == ["a", "b.mtl", "c", "d.mtl"]
    touch(tmp_path / "c d.mtl")
    assert [name for name, _ in references(spaces)] == ["a", "b.mtl", "c d.mtl"]
    large = touch(tmp_path / "large.obj", "mtllib large.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with touch(tmp_path / "large.mtl").open("wb") as library:
        library.truncate(LARGEST_LIBRARY + 1)
    assert references(large) == [("large.mtl", tmp_path / "large.mtl")]
    with pytest.raises(BadInput, match=r"large\.mtl: is huge for a library of materials"):
        load_model(large, max_faces=9)
    deep = '{"extras": %s, "buffers": [{"uri": "a%%20\\u00e4.bin"}, {"uri": "data:,x"}], "images": [{"uri" : "../b"}]}'
    named = references(touch(tmp_path / "deep.gltf", deep % ("[" * 99_999 + "]" * 99_999)))
    assert named == [("a ä.bin", tmp_path / "a ä.bin"), ("../b", None)]
