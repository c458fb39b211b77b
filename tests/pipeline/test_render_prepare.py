"""Meshes to prepared sequences to pairs: what is written, what is dropped, what is done again, what fails alone."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from dope.common import settings
from dope.common.errors import BadInput, DopeError, UsageError
from pipeline.cameras.colmap import read_points
from pipeline.children import Limits
from pipeline.commands.render import _limited
from pipeline.correspond.match import CorrespondConfig
from pipeline.correspond.pairs import PairsConfig
from pipeline.correspond.views import ViewsConfig, read_views, view_camera
from pipeline.prepare import correspond_all
from pipeline.render import prepare
from pipeline.render.cameras import paired_cameras
from pipeline.render.config import CyclesConfig, FastConfig, RenderConfig, ViewpointsConfig
from pipeline.render.cycles import folders
from pipeline.render.find import find_meshes
from pipeline.render.prepare import ProceduralSource, prepare_renders
from pipeline.render.scene import RENDERER_VERSIONS, Picture, Scene
from pipeline.sequence import Sequence
from pipeline.tasks import RunOptions
from tests.pipeline.analytic import SphereRenderer

CONFIG = settings.override(RenderConfig(recipe="procedural"), ["viewpoints.pairs=4", "viewpoints.jitter=0.1"])
SOURCE = ProceduralSource(0, 0)
RENDERER = prepare._renderer
BOX = """v -1 -1 -1\nv 1 -1 -1\nv 1 1 -1\nv -1 1 -1\nv -1 -1 1\nv 1 -1 1\nv 1 1 1\nv -1 1 1
f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"""


@pytest.fixture(autouse=True)
def spheres_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.tasks.run_in_child", lambda run, *args, limits, notify: run(*args, notify))
    monkeypatch.setattr("pipeline.children.Children.call", lambda self, run, *args, notify: run(*args, notify))
    monkeypatch.setattr(prepare, "run_in_child", lambda run, *args, limits: run(*args, None))
    monkeypatch.setattr(prepare, "_renderer", lambda *_: SphereRenderer())


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sequence]:
    work = tmp_path_factory.mktemp("work")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.children.Children.call", lambda self, run, *args, notify: run(*args, notify))
        patch.setattr(prepare, "run_in_child", lambda run, *args, limits: run(*args, None))
        patch.setattr(prepare, "_renderer", lambda *_: SphereRenderer())
        rows = prepare_renders([SOURCE], work, CONFIG, RunOptions())
    assert [(row.stage, row.status) for row in rows] == [("frames", "ok"), ("sfm", "ok"), ("depth", "ok")], rows
    yield Sequence(work / SOURCE.id)


def test_a_render_is_a_prepared_sequence_like_any_other(rendered: Sequence) -> None:
    info, frames = rendered.read_info(), rendered.read_frames()
    assert (info.kind, info.paired, info.masks_from, info.n_registered) == ("render", True, "input", 8)
    cameras = paired_cameras(CONFIG.viewpoints, CONFIG.seed, SOURCE.id)
    for frame, camera in zip(frames, cameras, strict=True):
        np.testing.assert_allclose(frame.camera.R, camera.R, atol=1e-12)
        mask, depth = rendered.read_mask(frame), rendered.read_depth(frame)
        assert mask is not None and depth is not None and mask.any()
        rows, columns = np.nonzero(mask)
        points = camera.unproject(np.stack([columns, rows], 1) + 0.5, depth[mask])
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.5, atol=1e-3)  # 16 bits of the sphere's depth
        assert (depth[~mask] > 0).any(), "the ground near the object has depth, too"
    xyz = read_points(rendered).xyz
    assert len(xyz) > 100
    np.testing.assert_allclose(np.linalg.norm(xyz, axis=1), 0.5, atol=1e-3)


def test_stages_say_how_well_paired_views_agree(rendered: Sequence) -> None:
    details = json.loads((rendered.stages / "frames.json").read_text())["details"]
    assert details["pairs"] == 4 and details["median_miss_px"] < 0.1 and details["within_1_px"] > 0.99
    assert 0.2 < details["seen_by_both"] <= 1 and details["renderer"] == "sphere 1"
    assert json.loads((rendered.stages / "depth.json").read_text())["details"]["mask_coverage"] == 1


def test_views_are_the_renders_and_pairs_are_those_that_were_made(rendered: Sequence) -> None:
    (row,) = correspond_all([rendered], CorrespondConfig(), RunOptions())
    assert row.ok, row.reason
    views = read_views(rendered)
    assert len(views) == 8
    for view, frame in zip(views, rendered.read_frames(), strict=True):
        camera = view_camera(view)
        np.testing.assert_allclose(camera.K, frame.camera.K)
        assert view["crop_size"] == 224 and view["inside_share"] == 1
        stored, cut = (
            cv2.imread(str(rendered.folder / str(frame.image))),
            cv2.imread(str(rendered.folder / view["image"])),
        )
        assert np.abs(stored.astype(int) - cut).mean() < 1
        mask = cv2.imread(str(rendered.folder / view["mask"]), cv2.IMREAD_GRAYSCALE) > 127
        assert np.array_equal(mask, rendered.read_mask(frame))
    table = pq.read_table(rendered.correspondences).to_pylist()
    pairs = [(pair["frame1"], pair["frame2"]) for pair in table]
    assert pairs and all(first % 2 == 0 and second == first + 1 for first, second in pairs)
    assert all(pair["cycle_px"] < 0.1 for pair in table)


def test_renders_can_be_cropped_and_paired_as_videos_are(rendered: Sequence, tmp_path: Path) -> None:
    copy = Sequence(Path(shutil.copytree(rendered.folder, tmp_path / "copy")))
    config = CorrespondConfig(views=ViewsConfig(crop="object"), pairs=PairsConfig(choose="spread"))
    (row,) = correspond_all([copy], config, RunOptions())
    assert row.ok and all(view["crop_size"] < 224 for view in read_views(copy))
    pairs = [(pair["frame1"], pair["frame2"]) for pair in pq.read_table(copy.correspondences).to_pylist()]
    assert any(second != first + 1 for first, second in pairs)


def test_pairs_that_hardly_show_the_object_are_dropped_with_their_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Vanishing(SphereRenderer):
        def render(self, scene: Scene) -> Iterator[Picture]:
            for number, picture in enumerate(super().render(scene)):
                hidden = number in (1, 4)
                yield replace(picture, mask=picture.mask & np.False_) if hidden else picture

    monkeypatch.setattr(prepare, "_renderer", lambda *_: Vanishing())
    assert all(row.ok for row in prepare_renders([SOURCE], tmp_path, CONFIG, RunOptions()))
    frames = Sequence(tmp_path / SOURCE.id).read_frames()
    assert [frame.dropped is not None for frame in frames] == [True, True, False, False, True, True, False, False]
    assert frames[0].dropped == "the object fills 0.00% of a view of this pair" and frames[0].image is None
    any_share = settings.override(CONFIG, ["mesh.min_mask_share=0"])
    assert all(row.ok for row in prepare_renders([SOURCE], tmp_path / "any", any_share, RunOptions()))
    frames = Sequence(tmp_path / "any" / SOURCE.id).read_frames()
    assert frames[0].dropped and not frames[2].dropped, "a view of nothing is no view, whatever the limit"
    monkeypatch.setattr(prepare, "_renderer", lambda *_: SphereRenderer(radius=0.004))
    failed, *_ = prepare_renders([SOURCE], tmp_path / "none", CONFIG, RunOptions())
    assert failed.status == "failed" and "no pair of views shows it: it fills 0.0" in str(failed.reason)


def test_only_settings_that_matter_make_it_anew(tmp_path: Path) -> None:
    def skipped(config: RenderConfig) -> bool:
        return all(row.skipped for row in prepare_renders([SOURCE], tmp_path, config, RunOptions()))

    assert not skipped(CONFIG) and skipped(CONFIG)
    assert skipped(replace(CONFIG, cycles=CyclesConfig(samples=50, python="elsewhere")))  # not the renderer in use
    assert not skipped(replace(CONFIG, fast=FastConfig(supersample=1)))
    assert not skipped(replace(CONFIG, seed=1))
    assert not skipped(replace(CONFIG, viewpoints=ViewpointsConfig(pairs=2)))
    assert len(Sequence(tmp_path / SOURCE.id).read_frames()) == 4


def test_pictures_of_an_older_version_of_the_renderer_are_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert all(row.ok and not row.skipped for row in prepare_renders([SOURCE], tmp_path, CONFIG, RunOptions()))
    monkeypatch.setitem(RENDERER_VERSIONS, "cycles", 99)
    assert all(row.skipped for row in prepare_renders([SOURCE], tmp_path, CONFIG, RunOptions()))
    monkeypatch.setitem(RENDERER_VERSIONS, "fast", 99)
    assert all(row.ok and not row.skipped for row in prepare_renders([SOURCE], tmp_path, CONFIG, RunOptions()))


def test_a_run_that_is_killed_between_stages_ends_with_the_same_bytes(tmp_path: Path) -> None:
    def tree(folder: Path) -> dict[str, bytes]:
        files = sorted(path for path in folder.rglob("*") if path.is_file() and path.parent.name != "stages")
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files if path.name != ".lock"}

    for name in ("whole", "killed"):
        prepare_renders([SOURCE], tmp_path / name, CONFIG, RunOptions())
    killed = tmp_path / "killed" / SOURCE.id
    for stage in ("depth", "sfm", "frames"):
        (killed / "stages" / f"{stage}.json").unlink()
        if stage == "frames":
            shutil.rmtree(killed / "depths")
        prepare_renders([SOURCE], tmp_path / "killed", CONFIG, RunOptions())
        assert tree(killed) == tree(tmp_path / "whole" / SOURCE.id), stage


def test_a_broken_mesh_is_a_row_and_its_neighbours_are_rendered(tmp_path: Path) -> None:
    folder = tmp_path / "möbel und mehr" / "Stühle"
    folder.mkdir(parents=True)
    (folder / "gut.obj").write_text(BOX)
    (folder / "leer.obj").write_text("")
    (folder / "kaputt.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nend_header\n"
    )
    sources, errors = find_meshes([folder.parent], category=None, category_from="auto", up="auto", known={})
    assert not errors
    rows = prepare_renders(sources, tmp_path / "work", CONFIG, RunOptions())
    by_id = {row.sequence: row for row in rows if row.stage == "frames"}
    assert {name: row.status for name, row in by_id.items()} == {"gut": "ok", "leer": "failed", "kaputt": "failed"}
    assert "leer.obj" in str(by_id["leer"].reason) and "kaputt.ply" in str(by_id["kaputt"].reason)
    assert Sequence(tmp_path / "work" / "gut").read_info().category == "Stühle"


def test_another_mesh_of_the_same_name_does_not_take_its_place(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "box.obj").write_text(f"# {name}\n{BOX}")
    for name, status in (("a", "ok"), ("b", "failed")):
        sources, _ = find_meshes([tmp_path / name], category=None, category_from="none", up="z", known={})
        row, *_ = prepare_renders(sources, tmp_path / "work", CONFIG, RunOptions())
        assert row.status == status
    assert "holds the sequence of" in str(row.reason)


def test_blender_has_the_limits_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(prepare, "run_in_child", lambda run, *args, limits: run(*args, None))
    given: list[Limits] = []

    def begin(config: CyclesConfig, limits: Limits) -> None:
        given.append(limits)
        raise DopeError("that is enough")

    monkeypatch.setattr("pipeline.render.cycles.renderer.CyclesRenderer", begin)
    asked = Limits(minutes=90, memory_gib=3)
    with pytest.raises(DopeError, match="enough"):
        prepare_renders([SOURCE], tmp_path, replace(CONFIG, renderer="cycles"), RunOptions(limits=asked))
    assert given == [asked]


def test_a_renderer_that_is_not_there_is_one_error_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(*_: object) -> None:
        raise DopeError("there is no OpenGL", remedy="Install it")

    prepare_renders([SOURCE], tmp_path / "done", CONFIG, RunOptions())
    monkeypatch.setattr(prepare, "_renderer", missing)
    with pytest.raises(DopeError, match=r"no OpenGL\. Install it"):
        prepare_renders([SOURCE, ProceduralSource(1, 0)], tmp_path / "new", CONFIG, RunOptions())
    assert not (tmp_path / "new").exists()
    assert all(row.skipped for row in prepare_renders([SOURCE], tmp_path / "done", CONFIG, RunOptions()))


def test_blender_has_the_limits_that_were_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    began = []

    def blender(config: CyclesConfig, limits: Limits) -> SphereRenderer:
        began.append((config.samples, limits))
        return SphereRenderer()

    monkeypatch.setattr(prepare, "_renderer", RENDERER)
    monkeypatch.setattr(prepare, "_renderers", {})
    monkeypatch.setattr("pipeline.render.cycles.renderer.CyclesRenderer", blender)
    limits = Limits(minutes=60.0, memory_gib=3.0)
    config = replace(CONFIG, renderer="cycles", cycles=CyclesConfig(samples=50))
    assert all(row.ok for row in prepare_renders([SOURCE], tmp_path, config, RunOptions(limits=limits)))
    assert set(began) == {(50, limits)}


def test_nothing_is_left_in_memory_by_children_that_were_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folders, "_MEMORY", tmp_path / "shm")
    left = tmp_path / "shm/dope-cycles-left"
    left.mkdir(parents=True)
    (left / "lock").touch()
    prepare_renders([SOURCE], tmp_path / "work", replace(CONFIG, renderer="cycles"), RunOptions())
    assert not left.exists()


@pytest.mark.parametrize("name", ["hdris", "materials"])
def test_an_empty_folder_of_light_or_ground_is_refused_before_anything_is_rendered(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    config = settings.override(CONFIG, [f"look.{name}={tmp_path / 'empty'}"])
    with pytest.raises(BadInput, match="empty"):
        prepare_renders([SOURCE], tmp_path / "work", config, RunOptions())
    assert not (tmp_path / "work").exists()


def test_what_is_asked_for_must_make_sense() -> None:
    with pytest.raises(UsageError, match="modelnet"):
        settings.override(RenderConfig(), ["recipe=modelnett"])
    with pytest.raises(UsageError, match="pairs"):
        settings.override(RenderConfig(), ["viewpoints.pairs=0"])


@pytest.mark.parametrize(
    "setting",
    ["viewpoints.lens_mm=0", "viewpoints.distance=[4,2]", "viewpoints.distance=[0,1]", "viewpoints.zenith_deg=[80,10]",
     "viewpoints.jitter=-1", "look.strength=[1,.nan]", "look.places=-1", "mesh.min_mask_share=2", "jpeg_quality=500"],
)  # fmt: skip
def test_numbers_that_cannot_be_are_refused_before_anything_is_rendered(setting: str) -> None:
    with pytest.raises(UsageError, match=setting.split("=")[0].split(".")[-1]):
        settings.override(RenderConfig(), [setting])


def test_limit_is_of_each_category() -> None:
    sources = [ProceduralSource(number, 0) for number in range(5)]
    assert _limited(list(sources), 2) == sources[:2] and _limited(list(sources), None) == sources
