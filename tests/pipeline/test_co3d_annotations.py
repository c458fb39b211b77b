"""CO3D's annotation files: streams, malformed and cut-off files, the index, paths that lead outside."""

from __future__ import annotations

import json
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from dope.common.errors import BadInput, UsageError
from pipeline.co3d import index as index_module
from pipeline.co3d.annotations import parse_frame, parse_sequence
from pipeline.co3d.index import open_index
from pipeline.co3d.sources import Choice, co3d_id, find_co3d
from pipeline.co3d.tree import Category, find_categories, is_inside
from tests.pipeline.co3d_tree import VIEWPOINT, named, numbers, row, tree_of


def test_rows_of_odd_content_keep_their_frame_with_the_problem():
    for change, problem in (
        ({"image": {"path": None, "size": [1, 1]}}, "redacted (no image path)"),
        ({"image": None}, "redacted (no image path)"),
        ({"image": {"path": "a.jpg", "size": None}}, "no image size"),
        ({"image": {"path": "a.jpg", "size": [0, 10]}}, "no image size"),
        ({"image": {"path": "a.jpg", "size": [True, 10]}}, "no image size"),
        ({"viewpoint": None}, "no viewpoint"),
        ({"viewpoint": {**VIEWPOINT, "T": [0, 0]}}, "viewpoint without a finite T"),
        *(
            ({"viewpoint": {**VIEWPOINT, "intrinsics_format": kind}}, "viewpoint with a malformed intrinsics_format")
            for kind in ("\ud800", "", 7, ["ndc_isotropic"])
        ),
    ):
        name, frame = parse_frame(row("a", 3, **change))
        assert (name, frame.number, frame.problem) == ("a", 3, problem)
    _, frame = parse_frame(row("a", 3, depth={"path": "d.png", "scale_adjustment": float("nan")}, mask=[]))
    assert frame.problem is None and frame.depth == "d.png" and frame.depth_scale is None and frame.mask is None
    for wrong in ([], None, {}, row("", 1), row("a", 1.5), row("a", True), row("a", 10**30), row("\ud800", 1)):
        with pytest.raises(ValueError):
            parse_frame(wrong)
    scores = {"viewpoint_quality_score": float("nan"), "point_cloud": {"quality_score": None, "path": 7}}
    annotation = parse_sequence(named("a", **scores))
    assert annotation.viewpoint_quality is None and annotation.point_cloud_quality is None
    assert annotation.point_cloud is None


def test_frames_of_a_sequence_come_in_order_wherever_they_lie_in_the_file(tmp_path):
    frames = [row(f"s{i % 3}", 100 - i) for i in range(60)]
    tree = tree_of(tmp_path / "co3d", frames)
    sources, failed, left_out = find_co3d(tree.root, tmp_path / "work", Choice())
    assert [source.id for source in sources] == ["apple_s0", "apple_s1", "apple_s2"] and not failed and not left_out
    assert numbers(sources[1]) == sorted(100 - i for i in range(60) if i % 3 == 1)
    whole = parse_frame(frames[1])[1]
    assert sources[1].frames(1)[-1] == whole and whole.viewpoint is not None


def test_every_third_frame_is_by_number_from_the_first_annotated_one(tmp_path):
    frames = [row("zero", i) for i in range(100)] + [row("one", i) for i in range(1, 101)]
    frames += [row("gaps", i) for i in (5, 7, 8, 11, 12, 14, 20)]
    tree = tree_of(tmp_path / "co3d", frames)
    sources, _, _ = find_co3d(tree.root, tmp_path / "work", Choice())
    found = {source.annotation.name: numbers(source, 3) for source in sources}
    assert found["zero"] == list(range(0, 100, 3)) and len(found["zero"]) == 34
    assert found["one"] == list(range(1, 101, 3)) and len(found["one"]) == 34
    assert found["gaps"] == [5, 8, 11, 14, 20]


def test_the_index_is_read_again_only_where_the_annotations_changed(tmp_path, monkeypatch):
    tree = tree_of(tmp_path / "co3d", [row("a", i) for i in range(9)])
    told: list[str] = []
    for _ in range(2):
        index = open_index(tree.folder, tmp_path / "work", told.append)
    assert told == ["apple: reading frame_annotations.jgz"]
    tree.frames.append(row("b", 1))
    tree.write()
    changed = open_index(tree.folder, tmp_path / "work", told.append)
    assert len(told) == 2 and changed.path != index.path and len(changed.sequences()) == 2
    changed.path.write_bytes(b"garbage")
    sources, failed, _ = find_co3d(tree.root, tmp_path / "work", Choice())
    assert not sources and "Delete it" in str(failed[0].reason)


