from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic import Scene, orbit, write_sequence

from dope.common.errors import BadInput
from pipeline.cameras.sparse_points import Tracks
from pipeline.geometry import Camera
from pipeline.masks.grabcut import grabcut_masks
from pipeline.masks.imported import MasksConfig
from pipeline.masks.object_region import ball_silhouette, pixels_of, points_on_object, support_plane
from pipeline.masks.visual_hull import visual_hull
from pipeline.sequence import Sequence

cv2.setNumThreads(1)


def seen_points(scene: Scene, cameras: list[Camera], *, each: int = 60, noise: float = 0.01) -> Tracks:
    """Points on object, floor and sky at random pixels of the views, each seen by the view it comes from and others."""
    rng = np.random.default_rng(0)
    found = []
    for camera in cameras:
        pixels = rng.uniform([0, 0], [camera.width, camera.height], (each, 2))
        points, depth, _ = scene.trace(camera, pixels)
        found.append(points[depth < 60] + rng.normal(0, noise, (int((depth < 60).sum()), 3)))
    xyz = np.concatenate(found)
    index, frame = [], []
    for number, camera in enumerate(cameras):
        pixels, depth = camera.project(xyz)
        _, surface, _ = scene.trace(camera, pixels)
        inside = (pixels > 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
        seen = np.flatnonzero(inside & (np.abs(surface - depth) < 0.05))
        index.append(seen)
        frame.append(np.full(len(seen), number))
    return Tracks(xyz, np.concatenate(index), np.concatenate(frame))


def small_orbit(n: int, distortion: tuple = (0, 0, 0, 0)) -> list[Camera]:
    return orbit(n, width=200, height=150, focal=240, distortion=distortion)


def ious(sequence: Sequence, scene: Scene, cameras: list[Camera]) -> np.ndarray:
    values = []
    for row, camera in zip(sequence.read_frames(), cameras, strict=True):
        mask, truth = sequence.read_mask(row), scene.render(camera)[2]
        assert mask is not None and mask.shape == truth.shape
        values.append((mask & truth).sum() / (mask | truth).sum())
    return np.array(values)


@pytest.mark.parametrize("shape, distortion", [("sphere", (0, 0, 0, 0)), ("box", (-0.15, 0.03, 0.002, -0.001))])
def test_the_object_is_cut_out_from_points_alone(tmp_path: Path, shape: str, distortion: tuple) -> None:
    scene = Scene(shape)  # type: ignore[arg-type]
    cameras = small_orbit(9, distortion=distortion)
    sequence = write_sequence(tmp_path / "a", cameras, scene, masks=False, depths=False)
    details = grabcut_masks(sequence, seen_points(scene, cameras), MasksConfig())
    found = ious(sequence, scene, cameras)
    assert np.median(found) > 0.95 and found.min() > 0.85, found
    assert details["masks"] == 9 and details["missing"] == details["empty"] == 0
    assert details["support_plane"] and details["agreement"] > 0.85


def test_the_same_input_gives_the_same_masks(tmp_path: Path) -> None:
    scene, cameras, contents = Scene(), small_orbit(4), []
    points = seen_points(scene, cameras)
    for name in ("a", "b"):
        sequence = write_sequence(tmp_path / name, cameras, scene, masks=False, depths=False)
        cv2.setRNGSeed(len(contents))  # what ran before in the process must not matter
        grabcut_masks(sequence, points, MasksConfig())
        contents.append([path.read_bytes() for path in sorted(sequence.masks.iterdir())])
    assert contents[0] == contents[1] and len(contents[0]) == 4


def test_frames_without_a_camera_have_no_mask_and_no_points_are_an_error(tmp_path: Path) -> None:
    scene, cameras = Scene(), small_orbit(5)
    sequence = write_sequence(tmp_path / "a", cameras, scene, masks=False, depths=False)
    points = seen_points(scene, cameras)
    rows = sequence.read_frames()
    rows[3].clear_camera()
    sequence.write_frames(rows)
    details = grabcut_masks(sequence, points, MasksConfig())
    assert details["missing_frames"] == ["0003.jpg"] and sequence.read_frames()[3].mask is None
    far = Tracks(points.xyz + 50, points.point_index, points.frame)
    with pytest.raises(BadInput, match="no reconstructed point"):
        grabcut_masks(sequence, far, MasksConfig())
    for row in rows:
        row.clear_camera()
    sequence.write_frames(rows)
    with pytest.raises(BadInput, match="no registered frames"):
        grabcut_masks(sequence, points, MasksConfig())


def test_the_floor_is_found_and_a_flat_side_is_not_taken_for_it() -> None:
    scene = Scene("box")
    cameras = orbit(12)
    points = seen_points(scene, cameras).xyz
    plane = support_plane(points, cameras)
    assert plane is not None and plane.normal @ [0, 0, 1] > 0.99
    assert plane.offset == pytest.approx(0.75, abs=0.05), "the cameras' side is positive"
    height, radius = points[:, 2] - scene.floor_z, np.linalg.norm(points, axis=1)
    is_box, clear = height > 0.08, (np.abs(height - 0.04) > 0.04) & (np.abs(radius - 1.5) > 0.1)
    on_object = points_on_object(points, plane, radius=1.5)
    np.testing.assert_array_equal(on_object[clear], (is_box & (radius < 1.5))[clear])
    assert support_plane(points[is_box], cameras) is None


@pytest.mark.parametrize("distance", [5.0, 1.15])
def test_the_balls_silhouette_is_what_rays_hit(distance: float) -> None:
    (camera,) = orbit(1, distance=distance, distortion=(-0.1, 0.02, 0.001, 0.001))
    mask = Scene("sphere").render(camera)[2]
    inside = Scene("sphere").trace(camera, np.array([[160.0, 120.0]]))[2]
    assert inside[0] == 1
    assert (ball_silhouette(camera, 1.0) != mask).mean() < 2e-3


def test_a_camera_within_the_ball_sees_nothing_but_it() -> None:
    (camera,) = orbit(1, distance=0.5)
    assert ball_silhouette(camera, 1.0).all()


def test_the_hull_of_a_spheres_silhouettes_is_the_sphere() -> None:
    cameras = [*orbit(10, elevation_deg=-20), *orbit(10, elevation_deg=20), *orbit(6, elevation_deg=60)]
    cameras = [camera.resized(160, 120) for camera in cameras]
    masks = [ball_silhouette(camera, 1.0) for camera in cameras]
    masks[4] = np.zeros_like(masks[4])  # one view in which nothing was found does not carve everything away
    hull = visual_hull(masks, cameras, radius=1.2, share=0.85, voxels=48)
    volume = len(hull) * (2.4 / 48) ** 3
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.1)
    assert np.linalg.norm(hull, axis=1).max() < 1.15
    assert len(visual_hull(masks, cameras, radius=1.2, share=1.0, voxels=48)) == 0


def test_points_fall_into_the_pixel_that_shows_them() -> None:
    (camera,) = orbit(1)
    pixels = np.array([[0.2, 0.7], [100.9, 40.1], [319.5, 239.5], [320.5, 3.0], [-0.5, 3.0]])
    found = pixels_of(camera.unproject(pixels, np.full(5, 4.0)), camera)
    assert found.tolist() == [[0, 0], [40, 100], [239, 319]]
    behind = camera.centre - camera.direction
    assert len(pixels_of(behind[None], camera)) == 0
