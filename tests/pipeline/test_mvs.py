"""The depth stage on rendered sequences whose depth is known, and on a real capture."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from synthetic import Scene, orbit, pixel_centres, write_sequence

from dope.common.errors import BadInput
from pipeline.cameras.sparse_points import Tracks
from pipeline.depth import mvs, patchmatch
from pipeline.depth.mvs import DepthConfig, object_centre, sgbm_depth, sparse_depth, write_depths
from pipeline.depth.readers import read_colmap_array
from pipeline.geometry import Camera
from pipeline.sequence import Sequence

SCENE = Scene()
CAMERAS = orbit(7, arc_deg=49, distance=4.5, distortion=(0.05, -0.07, 0.001, -0.001), wobble=0.05)
CONFIG = DepthConfig(long_side=240)
CAPTURES = Path(__file__).parents[2].parent / "shared/data/captures"


def tracks_of(cameras: list[Camera], count: int = 150) -> Tracks:
    """Points on the object with the frames that really see them."""
    pixels = pixel_centres(cameras[3].width, cameras[3].height)
    points, _, what = SCENE.trace(cameras[3], pixels)
    on_object = np.flatnonzero(what == 1)
    chosen = np.random.default_rng(0).choice(on_object, count, replace=False)
    xyz, index, frame = points[chosen], [], []
    for number, camera in enumerate(cameras):
        _, visible = SCENE.transfer(cameras[3], pixels[chosen], camera)
        index.append(np.flatnonzero(visible))
        frame.append(np.full(visible.sum(), number))
    return Tracks(xyz, np.concatenate(index), np.concatenate(frame))


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return write_sequence(tmp_path_factory.mktemp("mvs") / "ball", CAMERAS, SCENE, depths=False, supersample=2)


@pytest.fixture
def sequence(rendered: Sequence, tmp_path: Path) -> Sequence:
    return Sequence(Path(shutil.copytree(rendered.folder, tmp_path / "ball")))


def truth_of(camera: Camera, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    _, depth, mask = SCENE.render(camera.resized(*size))
    return depth, mask


def test_depth_covers_the_object_and_is_true(sequence: Sequence) -> None:
    details = write_depths(sequence, tracks_of(CAMERAS), CONFIG, sgbm_depth)
    frames = sequence.read_frames()
    assert details["frames_with_depth"] == 7 and details["frames_without_depth"] == []
    coverage, errors = [], []
    for frame in frames:
        depth = sequence.read_depth(frame)
        assert depth is not None and depth.shape == (180, 240) and frame.depth == f"depths/{frame.frame:06d}.png"
        truth, mask = truth_of(frame.camera, (240, 180))
        known = mask & (depth > 0)
        coverage.append(known.sum() / mask.sum())
        errors.append(np.abs(depth[known] / truth[known] - 1))
    error = np.concatenate(errors)
    assert np.mean(coverage[1:-1]) > 0.9 and min(coverage) > 0.75
    assert np.median(error) < 0.003 and (error < 0.01).mean() > 0.95
    assert details["sparse_points_compared"] > 300 and details["sparse_within_1_percent"] > 0.95
    assert details["mask_coverage"] > details["coverage"] > 0.05
    json.dumps(details, allow_nan=False)


def test_threads_do_not_change_a_byte_and_old_depth_is_gone(sequence: Sequence) -> None:
    tracks = tracks_of(CAMERAS)
    write_depths(sequence, tracks, CONFIG, sgbm_depth)
    first = {path.name: path.read_bytes() for path in sequence.depths.iterdir()}
    (sequence.depths / "000099.png").write_bytes(b"of an earlier run")
    write_depths(sequence, tracks, DepthConfig(long_side=240, threads=4), sgbm_depth)
    assert {path.name: path.read_bytes() for path in sequence.depths.iterdir()} == first


def test_a_failing_method_leaves_no_depth_behind(sequence: Sequence) -> None:
    write_depths(sequence, tracks_of(CAMERAS), CONFIG, sparse_depth)

    def failing(*_: object) -> list:
        raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError):
        write_depths(sequence, tracks_of(CAMERAS), CONFIG, failing)
    assert all(frame.depth is None and frame.depth_scale is None for frame in sequence.read_frames())
    assert not sequence.depths.exists()


def test_masks_that_were_made_later_do_not_limit_depth(sequence: Sequence) -> None:
    regions = []

    def look(_: Sequence, frames: list, views: list, *__: object) -> list:
        regions.append({view.region is None for view in views})
        return [None] * len(frames)

    info = sequence.read_info()
    for info.masks_from in ("input", "grabcut", None):
        sequence.write_info(info)
        write_depths(sequence, tracks_of(CAMERAS), CONFIG, look)
    assert regions == [{False}, {True}, {False}]


def test_views_without_neighbours_get_no_depth(sequence: Sequence) -> None:
    frames = sequence.read_frames()
    for frame in frames[1:6]:
        frame.clear_camera()
    sequence.write_frames(frames)  # what is left is 42 degrees apart
    details = write_depths(sequence, tracks_of(CAMERAS), CONFIG, sgbm_depth)
    assert details["frames_without_depth"] == [0, 6] and "empty" in details
    frames[0].clear_camera()
    sequence.write_frames(frames)
    with pytest.raises(BadInput, match="1 registered"):
        write_depths(sequence, tracks_of(CAMERAS), CONFIG, sgbm_depth)


def test_frames_without_depth_count_in_every_figure(sequence: Sequence) -> None:
    def one_of(_: Sequence, frames: list, views: list, *__: object) -> list:
        truth = [SCENE.render(view.camera)[1] for view in views]
        return [truth[0], np.zeros_like(truth[0]), *[None] * (len(frames) - 2)]

    details = write_depths(sequence, tracks_of(CAMERAS), CONFIG, one_of)
    assert details["frames_with_depth"] == 1 and details["frames_without_depth"] == [1, 2, 3, 4, 5, 6]
    assert details["mask_coverage"] == pytest.approx(1 / 7, rel=0.02) and "empty" not in details
    assert [frame.depth is not None for frame in sequence.read_frames()] == [True] + [False] * 6

    def nothing(_: Sequence, frames: list, views: list, *__: object) -> list:
        return [np.zeros(view.gray.shape, np.float32) for view in views]

    details = write_depths(sequence, tracks_of(CAMERAS), CONFIG, nothing)
    assert details["frames_with_depth"] == 0 and details["empty"].startswith("no pixel of any frame")
    assert not sequence.depths.exists()


def test_sparse_depth_is_that_of_the_observed_points(sequence: Sequence) -> None:
    tracks = tracks_of(CAMERAS)
    # a point hidden behind another one at the same pixel: the nearer counts
    camera = CAMERAS[2]
    behind = camera.centre + 1.3 * (tracks.xyz[:1] - camera.centre)
    point = len(tracks.xyz)
    tracks = Tracks(
        np.concatenate([tracks.xyz, behind]), np.append(tracks.point_index, [point]), np.append(tracks.frame, [2])
    )
    details = write_depths(sequence, tracks, CONFIG, sparse_depth)
    assert details["method"] == "sparse_depth" and details["sparse_median_error"] < 1e-3
    for frame in sequence.read_frames():
        depth = sequence.read_depth(frame)
        assert depth is not None
        pixels, z = frame.camera.resized(240, 180).project(tracks.seen_by(frame.frame))
        expected: dict[tuple[int, int], float] = {}
        for (x, y), value in zip(pixels, z, strict=True):
            key = int(y), int(x)
            expected[key] = min(value, expected.get(key, np.inf))
        assert np.count_nonzero(depth) == len(expected)
        for key, value in expected.items():
            assert depth[key] == pytest.approx(value, rel=1e-3)


def test_tracks_select_points_by_frame_and_length() -> None:
    tracks = Tracks(np.arange(9.0).reshape(3, 3), np.array([0, 0, 1, 2, 2, 2]), np.array([4, 5, 4, 4, 5, 6]))
    assert tracks.seen_by(6).tolist() == [[6, 7, 8]] and len(tracks.seen_by(7)) == 0
    assert tracks.longer_than(3).seen_by(4).tolist() == [[6, 7, 8]]
    assert tracks.longer_than(2).seen_by(5).tolist() == [[0, 1, 2], [6, 7, 8]]


def test_the_centre_is_the_origin_only_of_a_normalised_sequence(sequence: Sequence) -> None:
    views = [mvs.load_view(sequence, frame, tracks_of(CAMERAS), CONFIG) for frame in sequence.read_frames()]
    assert object_centre(sequence, views).tolist() == [0, 0, 0]
    info = sequence.read_info()
    info.unit = "arbitrary"
    sequence.write_info(info)
    centre = object_centre(sequence, views)
    assert centre.any() and np.linalg.norm(centre) < 0.3  # they look at the ball, a little beside its middle


def test_patchmatch_without_a_gpu_is_refused(sequence: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipeline.cameras import colmap

    monkeypatch.setattr(colmap, "has_cuda_gpu", lambda: False)
    monkeypatch.setattr(colmap, "read_points", lambda _: tracks_of(CAMERAS))
    with pytest.raises(BadInput, match="CUDA"):
        mvs.compute_depth(sequence, DepthConfig(backend="patchmatch"))
    details = mvs.compute_depth(sequence, DepthConfig(mode="sparse", backend="patchmatch"))
    assert details["method"] == "sparse_depth"


# ---------------------------------------------------------------------------------- depth maps of COLMAP's PatchMatch


def colmap_array(values: np.ndarray) -> bytes:
    """The format of COLMAP's Mat<float>: x runs fastest, then y, then channels."""
    height, width = values.shape[:2]
    planes = values.reshape(height, width, -1).transpose(2, 0, 1)
    return f"{width}&{height}&{planes.shape[0]}&".encode() + planes.astype("<f4").tobytes()