def test_any_byte_of_annotations_that_are_not_gzipped_makes_another_index(tmp_path):
    tree = tree_of(tmp_path / "co3d", [row("a", i) for i in range(3)])
    path = tree.folder / "frame_annotations.jgz"
    filler = " " * (2 << 20)  # white space between rows: each of the three lies in no sample of a large file
    texts = [filler.join(["[", *(json.dumps(r) + ("," if i < 2 else "") for i, r in enumerate(tree.frames)), "]"])]
    texts.append(texts[0].replace('"frame_number": 0', '"frame_number": 9'))
    path.write_text(texts[0])
    first = open_index(tree.folder, tmp_path / "work")
    assert open_index(tree.folder, tmp_path / "work").path == first.path
    path.write_text(texts[1])
    changed = open_index(tree.folder, tmp_path / "work")
    assert changed.path != first.path and changed.sequences()[0].first_number == 1


def test_text_that_cannot_be_written_costs_its_frame_only(tmp_path):
    frames = [row("a", i) for i in range(9)]
    frames[4] = row("a", 4, viewpoint={**VIEWPOINT, "intrinsics_format": "\ud800"})
    tree = tree_of(tmp_path / "co3d", frames)
    (source,), failed, _ = find_co3d(tree.root, tmp_path / "work", Choice())
    assert not failed and [frame.number for frame in source.frames(1) if frame.problem] == [4]


def test_the_parts_of_an_array_job_make_one_index_and_what_a_killed_one_left_goes(tmp_path, monkeypatch):
    tree = tree_of(tmp_path / "co3d", [row("a", i) for i in range(9)])
    left = tmp_path / "work/.co3d/.apple-0123.99.partial.sqlite"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"half of an index")
    built = []

    def slowly(*args):
        built.append(args)
        time.sleep(0.2)
        build(*args)

    build = index_module._build
    monkeypatch.setattr(index_module, "_build", slowly)
    with ThreadPoolExecutor(4) as pool:  # each opens the folder for itself, as processes do
        made = list(pool.map(lambda _: open_index(tree.folder, tmp_path / "work"), range(4)))
    assert len(built) == 1 and {index.path for index in made} == set(left.parent.glob("*.sqlite"))
    assert not left.exists()


def test_a_category_whose_file_is_cut_off_is_a_row_and_leaves_nothing_behind(tmp_path):
    root, work = tmp_path / "co3d", tmp_path / "work"
    tree_of(root, [row("a", i) for i in range(9)], category="banana")
    bad = tree_of(root, [row("a", i) for i in range(900)])
    path = bad.folder / "frame_annotations.jgz"
    path.write_bytes(path.read_bytes()[:-100])
    sources, failed, _ = find_co3d(root, work, Choice())
    assert [source.id for source in sources] == ["banana_a"]
    assert [(r.sequence, r.status) for r in failed] == [("apple", "failed")] and "cut off" in str(failed[0].reason)
    assert sorted(p.name[:7] for p in (work / ".co3d").iterdir()) == [".lock", "banana-"]


def test_rows_that_name_no_frame_are_told_and_the_others_used(tmp_path):
    frames = [row("a", i) for i in range(9)] + [{"sequence_name": "a"}, 5, {"frame_number": 1}]
    tree = tree_of(tmp_path / "co3d", frames, [named("a"), {"viewpoint_quality_score": 1}, named("empty")])
    sources, failed, _ = find_co3d(tree.root, tmp_path / "work", Choice())
    assert [source.id for source in sources] == ["apple_a"] and len(numbers(sources[0])) == 9
    reasons = " | ".join(str(r.reason) for r in failed)
    for part in ("row 10 has no frame_number", "row 11 is not an object", "row 12 has no sequence_name",
                 "annotations.jgz: row 2 has no sequence_name", "no frame of 'empty' is annotated"):  # fmt: skip
        assert part in reasons
    assert all(r.status == "failed" for r in failed)


def test_sequences_are_left_out_by_score_and_one_without_a_score_too(tmp_path):
    scores = {"good": 0.9, "poor": 0.2, "nan": float("nan"), "null": None}
    sequences = [
        named(n, viewpoint_quality_score=s, point_cloud={"quality_score": s, "path": None}) for n, s in scores.items()
    ]
    frames = [row(name, i) for name in (*scores, "unlisted") for i in range(3)]
    tree = tree_of(tmp_path / "co3d", frames, sequences)
    sources, failed, left_out = find_co3d(tree.root, tmp_path / "work", Choice())
    assert len(sources) == 5 and not failed and not left_out  # no minimum: all are kept
    for choice, what in (
        (Choice(min_viewpoint_quality=0.5), "viewpoint"),
        (Choice(min_point_cloud_quality=0.5), "point cloud"),
    ):
        sources, failed, left_out = find_co3d(tree.root, tmp_path / "work", choice)
        assert [source.annotation.name for source in sources] == ["good"] and not failed
        reasons = {r.sequence: str(r.reason) for r in left_out}
        assert f"{what} quality 0.2" in reasons["apple_poor"]
        assert all(f"no {what} quality score" in reasons[f"apple_{n}"] for n in ("nan", "null", "unlisted"))
        assert all(r.status == "empty" for r in left_out)


