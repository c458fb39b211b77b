"""COLMAP's dense workspace, real but for CUDA: undistorted by COLMAP, depth and normals written by the test."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from synthetic import OBJECT, Scene, orbit, pixel_centres, write_sequence

from dope.common.errors import BadInput
from pipeline.cameras import colmap
from pipeline.depth.imported import import_depth_folder
from pipeline.depth.mvs import DepthConfig, compute_depth
from pipeline.ply import read_ply
from pipeline.sequence import Sequence

SCENE = Scene()
CAMERAS = orbit(7, arc_deg=49, distance=4.5, distortion=(0.2, -0.1, 0.003, -0.002), wobble=0.05)
CONFIG = DepthConfig(long_side=240, fused=True)


@pytest.fixture
def sequence(rendered: Sequence, tmp_path: Path) -> Sequence:
    return Sequence(Path(shutil.copytree(rendered.folder, tmp_path / "ball")))


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """A reconstructed sequence: photos with lens distortion and a sparse model of COLMAP."""
    found = write_sequence(tmp_path_factory.mktemp("dense") / "ball", CAMERAS, SCENE, depths=False)
    frames = found.read_frames()
    for frame in frames:
        frame.source_name = f"{frame.frame:06d}.jpg"
    found.write_frames(frames)
    info = found.read_info()
    info.kind = "photos"
    found.write_info(info)
    pixels = pixel_centres(CAMERAS[3].width, CAMERAS[3].height)
    points, _, what = SCENE.trace(CAMERAS[3], pixels)
    chosen = np.random.default_rng(0).choice(np.flatnonzero(what == OBJECT), 100, replace=False)
    seen = []
    for i, camera in enumerate(CAMERAS):
        moved, visible = SCENE.transfer(CAMERAS[3], pixels[chosen], camera)
        seen.append((i, np.flatnonzero(visible), moved[visible]))
    model = colmap.model_of_cameras(dict(enumerate(CAMERAS)), list(range(7)))
    model = colmap.add_points(model, points[chosen], np.zeros((100, 3), np.uint8), seen)
    found.sparse.mkdir(exist_ok=True)
    model.write(found.sparse)
    return found


def colmap_array(values: np.ndarray) -> bytes:
    """(h, w) or (h, w, channels) as COLMAP writes it."""
    height, width, *channels = values.shape
    planes = values.astype("<f4").reshape(height, width, -1).transpose(2, 0, 1)
    return f"{width}&{height}&{channels[0] if channels else 1}&".encode() + planes.tobytes()


def play_patch_match(workspace: Path, **_: object) -> None:
    """Write true geometric depth and normals of the undistorted views, as PatchMatch would."""
    for i, camera in colmap.read_model(workspace / "sparse").cameras().items():
        pixels = pixel_centres(camera.width, camera.height)
        points, depth, what = SCENE.trace(camera, pixels)
        normals = np.where((what == OBJECT)[:, None], points, [0, 0, 1.0]) @ camera.R.T
        size = camera.height, camera.width
        stereo = workspace / "stereo"
        depth = np.where(depth > 100, 0, depth).reshape(size)
        (stereo / "depth_maps" / f"{i:06d}.jpg.geometric.bin").write_bytes(colmap_array(depth))
        (stereo / "normal_maps" / f"{i:06d}.jpg.geometric.bin").write_bytes(colmap_array(normals.reshape(*size, 3)))


@pytest.fixture
def played_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colmap, "has_cuda_gpu", lambda: True)
    monkeypatch.setattr(colmap, "patch_match", play_patch_match)


def errors_on_the_object(sequence: Sequence) -> np.ndarray:
    """Relative errors of the object's pixels against the distorted truth; NaN where depth is unknown."""
    errors = []
    for frame, camera in zip(sequence.read_frames(), CAMERAS, strict=True):
        depth = sequence.read_depth(frame)
        assert depth is not None
        _, truth, mask = SCENE.render(camera.resized(depth.shape[1], depth.shape[0]))
        errors.append(np.where(depth[mask] > 0, np.abs(depth[mask] / truth[mask] - 1), np.nan))
    return np.concatenate(errors)


def test_depth_of_undistorted_images_comes_back_to_the_photos(sequence: Sequence, played_cuda: None) -> None:
    details = compute_depth(sequence, CONFIG)
    assert details["method"] == "patchmatch_depth" and details["frames_without_depth"] == []
    errors = errors_on_the_object(sequence)
    assert np.isfinite(errors).mean() > 0.93
    assert np.nanmedian(errors) < 3e-4 and np.nanquantile(errors, 0.97) < 0.005
    assert not list(sequence.folder.glob(".*"))  # the workspace is gone


def test_fused_points_lie_on_the_surfaces(sequence: Sequence, played_cuda: None) -> None:
    compute_depth(sequence, CONFIG)
    points = read_ply(sequence.folder / "fused.ply")
    xyz, rgb = points.xyz, points.rgb
    radius = np.linalg.norm(xyz, axis=1)
    xyz, radius = xyz[radius < 3], radius[radius < 3]
    off = np.minimum(np.abs(radius - 1), np.abs(xyz[:, 2] - SCENE.floor_z))
    assert len(xyz) > 2000 and np.quantile(off, 0.95) < 0.01
    assert (np.abs(radius - 1) < 0.01).sum() > 500 and rgb.std() > 20


def test_what_floats_before_the_object_in_one_map_is_removed(
    sequence: Sequence, played_cuda: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def play_badly(workspace: Path, **_: object) -> None:
        play_patch_match(workspace)
        camera = colmap.read_model(workspace / "sparse").cameras()[3]
        depth = SCENE.render(camera)[1]
        depth[80:100, 110:130] *= 0.8
        (workspace / "stereo" / "depth_maps" / "000003.jpg.geometric.bin").write_bytes(colmap_array(depth))

    monkeypatch.setattr(colmap, "patch_match", play_badly)
    compute_depth(sequence, DepthConfig(long_side=240))
    errors = errors_on_the_object(sequence)  # 0.2 where it floats; a few pixels of the outline show the floor
    assert np.sum((errors > 0.15) & (errors < 0.25)) < 40 and np.isfinite(errors).mean() > 0.92
    assert not (sequence.folder / "fused.ply").exists()


def test_a_workspace_made_elsewhere_can_be_imported(sequence: Sequence, tmp_path: Path) -> None:
    workspace = tmp_path / "dense"
    colmap.undistort(sequence.sparse, sequence.images, workspace)
    play_patch_match(workspace)
    details = import_depth_folder(sequence, workspace / "stereo" / "depth_maps", CONFIG)
    assert details["frames_with_depth"] == 7 and details["scale_from"] == "cameras" and details["scale"] == 1
    errors = errors_on_the_object(sequence)
    assert np.nanmedian(errors) < 3e-4 and np.nanquantile(errors, 0.97) < 0.005

    (workspace / "sparse").rename(tmp_path / "elsewhere")
    with pytest.raises(BadInput, match=r"undistorted image, which differs from '000000.jpg' by up to \d+\.\d px"):
        import_depth_folder(sequence, workspace / "stereo" / "depth_maps", CONFIG)