@pytest.mark.parametrize("shape", [(5, 7), (4, 6, 3)])
def test_colmap_arrays_are_read_in_their_order(tmp_path: Path, shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(0).uniform(size=shape).astype(np.float32)
    path = tmp_path / "000000.jpg.geometric.bin"
    path.write_bytes(colmap_array(values))
    assert np.array_equal(read_colmap_array(path), values)


@pytest.mark.parametrize("data", [b"", b"7&5&", b"7&5&1&" + bytes(11), b"7&5&1&" + bytes(7 * 5 * 4 + 4), b"a&b&c&dd"])
def test_damaged_colmap_arrays_are_refused_by_name(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "000000.jpg.geometric.bin"
    path.write_bytes(data)
    with pytest.raises(BadInput, match=r"000000\.jpg\.geometric\.bin"):
        read_colmap_array(path)


def test_undistorted_depth_returns_to_the_distorted_grid() -> None:
    camera = CAMERAS[0].resized(240, 180)
    wide = np.array([[300.0, 0, 140], [0, 300.0, 105], [0, 0, 1]])
    pinhole = Camera(280, 210, wide, np.zeros(4), camera.R, camera.t)
    depth, mask = SCENE.render(pinhole)[1:]
    found = patchmatch.redistorted(np.where(mask, depth, -1).astype(np.float32), pinhole, camera)
    truth, on_ball = truth_of(camera, (240, 180))
    known = found > 0
    assert (known & on_ball).sum() > 0.93 * on_ball.sum() and not (known & ~on_ball).sum() > 20
    error = np.abs(found / np.maximum(truth, 1e-6) - 1)[known & on_ball]
    assert np.median(error) < 2e-4 and np.percentile(error, 99) < 0.01
    assert not patchmatch.redistorted(np.zeros((210, 280), np.float32), pinhole, camera).any()


def test_patchmatch_workspace_becomes_depth_maps(sequence: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    """CUDA is played by a function that writes true depth where COLMAP would; frame 6 it leaves out."""
    from pipeline.cameras import colmap

    pinholes = {i: Camera(280, 210, np.array([[300.0, 0, 140], [0, 300, 105], [0, 0, 1]]), np.zeros(4), c.R, c.t)
                for i, c in enumerate(CAMERAS)}  # fmt: skip

    def play_cuda(workspace: Path, **_: object) -> None:
        folder = workspace / "stereo" / "depth_maps"
        folder.mkdir(parents=True)
        for i in range(6):
            depth = SCENE.render(pinholes[i])[1]
            (folder / f"{i:06d}.jpg.geometric.bin").write_bytes(colmap_array(depth))

    class Model:
        def cameras(self) -> dict[int, Camera]:
            return pinholes

    monkeypatch.setattr(colmap, "has_cuda_gpu", lambda: True)
    monkeypatch.setattr(colmap, "read_points", lambda _: tracks_of(CAMERAS))
    monkeypatch.setattr(colmap, "undistort", lambda *_, **__: None)
    monkeypatch.setattr(colmap, "patch_match", play_cuda)
    monkeypatch.setattr(colmap, "read_model", lambda _: Model())
    details = mvs.compute_depth(sequence, CONFIG)
    assert details["method"] == "patchmatch_depth" and details["frames_without_depth"] == [6]
    assert details["sparse_median_error"] < 1e-3 and details["mask_coverage"] > 0.8  # one of seven has none
    assert not list(sequence.folder.glob(".patchmatch-*"))


# ---------------------------------------------------------------------------------------------------- a real capture


@pytest.mark.captures
@pytest.mark.skipif(
    bool(os.environ.get("CI")) or not (CAPTURES / "ethiopian_head").exists(), reason="needs ../shared/data/captures"
)
def test_depth_of_a_bronze_head_on_a_turntable(tmp_path: Path) -> None:
    """Six real photos with the capture's own cameras; the silhouettes bound where the depth may lie."""
    import cv2

    from pipeline.sequence import Frame, SequenceInfo, read_image

    source, sequence = CAPTURES / "ethiopian_head", Sequence(tmp_path / "head")
    given = json.loads((source / "cameras.json").read_text())["frames"][20:26]
    frames = []
    for i, row in enumerate(given):
        frame = Frame(i, row["name"], row["width"], row["height"], image=f"images/{i:06d}.jpg")
        K = np.array([[row["fx"], 0, row["cx"]], [0, row["fy"], row["cy"]], [0, 0, 1]])
        pose = np.array(row["w2c_R"]), np.array(row["w2c_t"])
        frame.set_camera(Camera(row["width"], row["height"], K, np.zeros(4), *pose))
        sequence.images.mkdir(parents=True, exist_ok=True)
        stem = Path(row["name"]).stem
        shutil.copy(source / "images" / f"{stem}.jpg", sequence.folder / f"images/{i:06d}.jpg")
        sequence.write_mask(frame, read_image(source / "masks" / f"{stem}.png", cv2.IMREAD_GRAYSCALE) > 0)
        frames.append(frame)
    sequence.write_frames(frames)
    sequence.write_info(SequenceInfo("head", str(source), "photos"))
    tracks = triangulated(sequence, frames)
    details = write_depths(sequence, tracks, DepthConfig(min_track=2), sgbm_depth)
    assert details["frames_with_depth"] == 6
    assert details["mask_coverage"] > 0.6
    assert details["sparse_points_compared"] > 100
    assert details["sparse_median_error"] < 0.003 and details["sparse_within_1_percent"] > 0.85


def triangulated(sequence: Sequence, frames: list) -> Tracks:
    """Points of SIFT matches between each frame and the next but one."""
    import cv2

    sift, features = cv2.SIFT.create(1000), []
    for frame in frames:
        mask = sequence.read_mask(frame)
        keys, words = sift.detectAndCompute(sequence.read_image(frame), mask.astype(np.uint8) * 255)
        features.append((np.array([key.pt for key in keys]) + 0.5, words))
    xyz, index, seen = [], [], []
    for i, j in zip(range(len(frames) - 2), range(2, len(frames)), strict=True):
        matches = cv2.BFMatcher().knnMatch(features[i][1], features[j][1], k=2)
        pairs = np.array([(a.queryIdx, a.trainIdx) for a, b in matches if a.distance < 0.75 * b.distance])
        pixels = [features[k][0][pairs[:, side]] for side, k in enumerate((i, j))]
        cameras = frames[i].camera, frames[j].camera
        P = [np.concatenate([c.R, c.t[:, None]], axis=1) for c in cameras]
        rays = [c.to_normalised(p).T.copy() for c, p in zip(cameras, pixels, strict=True)]
        homogeneous = cv2.triangulatePoints(*P, *rays)
        points = (homogeneous[:3] / homogeneous[3]).T
        off = [np.linalg.norm(c.project(points)[0] - p, axis=1) for c, p in zip(cameras, pixels, strict=True)]
        points = points[np.maximum(*off) < 1.5]
        start = sum(map(len, xyz))
        for k in (i, j):
            index.append(start + np.arange(len(points)))
            seen.append(np.full(len(points), k))
        xyz.append(points)
    return Tracks(np.concatenate(xyz), np.concatenate(index), np.concatenate(seen))