def test_names_that_are_not_there_are_rows_and_a_folder_that_is_no_download_is_wrong_usage(tmp_path):
    tree = tree_of(tmp_path / "co3d", [row(f"s{i}", 1) for i in range(12)])
    choice = Choice(categories=["apple", "pear", "../co3d"], sequences=["s2", "apple_s10", "s99"])
    sources, failed, _ = find_co3d(tree.root, tmp_path / "work", choice)
    assert [source.annotation.name for source in sources] == ["s2", "s10"]
    reasons = [str(r.reason) for r in failed]
    assert "no category 'pear' (there are: apple)" in reasons[0] and "no category '../co3d'" in reasons[1]
    assert "no sequence 's99'" in reasons[2]
    assert [s.annotation.name for s in find_co3d(tree.root, tmp_path / "work", Choice(limit=3))[0]] == [
        "s0",
        "s1",
        "s2",
    ]
    with pytest.raises(UsageError, match="--category apple"):
        find_categories(tree.folder, [])
    with pytest.raises(UsageError, match="holds no <category>/frame_annotations"):
        find_categories(tmp_path / "work", [])


def test_a_category_whose_name_is_not_utf8_is_a_row_and_the_others_go_on(tmp_path):
    tree = tree_of(tmp_path / "co3d", [row("a", 1)])
    strange = tree.root / os.fsdecode(b"\xff")
    try:
        strange.mkdir()
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")
    shutil.copy(tree.folder / "frame_annotations.jgz", strange)
    for categories in ([], ["apple", strange.name]):
        sources, (failed,), _ = find_co3d(tree.root, tmp_path / "work", Choice(categories=categories))
        assert [source.id for source in sources] == ["apple_a"] and "its name is not UTF-8. Rename it" in failed.reason
        assert "udcff" in failed.sequence and f"{failed.sequence} {failed.reason}".encode()
    tree.root.rename(tmp_path / os.fsdecode(b"co3d\xff"))
    with pytest.raises(UsageError, match="its name is not UTF-8"):
        find_categories(tmp_path / os.fsdecode(b"co3d\xff"), [])


def test_strange_names_get_ids_that_are_safe_and_do_not_depend_on_what_else_is_chosen(tmp_path):
    strange = ["a b", "a_b", "../../x", "..", "a/b", "Ä<script>", "x" * 300, "line\nbreak", "nul\0"]
    ids = [co3d_id("apple", name) for name in strange]
    assert len(set(ids)) == len(strange) and co3d_id("apple", "110_13051_23361") == "apple_110_13051_23361"
    assert all(len(name.encode()) <= 120 and not set(name) & set("/\n\0<> .") for name in ids)
    tree = tree_of(tmp_path / "co3d", [row(name, 1) for name in [*strange, "A_B"]])
    sources, failed, _ = find_co3d(tree.root, tmp_path / "work", Choice())
    assert sorted(source.id for source in sources) == sorted([*ids, "apple_A_B"][: len(ids)]) or len(failed) == 1
    assert "has the id of 'A_B' of apple" in str(failed[0].reason)
    one, _, _ = find_co3d(tree.root, tmp_path / "work", Choice(sequences=["a b"]))
    assert [source.id for source in one] == [ids[0]]


def test_paths_that_lead_outside_are_refused(tmp_path):
    root = tmp_path / "co3d"
    (root / "apple/s/images").mkdir(parents=True)
    (root / "pear").mkdir()
    secret = tmp_path / "secret.jpg"
    secret.write_bytes(b"secret")
    (root / "apple/s/images/good.jpg").write_bytes(b"good")
    (root / "apple/s/images/link.jpg").symlink_to(secret)
    (root / "apple/s/circle.jpg").symlink_to(root / "apple/s/circle.jpg")
    category = Category(root, "apple")
    assert category.resolve("apple/s/images/good.jpg").read_bytes() == b"good"
    for given in ("../secret.jpg", "apple/../../secret.jpg", str(secret), "/etc/passwd", "", "a\0b"):
        assert not is_inside(given)  # not even looked at
        with pytest.raises(BadInput, match="leads outside"):
            category.resolve(given)
    with pytest.raises(BadInput, match="over a link"):
        category.resolve("apple/s/images/link.jpg")
    for given in ("apple/s/images/absent.jpg", ".", "apple/s/images", "apple/s/circle.jpg", "apple/" + "x" * 5000):
        with pytest.raises(BadInput, match=r"is not there|cannot be followed"):
            category.resolve(given)
    elsewhere = tmp_path / "disk2/kiwi/s"
    elsewhere.mkdir(parents=True)
    (elsewhere / "a.jpg").write_bytes(b"good")
    (root / "kiwi").symlink_to(elsewhere.parent)  # a category on another disk
    assert Category(root, "kiwi").resolve("kiwi/s/a.jpg").read_bytes() == b"good"
    with pytest.raises(BadInput, match="over a link"):
        category.resolve("kiwi/s/a.jpg")
