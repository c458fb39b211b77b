"""What becomes of models between mapping and acceptance: merged, judged by pairs, extended, refined."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_sfm import CAMERAS, CONFIG, K, box, make_sequence, reference, render

from dope.common.errors import UsageError
from pipeline.cameras import colmap
from pipeline.cameras.colmap.base import opened, pycolmap
from pipeline.cameras.compare import CameraErrors, compare_cameras
from pipeline.cameras.ladder import climb
from pipeline.cameras.model_checks import judge, rotation_check
from pipeline.cameras.pairing import match_frames, match_stragglers
from pipeline.cameras.rungs import LADDER, Rung
from pipeline.cameras.sfm import reconstruct
from pipeline.geometry import Camera, Similarity
from pipeline.sequence import Frame, Sequence

HOW = colmap.Mapping(relaxed=False, refine_focal=True, refine_distortion=True, seed=1, threads=1)
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


class Solved:
    """A box of 12 frames with its database and the model of all frames."""

    def __init__(self, folder: Path) -> None:
        self.sequence: Sequence = make_sequence(folder, [render(box(1), camera) for camera in CAMERAS], ordered=True)
        self.used: list[Frame] = self.sequence.read_frames()
        self.database = folder / "box.db"
        match_frames(self.sequence, self.used, CONFIG, LADDER[0], self.database, masks=None)
        (self.model,) = colmap.map_incrementally(self.database, self.sequence.images, folder / "map", HOW)

    def part(self, frames: range) -> colmap.Model:
        """The model with only some of its frames."""
        found = copy.deepcopy(self.model._reconstruction)
        for image in list(found.images.values()):
            if image.has_pose and int(image.name[:6]) not in frames:
                found.deregister_frame(image.frame_id)
        return colmap.Model(found)

    def errors(self, model: colmap.Model) -> CameraErrors:
        frames = copy.deepcopy(self.used)
        for number, camera in model.cameras().items():
            frames[number].set_camera(camera)
        return compare_cameras(frames, reference(CAMERAS))

    def merge(self, models: list[colmap.Model]) -> tuple[list[colmap.Model], int]:
        return colmap.merge_models(self.database, self.sequence.images, models, self.sequence.folder / "merged", HOW)


@pytest.fixture(scope="module")
def solved(tmp_path_factory) -> Solved:
    return Solved(tmp_path_factory.mktemp("ladder") / "box")


def test_models_that_overlap_become_one(solved):
    first, second = solved.part(range(0, 8)), solved.part(range(4, 12))
    second.transform(Similarity(2.5, TURN, np.array([3.0, -1.0, 0.5])))  # every model has a world of its own
    before = first.cameras()[0].R.copy()
    models, n = solved.merge([first, second])
    errors = solved.errors(models[0])
    assert (n, len(models), models[0].frames) == (2, 1, list(range(12)))
    assert errors.relative_rotation_max_deg < 0.6 and errors.translation_max_percent < 1
    assert models[0].n_points > 0.9 * solved.model.n_points and models[0].mean_error_px < 1
    np.testing.assert_array_equal(first.cameras()[0].R, before)  # the models that were given stay as they were


def test_a_chain_of_models_is_merged_whatever_the_order(solved):
    parts = [solved.part(range(0, 6)), solved.part(range(7, 12)), solved.part(range(3, 10))]
    models, n = solved.merge(parts)
    assert (n, [model.frames for model in models]) == (3, [list(range(12))])


def test_models_that_share_too_little_stay_apart(solved):
    parts = [solved.part(range(0, 7)), solved.part(range(5, 12))]
    models, n = solved.merge(parts)
    assert n == 1 and models == parts
    assert solved.merge([]) == ([], 1)


def test_overlapping_models_that_contradict_each_other_stay_apart(solved):
    first, second = solved.part(range(0, 8)), solved.part(range(4, 12))
    found = second._reconstruction
    for point in list(found.points3D):
        found.points3D[point].xyz = found.points3D[point].xyz[[1, 2, 0]] * [1, -1, 2]  # other points, same features
    assert solved.merge([first, second])[1] == 1


def torn(model: colmap.Model, last: int, degrees: float = 40.0) -> colmap.Model:
    """The model with all cameras after `last` turned in place."""
    found = copy.deepcopy(model._reconstruction)
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    for image in found.images.values():
        if image.has_pose and int(image.name[:6]) > last:
            pose = image.cam_from_world()
            rotation = pycolmap.Rotation3d(pose.rotation.matrix() @ turn)
            found.frame(image.frame_id).rig_from_world = pycolmap.Rigid3d(rotation, pose.translation)
    return colmap.Model(found)


def test_pairs_agree_with_a_good_model_and_contradict_a_torn_one(solved):
    disagreement, agreeing = rotation_check(solved.model, solved.database, CONFIG.checks)
    assert disagreement < 1 and agreeing == 1
    broken = torn(solved.model, last=7)
    _, agreeing = rotation_check(broken, solved.database, CONFIG.checks)
    assert agreeing == pytest.approx(8 / 12)
    # points are those of the good model: nothing but the pairs' rotations speaks against this one
    outcome = judge([broken], solved.used, CONFIG.checks, 320, 0.0, solved.database)
    assert outcome.objection == "pairs of frames contradict the cameras' rotations: 67% of the frames agree"
    assert outcome.report["agreeing_share"] == pytest.approx(0.6667)
    weak = replace(CONFIG.checks, max_pair_rotation_deg=0.001)  # no pair is that exact: weak witnesses convict nobody
    assert judge([broken], solved.used, weak, 320, 0.0, solved.database).objection is None
    strict = replace(CONFIG.checks, max_rotation_disagreement_deg=0.001)
    objection = judge([solved.model], solved.used, strict, 320, 0.0, solved.database).objection
    assert objection is not None and "degrees (median)" in objection
    lenient = replace(CONFIG.checks, min_agreeing_share=0.5)
    assert judge([broken], solved.used, lenient, 320, 0.0, solved.database).objection is None


def test_frames_that_stayed_out_are_matched_and_registered_again(solved):
    part = solved.part(range(0, 10))
    n = match_stragglers(solved.database, solved.used, part.frames, replace(CONFIG, straggler_pairs=6))
    assert 2 * 3 <= n <= 2 * 6
    more = colmap.extend_model(
        solved.database, solved.sequence.images, part, solved.sequence.folder / "more", replace(HOW, relaxed=True)
    )
    assert more.frames == list(range(12)) and part.frames == list(range(10))
    assert solved.errors(more).relative_rotation_max_deg < 0.6


def test_the_robust_refinement_makes_a_copy_that_is_no_worse(solved):
    refined = colmap.refine(solved.model, HOW)
    assert refined.frames == solved.model.frames and refined is not solved.model
    before, after = solved.errors(solved.model), solved.errors(refined)
    assert after.relative_rotation_median_deg < max(1.2 * before.relative_rotation_median_deg, 0.1)


def test_the_global_mapper_is_a_last_rung_where_it_is_asked_for(tmp_path, solved):
    sequence = make_sequence(tmp_path / "box", [render(box(1), camera) for camera in CAMERAS], ordered=True)
    unbelievable = replace(CONFIG.checks, min_points=10**6)
    config = replace(CONFIG, max_rungs=1, global_mapper=True, checks=unbelievable)
    outcomes = climb(sequence, sequence.read_frames(), config, tmp_path / "scratch", masked=False)
    assert [outcome.report["mapper"] for outcome in outcomes] == ["strict", "global"]
    assert outcomes[-1].report["n_registered"] == 12 and solved.errors(outcomes[-1].models[0]).rotation_max_deg < 2
    assert all("agreeing_share" in outcome.report and "merged" in outcome.report for outcome in outcomes)


def test_known_intrinsics_stay_as_they_are_or_are_refined(tmp_path, solved):
    values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], 0.001, 0.0, 0.0, 0.0)
    config = replace(CONFIG, intrinsics=values)
    images = [render(box(1), camera) for camera in CAMERAS]
    sequence = make_sequence(tmp_path / "known", images, ordered=True)
    reconstruct(sequence, config)
    frames = sequence.registered_frames()
    assert len(frames) == 12
    for frame in frames:
        assert (frame.fx, frame.fy, frame.cx, frame.cy, *frame.distortion) == values
    reconstruct(sequence, replace(config, refine_intrinsics=True))
    frame = sequence.registered_frames()[0]
    assert frame.fx != K[0, 0] and abs(frame.fx / K[0, 0] - 1) < 0.08
    assert all(isinstance(f.camera, Camera) for f in frames)


def test_the_same_frames_give_the_same_bytes(tmp_path):
    images = [render(box(1), camera) for camera in CAMERAS[:8]]
    written = []
    for name in ("one", "two"):
        sequence = make_sequence(tmp_path / name, images, ordered=True)
        reconstruct(sequence, CONFIG)
        written.append({path.name: path.read_bytes() for path in sorted(sequence.sparse.iterdir())})
        written[-1]["frames"] = (sequence.folder / "frames.parquet").read_bytes()
    assert written[0] == written[1] and written[0]["images.bin"]


def test_the_best_model_is_finished_on_whichever_rung_it_was_found(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.cameras.ladder.LADDER", (Rung("default"), Rung("poor", size="fallback_image_size")))
    sequence = make_sequence(tmp_path / "box", [render(box(1), camera) for camera in CAMERAS], ordered=True)
    config = replace(CONFIG, target_share=2.0, fallback_image_size=48)  # never enough, and the last rung finds less
    outcomes = climb(sequence, sequence.read_frames(), config, tmp_path / "scratch", masked=False)
    best = max(outcomes, key=lambda outcome: outcome.rank)
    assert best.report["rung"] == "default" and "stragglers" in best.report
    assert [outcome for outcome in outcomes if "stragglers" in outcome.report] == [best]


def test_merged_models_have_the_ids_of_the_database_that_is_kept(solved):
    merged = solved.merge([solved.part(range(4, 12)), solved.part(range(0, 8))])[0][0]._reconstruction
    with opened(solved.database) as db:
        for image in db.read_all_images():
            there = merged.images[image.image_id]
            assert (there.name, there.camera_id, there.frame_id) == (image.name, image.camera_id, image.frame_id)
            features = db.read_keypoints(image.image_id)[:, :2]
            np.testing.assert_allclose([p.xy for p in there.points2D], features, atol=1e-4)
        assert set(merged.rigs) == {rig.rig_id for rig in db.read_all_rigs()}


def test_a_ladder_without_rungs_is_wrong_usage():
    with pytest.raises(UsageError, match="at least one rung"):
        replace(CONFIG, max_rungs=0)
