"""CO3D downloads become prepared sequences: geometry through the whole import, odd files, running again."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from cli import app
from dope.common.errors import BadInput, UsageError
from pipeline.co3d.depth import Co3dDepths, read_depth
from pipeline.co3d.points import cloud_points, depth_points
from pipeline.co3d.prepare import MapsConfig
from pipeline.co3d.sources import Choice, find_co3d
from pipeline.geometry import epipolar_distance_px, fundamental
from pipeline.sequence import Sequence
from pipeline.stages import read_marker
from tests.pipeline.co3d_runs import ALL, NAME, huge_png, prepare
from tests.pipeline.co3d_tree import UNIT, Tree, add_sequence, make_tree, views, write_depth, write_ply
from tests.pipeline.synthetic import Scene
from tests.pipeline.tiny_media import with_orientation


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    """Children cost a second each; what they do is tested with `dope prep colmap`."""
    monkeypatch.setattr("pipeline.tasks.run_in_child", lambda run, *args, limits, notify: run(*args, notify))


def statuses(rows) -> list[tuple[str, str]]:
    return [(row.stage, row.status) for row in rows]


def drop_reasons(sequence: Sequence) -> dict[str, str]:
    return {frame.source_name: frame.dropped for frame in sequence.read_frames() if frame.dropped}


@pytest.mark.parametrize("kind", ["ndc_norm_image_bounds", "ndc_isotropic"])
@pytest.mark.parametrize("size", [(128, 96), (96, 128)])
def test_a_pixel_lands_where_the_scene_says_through_the_whole_import(tmp_path, kind, size):
    scene, cameras = Scene(), views(6, *size, arc_deg=60)
    tree = Tree(tmp_path / "co3d", version=2)
    add_sequence(tree, NAME, cameras, scene=scene, kind=kind)
    rows, failed, _ = prepare(tree.write(), tmp_path / "work")
    assert statuses(rows) == [("frames", "ok"), ("sfm", "ok"), ("depth", "ok")] and not failed
    sequence = Sequence(tmp_path / f"work/apple_{NAME}")
    frames = sequence.registered_frames()
    assert len(frames) == 6
    for first, second, one, two in zip(frames, frames[1:], cameras, cameras[1:], strict=False):
        depth = sequence.read_depth(first)
        ys, xs = np.nonzero(depth)
        pixels = np.stack([xs + 0.5, ys + 0.5], axis=1)
        moved, _ = second.camera.project(first.camera.unproject(pixels, depth[ys, xs]))
        truth, visible = scene.transfer(one, pixels, two)
        error = np.linalg.norm(moved - truth, axis=1)[visible]
        assert len(error) > 300
        assert np.median(error) < 0.03 and np.percentile(error, 99) < 0.3, (np.median(error), error.max())
        F = fundamental(first.camera, second.camera)
        assert epipolar_distance_px(F, pixels[visible], truth[visible]).max() < 1e-6
    info = sequence.read_info()
    assert info.unit == "object radius" and info.n_registered == 6 and info.ordered
    assert (info.kind, info.category, info.instance, info.licence) == ("co3d", "apple", NAME, "CC BY-NC 4.0")


def test_images_are_copied_masks_are_thresholded_and_large_ones_shrunk(tmp_path):
    tree = make_tree(tmp_path / "co3d")
    prepare(tree, tmp_path / "work")
    sequence = Sequence(tmp_path / f"work/apple_{NAME}")
    frame = sequence.read_frames()[3]
    place = tree.folder / NAME
    assert (sequence.folder / frame.image).read_bytes() == (place / "images/frame000004.jpg").read_bytes()
    truth = Scene().render(views(8)[3])[2]
    assert (sequence.read_mask(frame) == truth).all()  # 115/255 = 0.45 is object, 89/255 = 0.35 is not
    wide = replace(ALL, frames=replace(ALL.frames, mask_threshold=0.3, long_side=64, min_side=32))
    rows, _, _ = prepare(tree, tmp_path / "work", wide)
    assert [row.skipped for row in rows] == [False] * 3 and all(row.ok for row in rows)
    frame = sequence.read_frames()[3]
    assert (frame.width, frame.height, frame.source_width) == (64, 48, 128)
    shrunk = cv2.resize(truth.astype(np.float32), (64, 48), interpolation=cv2.INTER_AREA) >= 0.5
    grown = sequence.read_mask(frame)
    assert grown[shrunk].all() and grown.sum() > 1.03 * shrunk.sum()
    assert frame.camera.K[0, 0] == pytest.approx(views(8)[3].K[0, 0] / 2)


def test_pixels_are_taken_as_they_lie_in_the_file_whatever_exif_says(tmp_path):
    tree = make_tree(tmp_path / "co3d")
    path = tree.folder / NAME / "images/frame000001.jpg"
    before = cv2.imread(str(path))
    path.write_bytes(with_orientation(path.read_bytes(), 3))  # upside down, says the camera; CO3D's cameras do not
    rows, _, _ = prepare(tree, tmp_path / "work")
    sequence = Sequence(tmp_path / f"work/apple_{NAME}")
    stored = sequence.read_image(sequence.read_frames()[0])
    assert rows[0].details["kept"] == 8 and np.abs(stored.astype(int) - before).mean() < 5


def test_frames_of_different_sizes_have_a_camera_each(tmp_path):
    tree = Tree(tmp_path / "co3d")
    cameras = views(6, 128, 96, 60)[:3] + views(6, 160, 120, 60)[3:]
    add_sequence(tree, NAME, cameras)
    rows, _, _ = prepare(tree.write(), tmp_path / "work")
    assert all(row.ok for row in rows)
    for frame, camera in zip(Sequence(tmp_path / f"work/apple_{NAME}").registered_frames(), cameras, strict=True):
        assert (frame.width, frame.height) == (camera.width, camera.height)
        np.testing.assert_allclose(frame.camera.K, camera.K, atol=1e-9)


def test_frames_that_cannot_be_used_are_dropped_with_reasons_and_the_rest_is_used(tmp_path):
    tree = Tree(tmp_path / "co3d")
    rows = add_sequence(tree, NAME, views(20))
    images = tree.folder / NAME / "images"
    rows[0]["image"]["path"] = None
    (images / "frame000002.jpg").unlink()
    whole = (images / "frame000003.jpg").read_bytes()
    (images / "frame000003.jpg").write_bytes(whole[: len(whole) // 2])
    rows[3]["image"]["path"] = "../../etc/passwd"
    rows[4]["viewpoint"] = None
    rows[5]["viewpoint"]["focal_length"] = [float("nan"), 1]
    rows[6]["image"]["size"] = [128, 96]
    (tmp_path / "outside.jpg").write_bytes(whole)
    (images / "frame000008.jpg").unlink()
    (images / "frame000008.jpg").symlink_to(tmp_path / "outside.jpg")
    rows[8]["frame_number"] = rows[9]["frame_number"]
    (images / "frame000011.jpg").write_bytes(huge_png())
    rows[11]["image"]["path"] = "/etc/passwd"
    (images / "frame000013.jpg").write_bytes(b"")
    rows[13]["viewpoint"]["R"] = [[1, 1, 1], [0, 1, 0], [0, 0, 1]]
    results, failed, _ = prepare(tree.write(), tmp_path / "work")
    assert statuses(results) == [("frames", "ok"), ("sfm", "ok"), ("depth", "ok")] and not failed
    reasons = drop_reasons(Sequence(tmp_path / f"work/apple_{NAME}"))
    expected = {
        "frame 1": "redacted (no image path)",
        "frame000002.jpg": "image is not there",
        "frame000003.jpg": "image is cut off",
        "frame000005.jpg": "no viewpoint",
        "frame000006.jpg": "viewpoint without a finite focal_length",
        "frame000007.jpg": "image of another shape than annotated (128x96, not 96x128)",
        "frame000008.jpg": "over a link",
        "frame000010.jpg": "the same frame number again",
        "frame000011.jpg": "60000",
        "frame000013.jpg": "image is not an image",
        "frame000014.jpg": "R is not a rotation",
        "passwd": "leads outside",
    }
    assert set(reasons) == set(expected)
    for name, part in expected.items():
        assert part in reasons[name], (name, reasons[name])
    assert results[0].details["kept"] == 7 and sum(results[0].details["dropped"].values()) == 13
    kept = [frame for frame in Sequence(tmp_path / f"work/apple_{NAME}").read_frames() if frame.image]
    assert all(frame.registered and frame.depth and frame.mask for frame in kept)


def test_a_sequence_without_usable_frames_is_a_row_and_the_others_go_on(tmp_path):
    tree = Tree(tmp_path / "co3d")
    add_sequence(tree, "absent", views(6))
    few = add_sequence(tree, "few", views(6))
    add_sequence(tree, "fine", views(6, arc_deg=60))
    add_sequence(tree, "undepicted", views(6, arc_deg=60))
    shutil.rmtree(tree.folder / "absent")
    for row in few[2:]:
        row["image"]["path"] = None
    for row in tree.frames:
        if row["sequence_name"] == "undepicted":
            row["depth"] = None
    rows, _, _ = prepare(tree.write(), tmp_path / "work")
    found = {(row.sequence, row.stage): row for row in rows}
    absent, few_row = found["apple_absent", "frames"], found["apple_few", "frames"]
    assert absent.status == "failed" and "not one of its 6 frames' images is there" in str(absent.reason)
    assert not (tmp_path / "work/apple_absent").exists()
    assert few_row.status == "failed" and "2 of 6 are usable, 5 are needed (4 redacted" in str(few_row.reason)
    assert found["apple_fine", "depth"].ok
    bare = found["apple_undepicted", "depth"]
    assert bare.status == "failed" and "--depth either" in str(bare.reason)
    cameras = found["apple_undepicted", "sfm"]
    assert cameras.details["points_from"] == "matches" and "annotated" not in str(cameras.details["warnings"])
    either = replace(ALL, maps=MapsConfig(depth="either"))
    rows, _, _ = prepare(tree, tmp_path / "work", either, Choice(sequences=["undepicted"]))
    assert rows[-1].ok and rows[-1].details["method"] == "sgbm_depth" and [r.skipped for r in rows[:2]] == [True, True]


def test_points_come_from_the_point_cloud_and_from_depth_where_it_is_broken(tmp_path):
    tree = Tree(tmp_path / "co3d")
    add_sequence(tree, NAME, views(6, arc_deg=60), cloud=True)
    cloud = tree.folder / NAME / "pointcloud.ply"
    radii = []
    for points, broken, expected in (("auto", False, "cloud"), ("depth", False, "depth"), ("auto", True, "depth")):
        if broken:
            cloud.write_bytes(cloud.read_bytes()[:-50])
        config = replace(ALL, maps=MapsConfig(points=points))
        rows, _, _ = prepare(tree.write(), tmp_path / "work", config, overwrite=True)
        assert rows[1].ok and rows[1].details["points_from"] == expected
        radii.append(rows[1].details["object"]["radius"])
    assert "is cut off" in rows[1].details["warnings"][0]
    write_ply(cloud, np.full((9, 3), np.nan))
    with pytest.raises(BadInput, match="the point cloud holds no points"):
        cloud_points(find_co3d(tree.root, tmp_path / "work", Choice())[0][0])
    np.testing.assert_allclose(radii, UNIT, rtol=0.15)  # the scene's sphere has radius 1
    rows, _, _ = prepare(tree, tmp_path / "work", replace(ALL, maps=MapsConfig(points="cloud")))
    assert rows[1].status == "failed" and "--points auto" in str(rows[1].reason)


def test_points_of_depth_maps_are_those_of_the_object(tmp_path):
    tree, scene = make_tree(tmp_path / "co3d"), Scene()
    prepare(tree, tmp_path / "work")
    (source,), _, _ = find_co3d(tree.root, tmp_path / "work", Choice())
    for camera, frame in zip(views(8), source.frames(1), strict=True):
        write_depth(tree.root / frame.depth, scene.render(camera)[1] * UNIT / frame.depth_scale)  # the floor, too
    points = depth_points(Sequence(tmp_path / f"work/apple_{NAME}"), Co3dDepths(source, 1, masked=False))
    assert 15_000 < len(points.xyz) <= 20_000 and points.rgb.std() > 20
    np.testing.assert_allclose(np.linalg.norm(points.xyz, axis=1), UNIT, rtol=0.01)


def test_a_second_run_has_nothing_to_do_and_a_changed_file_or_setting_has(tmp_path, monkeypatch):
    tree = make_tree(tmp_path / "co3d")
    prepare(tree, tmp_path / "work")
    opened = []
    monkeypatch.setattr("pipeline.co3d.index.read_rows", lambda path: opened.append(path) or iter(()))
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.tasks.run_in_child", None)  # not even a process is started
        rows, _, _ = prepare(tree, tmp_path / "work")
    assert len(rows) == 3 and all(row.ok and row.skipped for row in rows) and not opened
    moved = tree.root.rename(tmp_path / "elsewhere")
    rows, _, _ = prepare(replace(tree, root=moved), tmp_path / "work")
    assert all(row.skipped for row in rows) and not opened  # the same download in another place
    (moved / f"apple/{NAME}/images/frame000002.jpg").unlink()
    rows, _, _ = prepare(replace(tree, root=moved), tmp_path / "work")
    assert not any(row.skipped for row in rows) and rows[0].details["kept"] == 7 and not opened
    rows, _, _ = prepare(replace(tree, root=moved), tmp_path / "work", replace(ALL, maps=MapsConfig(depth_masks=False)))
    assert [row.skipped for row in rows] == [True, False, False]  # points came from depth, too


def test_sequences_of_two_categories_that_would_share_a_folder_are_told_apart(tmp_path):
    for category, name in (("a", "b_c"), ("a_b", "c")):
        tree = Tree(tmp_path / "co3d", category=category)
        add_sequence(tree, name, views(6, arc_deg=60))
        tree.write()
    rows, failed, _ = prepare(tree, tmp_path / "work")
    assert [row.status for row in rows] == ["ok"] * 3 and Sequence(
        tmp_path / "work/a_b_c"
    ).read_info().instance == "b_c"
    assert len(failed) == 1 and "has the id of 'b_c' of a" in str(failed[0].reason)


def test_where_a_sequence_comes_from_holds_whatever_folder_a_command_is_run_in(tmp_path, monkeypatch):
    make_tree(tmp_path / "co3d", n=5)
    monkeypatch.chdir(tmp_path)
    (source,), _, _ = find_co3d(Path("co3d"), Path("work"), Choice())
    assert source.path == tmp_path / "co3d/apple" / NAME


def test_a_sequence_of_another_download_is_not_overwritten(tmp_path):
    prepare(make_tree(tmp_path / "v1"), tmp_path / "work")
    rows, _, _ = prepare(make_tree(tmp_path / "v2", kind="ndc_isotropic"), tmp_path / "work")
    assert statuses(rows) == [("frames", "failed")] and "already" in str(rows[0].reason)


def test_the_same_download_gives_the_same_bytes(tmp_path):
    tree = make_tree(tmp_path / "co3d", n=6)
    contents = []
    for work in ("one", "two"):
        prepare(tree, tmp_path / work)
        folder = tmp_path / work / f"apple_{NAME}"
        paths = sorted(p for p in folder.rglob("*") if p.is_file() and "stages" not in p.parts and p.name != ".lock")
        contents.append({str(p.relative_to(folder)): p.read_bytes() for p in paths})
    assert contents[0] == contents[1] and len(contents[0]) > 20


def test_half_floats_infinities_and_depth_masks_are_read_as_co3d_means_them(tmp_path):
    tree = make_tree(tmp_path / "co3d")
    (source,), _, _ = find_co3d(tree.root, tmp_path / "work", Choice())
    annotation = source.frames(1)[0]
    values = np.full((96, 128), 2.5)
    values[0, :5] = [np.nan, np.inf, -np.inf, -1.0, 0.0]
    write_depth(tree.root / annotation.depth, values)
    mask = np.full((96, 128), 255, np.uint8)
    mask[95] = 0
    cv2.imwrite(str(tree.root / annotation.depth_mask), mask)
    depth = read_depth(source.category, annotation)
    assert depth.dtype == np.float32 and not depth[0, :5].any() and not depth[95].any()
    assert (depth[1:95] == 2.5 * annotation.depth_scale).all()
    assert (read_depth(source.category, annotation, masked=False)[95] > 0).all()


def test_the_command_prepares_lists_what_is_left_out_and_shares_an_array_job(tmp_path):
    tree = Tree(tmp_path / "co3d")
    for i in range(3):
        add_sequence(tree, f"s{i}", views(6, arc_deg=60), quality=(0.9, float("nan"), 0.8)[i])
    tree.write()
    work = tmp_path / "work"
    base = ["prep", "co3d", str(tree.root), "--out", str(work), "--every", "1", "--json", "--workers", "1"]
    base += ["--min-viewpoint-quality", "0.5", "--num-shards", "2", "--shard-index"]
    first, second = (CliRunner().invoke(app, [*base, str(index)]) for index in range(2))
    assert first.exit_code == 0 and second.exit_code == 0, first.output + second.output
    found = [[json.loads(line) for line in run.stdout.splitlines()] for run in (first, second)]
    assert [(row["sequence"], row["stage"], row["status"]) for row in found[0]] == [
        *(("apple_s0", stage, "ok") for stage in ("frames", "sfm", "depth")),
        ("apple_s1", "frames", "empty"),
    ]
    assert "no viewpoint quality score" in found[0][-1]["reason"]
    assert {row["sequence"] for row in found[1]} == {"apple_s2"}
    assert read_marker(Sequence(work / "apple_s2"), "depth").ok
    table = CliRunner().invoke(app, [word for word in [*base, "0"] if word != "--json"]).stdout
    assert "6 of 6 frames with cameras" in table and "no viewpoint quality score" in table
    wrong = CliRunner().invoke(app, ["prep", "co3d", str(tree.folder), "--out", str(work)])
    assert isinstance(wrong.exception, UsageError)  # exit code 2, by cli.main
    (tmp_path / "file").write_text("no folder")
    blocked = CliRunner().invoke(app, [*base[:3], "--out", str(tmp_path / "file"), "--json"])
    assert blocked.exit_code == 1 and "cannot be written to" in blocked.stdout
    missing = CliRunner().invoke(app, [*base[:3], "--category", "pear", "--out", str(work), "--json"])
    assert missing.exit_code == 1 and "no category 'pear'" in missing.stdout
