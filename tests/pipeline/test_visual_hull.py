from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pycocotools import mask as coco
from synthetic import Scene, look_at, orbit, write_sequence

from pipeline.cameras.compare import read_reference
from pipeline.geometry import Camera, Similarity, nearest_point_to_axes
from pipeline.masks.agreement import check_across_views, forget_check
from pipeline.masks.imported import MasksConfig, import_masks
from pipeline.masks.mask_io import read_mask_values
from pipeline.masks.visual_hull import HullConfig, check_masks, visual_hull
from pipeline.sequence import Sequence

CAPTURES = Path(__file__).parents[2].parent / "shared/data/captures"
COARSE = HullConfig(voxels=48)

Masks = list[np.ndarray]


def box_views(n: int = 20, **where: float) -> tuple[Masks, list[Camera]]:
    cameras = orbit(n, width=160, height=120, focal=190.0, **where)  # type: ignore[arg-type]
    return [Scene("box").render(camera)[2] for camera in cameras], cameras


def right_half(masks: Masks, i: int) -> np.ndarray:
    mask = masks[i].copy()
    mask[:, : int(np.median(np.nonzero(mask)[1]))] = False
    return mask


DAMAGE: dict[str, Callable[[Masks, int], np.ndarray]] = {
    "moved": lambda masks, i: np.roll(masks[i], 25, axis=1),
    "complement": lambda masks, i: ~masks[i],
    "empty": lambda masks, i: masks[i] & False,
    "full": lambda masks, i: masks[i] | True,
    "half of it": right_half,
    "upside down and moved": lambda masks, i: np.roll(masks[i][::-1], 30, axis=0),
}


@pytest.mark.parametrize("kind", DAMAGE)
@pytest.mark.parametrize("n", [10, 20])
def test_exactly_the_damaged_mask_is_flagged(kind: str, n: int) -> None:
    masks, cameras = box_views(n)
    clean = check_masks(masks, cameras, COARSE)
    assert clean.flags == [None] * n and clean.note is None and clean.iou.min() > 0.75
    bad = n // 3
    masks[bad] = DAMAGE[kind](masks, bad)
    check = check_masks(masks, cameras, COARSE)
    assert [i for i, flag in enumerate(check.flags) if flag] == [bad]
    flag = str(check.flags[bad])
    assert ("empty, but the object is in view" if kind == "empty" else "disagrees") in flag and "median 0." in flag


def test_several_damaged_masks_are_flagged_together() -> None:
    masks, cameras = box_views(20)
    bad = [1, 6, 7, 12, 18]
    for i, kind in zip(bad, DAMAGE, strict=False):
        masks[i] = DAMAGE[kind](masks, i)
    check = check_masks(masks, cameras, COARSE)
    assert [i for i, flag in enumerate(check.flags) if flag] == bad


def test_a_view_through_a_hole_that_no_other_sees_is_right() -> None:
    """A flat ring: one view looks through it from above, the others from the side see it closed."""
    n, K = 12, np.array([[190.0, 0, 80], [0, 190.0, 60], [0, 0, 1]])
    angle = 2 * np.pi * np.arange(n) / n
    centres = np.stack([5 * np.cos(angle), 5 * np.sin(angle), np.full(n, 0.4)], axis=1)
    centres[0] = [1.2, 0, 5]
    cameras = [Camera(160, 120, K, np.zeros(4), *look_at(centre, np.zeros(3))) for centre in centres]
    around = np.linspace(0, 2 * np.pi, 400)
    radius, height = np.meshgrid(np.linspace(0.75, 1, 20), np.linspace(-0.15, 0.15, 20))
    ring = np.stack([np.outer(np.cos(around), radius.ravel()).ravel(), np.outer(np.sin(around), radius.ravel()).ravel(),
                     np.tile(height.ravel(), len(around))], axis=1)  # fmt: skip
    masks = []
    for camera in cameras:
        column, row = np.floor(camera.project(ring)[0]).astype(int).T
        masks.append(np.zeros((120, 160), bool))
        masks[-1][row, column] = True
    check = check_masks(masks, cameras, COARSE)
    assert check.iou[0] < check.median - COARSE.below and check.flags == [None] * n
    masks[0] = right_half(masks, 0)
    assert [i for i, flag in enumerate(check_masks(masks, cameras, COARSE).flags) if flag] == [0]


def test_what_cannot_be_checked_is_said_and_not_flagged() -> None:
    masks, cameras = box_views(20)
    few = check_masks(masks[:4], cameras[:4], COARSE)
    assert few.note == "masks not checked: 4 registered frames have one, 5 are needed"
    masks, cameras = box_views(8, arc_deg=20.0, wobble=0.0)
    cone = check_masks(masks, cameras, COARSE)
    assert cone.note == "masks not checked: all views lie within 30 degrees" and np.isnan(cone.iou).all()
    masks, cameras = box_views(20)
    noise = [np.random.default_rng(i).random(mask.shape) < 0.02 for i, mask in enumerate(masks)]
    check = check_masks(noise, cameras, COARSE)
    assert check.note is not None and "no common visual hull" in check.note and check.flags == [None] * 20
    assert check_masks([], [], COARSE).note is not None


def test_the_check_is_noted_dropped_and_forgotten(tmp_path: Path) -> None:
    cameras = orbit(10, width=160, height=120, focal=190.0)
    sequence = write_sequence(tmp_path / "box", cameras, Scene("box"), depths=False)
    frames = sequence.read_frames()
    sequence.write_mask(frames[4], np.zeros((120, 160), bool))
    frames[7].mask = None
    sequence.write_frames(frames)
    before = (sequence.folder / "frames.parquet").read_bytes()

    kept = check_across_views(sequence, COARSE, "keep")
    assert kept["flagged"] == 1 and kept["flagged_frames"] == ["0004.jpg"] and kept["hull_iou"] > 0.8
    rows = sequence.read_frames()
    assert rows[4].mask is not None and "empty" in str(rows[4].mask_flag) and rows[4].mask_iou == 0
    assert rows[7].mask_iou is None and rows[7].mask_flag is None and (rows[0].mask_iou or 0) > 0.8

    for _ in range(2):  # a second run starts from all masks
        assert check_across_views(sequence, COARSE, "drop") == kept
        assert [row.frame for row in sequence.read_frames() if row.mask is None] == [4, 7]
    forget_check(sequence)
    assert (sequence.folder / "frames.parquet").read_bytes() == before


def test_sequences_without_cameras_are_not_checked(tmp_path: Path) -> None:
    sequence = write_sequence(tmp_path / "box", orbit(6, width=64, height=48), Scene("box"), depths=False)
    frames = sequence.read_frames()
    for frame in frames:
        frame.clear_camera()
    sequence.write_frames(frames)
    details = check_across_views(sequence, COARSE, "drop")
    assert details["hull_iou"] is None and details["flagged"] == 0 and "not checked" in details["hull_note"]


@pytest.mark.filterwarnings("ignore:__array__:DeprecationWarning")
def test_the_consistent_pick_finds_the_object_among_better_scored_things(tmp_path: Path) -> None:
    """Parts, the whole image, blots and a second object that stands beside it, all with higher scores."""
    cameras = orbit(12, width=160, height=120, focal=150.0)
    sequence = write_sequence(tmp_path / "box", cameras, Scene("box"), depths=False)
    truth = [mask for frame in sequence.read_frames() if (mask := sequence.read_mask(frame)) is not None]
    rng, instances = np.random.default_rng(0), []
    for i, (mask, camera) in enumerate(zip(truth, cameras, strict=True)):
        beside, _ = camera.project(np.array([[1.6, 0.3, -0.5]]))
        y, x = np.mgrid[:120, :160] + 0.5
        second = np.hypot(x - beside[0, 0], y - beside[0, 1]) < 16
        blot = np.zeros_like(mask)
        top, left = rng.integers(0, 80, 2)
        blot[top : top + 40, left : left + 60] = True
        things = [(mask, 0.8), (right_half(truth, i), 0.85), (mask | True, 0.95), (blot, 0.9), (second, 0.9)]
        for thing, score in things:
            if thing.any():
                encoded = coco.encode(np.asfortranarray(thing.astype(np.uint8)))
                segmentation = {"size": [120, 160], "counts": encoded["counts"].decode()}
                instances.append({"image_id": i, "segmentation": segmentation, "score": score})
    path = tmp_path / "results.json"
    path.write_text(json.dumps(instances))
    right = {}
    for rule in ("score", "centre", "consistent"):
        config = MasksConfig(pick=rule, hull=COARSE)  # type: ignore[arg-type]
        assert import_masks(sequence, path, config)["pick"] == rule
        masks = [sequence.read_mask(frame) for frame in sequence.read_frames()]
        right[rule] = sum(bool((a == b).all()) for a, b in zip(masks, truth, strict=True))
    assert right["consistent"] == 12 and right["score"] == 0


def capture(name: str) -> tuple[Masks, list[Camera]]:
    """Masks and cameras of a capture, its object in the middle with radius 1."""
    reference = read_reference(CAPTURES / name / "cameras.json")
    cameras = [reference[stem] for stem in sorted(reference)]
    masks = [read_mask_values(CAPTURES / name / f"masks/{stem}.png") > 0.5 for stem in sorted(reference)]
    centre = nearest_point_to_axes(cameras)
    radius = 0.35 * float(np.median([np.linalg.norm(camera.centre - centre) for camera in cameras]))
    for _ in range(3):
        cameras = [camera.transformed(Similarity(1 / radius, np.eye(3), -centre / radius)) for camera in cameras]
        hull = visual_hull(masks, cameras, radius=2.0, share=0.9, voxels=48)
        centre = (hull.min(axis=0) + hull.max(axis=0)) / 2
        radius = float(np.percentile(np.linalg.norm(hull - centre, axis=1), 98))
    return masks, cameras


@pytest.mark.captures
@pytest.mark.skipif(bool(os.environ.get("CI")) or not CAPTURES.is_dir(), reason="needs the captures in ../shared/data")
@pytest.mark.parametrize("name", ["mold_gold_cape", "ethiopian_head"])
def test_real_masks_agree_and_damaged_ones_do_not(name: str) -> None:
    masks, cameras = capture(name)
    config = HullConfig(voxels=64)
    clean = check_masks(masks, cameras, config)
    assert clean.median > 0.93 and clean.flags == [None] * len(masks)
    for i, kind in zip((3, 29), ("complement", "half of it"), strict=True):
        damaged: list[Any] = list(masks)
        damaged[i] = DAMAGE[kind](masks, i)
        check = check_masks(damaged, cameras, config)
        assert [j for j, flag in enumerate(check.flags) if flag] == [i], kind


def test_a_sequence_of_its_own_is_not_touched_by_reading(tmp_path: Path) -> None:
    sequence = write_sequence(tmp_path / "box", orbit(3, width=64, height=48), depths=False)
    before = (sequence.folder / "frames.parquet").stat().st_mtime_ns
    forget_check(Sequence(sequence.folder))
    assert (sequence.folder / "frames.parquet").stat().st_mtime_ns == before
