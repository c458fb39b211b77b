"""Depth maps made by other tools brought into a sequence: every format, unit, size and name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from depth_files import WRITERS, write_all
from synthetic import Scene, orbit, pixel_centres, write_sequence
from tiny_media import encode, with_orientation

import pipeline.sequence
from dope.common.errors import BadInput
from pipeline.cameras import colmap
from pipeline.cameras.sparse_points import SparsePoints
from pipeline.depth.depth_folder import match_depth_files
from pipeline.depth.import_scale import ImportConfig
from pipeline.depth.imported import import_depth_folder, import_depths
from pipeline.depth.mvs import DepthConfig
from pipeline.depth.resample import reduced
from pipeline.geometry import Camera
from pipeline.inputs.photos import turn_upright
from pipeline.sequence import Frame, Sequence

SCENE = Scene()
CAMERAS = orbit(7, arc_deg=49, distance=4.5, width=160, height=120, focal=190, wobble=0.05)
CONFIG = DepthConfig(long_side=160, min_track=1)
TRUTH = [SCENE.render(camera)[1] for camera in CAMERAS]


def sparse_points(cameras: list[Camera], count: int = 80, seed: int = 0) -> SparsePoints:
    """Points of the object and the frames that really see them."""
    pixels = pixel_centres(cameras[3].width, cameras[3].height)
    points, _, what = SCENE.trace(cameras[3], pixels)
    chosen = np.random.default_rng(seed).choice(np.flatnonzero(what == 1), count, replace=False)
    seen = [np.flatnonzero(SCENE.transfer(cameras[3], pixels[chosen], camera)[1]) for camera in cameras]
    frame = np.repeat(np.arange(len(cameras)), list(map(len, seen)))
    none = np.zeros(count)
    return SparsePoints(points[chosen], np.concatenate(seen), frame, np.zeros((count, 3), np.uint8), none)


@pytest.fixture
def sequence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sequence:
    """A photo sequence with cameras; 2.5 of its units are one unit of the cameras that were given."""
    found = write_sequence(tmp_path / "ball", CAMERAS, SCENE, depths=False)
    info = found.read_info()
    info.kind, info.input_scale = "photos", 2.5
    found.write_info(info)
    monkeypatch.setattr(colmap, "read_points", lambda _: sparse_points(CAMERAS))
    return found


def errors_of(sequence: Sequence) -> np.ndarray:
    """Relative errors against the truth, where both are known, and the depth is there."""
    errors = []
    for frame, camera in zip(sequence.read_frames(), CAMERAS, strict=True):
        depth = sequence.read_depth(frame)
        assert depth is not None
        truth = SCENE.render(camera.resized(depth.shape[1], depth.shape[0]))[1]
        known = (depth > 0) & (truth > 0)
        assert known.sum() > 0.97 * (truth > 0).sum()
        errors.append(np.abs(depth[known] / truth[known] - 1))
    return np.concatenate(errors)


@pytest.mark.parametrize("suffix", sorted(WRITERS))
def test_every_format_gives_true_depth_in_the_unit_of_the_cameras(
    sequence: Sequence, tmp_path: Path, suffix: str
) -> None:
    details = import_depth_folder(sequence, write_all(tmp_path / "d", [t / 2.5 for t in TRUTH], suffix), CONFIG)
    assert details["frames_with_depth"] == 7 and details["missing"] == 0 and "bad_frames" not in details
    assert details["scale_from"] == "cameras"
    assert details["scale"] == pytest.approx(2.5 if suffix != ".png" else 0.0025)
    assert details["sparse_within_1_percent"] > 0.95
    assert details["contradicted_share"] == 0 and details["confirmed_share"] > 0.5
    assert np.median(errors_of(sequence)) < 1e-3


def test_an_unknown_scale_is_fitted_to_the_sparse_points(sequence: Sequence, tmp_path: Path) -> None:
    details = import_depth_folder(sequence, write_all(tmp_path / "d", [t * 7 for t in TRUTH]), CONFIG)
    assert details["scale_from"] == "fitted" and details["scale"] == pytest.approx(1 / 7, rel=0.003)
    assert np.median(errors_of(sequence)) < 0.005


def test_a_scale_that_is_given_counts_in_the_unit_of_the_cameras(sequence: Sequence, tmp_path: Path) -> None:
    config = replace(CONFIG, imported=ImportConfig(scale=1 / 5000, unit="cameras"))
    details = import_depth_folder(sequence, write_all(tmp_path / "d", [t * 2000 for t in TRUTH]), config)
    assert details["scale"] == pytest.approx(1 / 2000) and np.median(errors_of(sequence)) < 1e-3


def test_depth_that_is_not_in_the_unit_it_is_said_to_be_in_is_refused(sequence: Sequence, tmp_path: Path) -> None:
    config = replace(CONFIG, imported=ImportConfig(unit="cameras"))
    with pytest.raises(BadInput, match=r"sparse points are 0\.4\d* times as far.*unit=unknown"):
        import_depth_folder(sequence, write_all(tmp_path / "d", TRUTH), config)


def test_a_scale_a_frame_needs_to_be_asked_for(sequence: Sequence, tmp_path: Path) -> None:
    folder = write_all(tmp_path / "d", [t * (1 + i) for i, t in enumerate(TRUTH)])
    with pytest.raises(BadInput, match=r"no scale fits the sparse points: spread \d.*fit=frame"):
        import_depth_folder(sequence, folder, CONFIG)
    details = import_depth_folder(sequence, folder, replace(CONFIG, imported=ImportConfig(fit="frame")))
    assert details["scale_from"] == "fitted" and np.median(errors_of(sequence)) < 0.005


def test_disparity_is_refused(sequence: Sequence, tmp_path: Path) -> None:
    disparity = [np.where(t > 0, (1 / np.maximum(t, 0.1)) ** 3, 0) for t in TRUTH]
    with pytest.raises(BadInput, match="disparity"):
        import_depth_folder(sequence, write_all(tmp_path / "d", disparity), CONFIG)


def test_distances_along_the_ray_become_depths(sequence: Sequence, tmp_path: Path) -> None:
    distances = []
    for camera, depth in zip(CAMERAS, TRUTH, strict=True):
        xy = camera.to_normalised(pixel_centres(camera.width, camera.height)).reshape(*depth.shape, 2)
        distances.append(depth * np.sqrt(1 + (xy**2).sum(2)) / 2.5)
    config = replace(CONFIG, imported=ImportConfig(kind="ray", unit="cameras"))
    import_depth_folder(sequence, write_all(tmp_path / "d", distances), config)
    assert np.quantile(errors_of(sequence), 0.99) < 1e-3


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_depth_of_another_size_keeps_its_place(sequence: Sequence, tmp_path: Path, factor: float) -> None:
    """Half a pixel of shift would be seen: the depth of a sphere's flank changes by several percent a pixel."""
    sized = [camera.resized(round(160 * factor), round(120 * factor)) for camera in CAMERAS]
    import_depth_folder(sequence, write_all(tmp_path / "d", [SCENE.render(c)[1] / 2.5 for c in sized]), CONFIG)
    errors = errors_of(sequence)
    assert np.median(errors) < 1e-3 and np.quantile(errors, 0.97) < 0.01
    depth = sequence.read_depth(sequence.read_frames()[0])
    assert depth is not None and depth.shape == ((60, 80) if factor < 1 else (120, 160))


def test_what_is_not_a_positive_number_is_unknown(sequence: Sequence, tmp_path: Path) -> None:
    holes = [t / 2.5 for t in TRUTH]
    for depth in holes:
        depth[40:44], depth[50:54], depth[60:64], depth[70:74] = np.nan, np.inf, -1, -np.inf
    import_depth_folder(sequence, write_all(tmp_path / "d", holes), CONFIG)
    depth = sequence.read_depth(sequence.read_frames()[3])
    assert depth is not None
    for row in (40, 50, 60, 70):
        assert not depth[row : row + 4].any() and depth[row + 4].any()


@pytest.mark.parametrize("far", [1e10, 65504.0, 1e4, 300.0])
@pytest.mark.parametrize("share", ["a corner", "all but the object"])
def test_a_far_sky_takes_no_step_from_what_is_near(sequence: Sequence, tmp_path: Path, far: float, share: str) -> None:
    """Blender's sky is at 1e10, and the largest half float is 65504; steps of 1/65535 of that would keep nothing."""
    with_sky = [t / 2.5 for t in TRUTH]
    for depth, camera in zip(with_sky, CAMERAS, strict=True):
        if share == "a corner":
            depth[:6, :6] = far
        else:
            depth[~SCENE.render(camera)[2]] = far
    details = import_depth_folder(sequence, write_all(tmp_path / "d", with_sky), CONFIG)
    for i, frame in enumerate(sequence.read_frames()):
        depth = sequence.read_depth(frame)
        near = (with_sky[i] > 0) & (with_sky[i] < far)
        assert depth is not None and ((depth > 0) == near).all()
        assert (np.abs(depth[near] / TRUTH[i][near] - 1) < 2e-4).all()
    sky = sum(int((d == np.float32(far)).sum()) for d in with_sky) / sum(int((d > 0).sum()) for d in with_sky)
    assert details["too_far_share"] == pytest.approx(sky, abs=0.02)  # other views look through some of it
    assert details["sparse_within_1_percent"] > 0.95 and details["frames_with_depth"] == 7


def test_depth_is_described_as_it_is_read_back(sequence: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    class Given:
        unit = "cameras"

        def read(self, frame: Frame) -> np.ndarray:
            return TRUTH[frame.frame] / np.float32(2.5)

    monkeypatch.setattr(pipeline.sequence, "FARTHEST", 0.1)
    details = import_depths(sequence, Given(), CONFIG)
    assert details["frames_with_depth"] == 0 and details["coverage"] == 0 and details["too_far_share"] == 1
    assert "empty" in details and all(frame.depth is None for frame in sequence.read_frames())


def test_true_depth_that_no_other_view_sees_survives_the_check(sequence: Sequence, tmp_path: Path) -> None:
    object_only = [np.where(SCENE.render(c)[2], t, 0) / 2.5 for c, t in zip(CAMERAS, TRUTH, strict=True)]
    only_one = [TRUTH[0] / 2.5, *object_only[1:]]
    details = import_depth_folder(sequence, write_all(tmp_path / "d", only_one), CONFIG)
    depth = sequence.read_depth(sequence.read_frames()[0])
    assert depth is not None and ((depth > 0) == (TRUTH[0] > 0)).all()
    assert details["contradicted_share"] == 0 and details["confirmed_share"] < 1


def test_depth_that_others_look_through_is_removed_unless_the_check_is_off(sequence: Sequence, tmp_path: Path) -> None:
    floating = [t / 2.5 for t in TRUTH]
    mask = SCENE.render(CAMERAS[3])[2]
    rows, columns = np.nonzero(mask)
    place = slice(int(rows.mean()) - 5, int(rows.mean()) + 5), slice(int(columns.mean()) - 5, int(columns.mean()) + 5)
    floating[3][place] *= 0.7
    folder = write_all(tmp_path / "d", floating)
    details = import_depth_folder(sequence, folder, CONFIG)
    depth = sequence.read_depth(sequence.read_frames()[3])
    assert depth is not None and not depth[place].any()
    assert (depth > 0).sum() == (TRUTH[3] > 0).sum() - 100 and details["contradicted_share"] > 0
    import_depth_folder(sequence, folder, replace(CONFIG, imported=ImportConfig(check=False)))
    kept = sequence.read_depth(sequence.read_frames()[3])
    assert kept is not None and kept[place].all()


def with_photos(sequence: Sequence, folder: Path, orientation: int) -> None:
    """The photos that the sequence was made of, with an orientation in their EXIF."""
    folder.mkdir()
    for i in range(len(CAMERAS)):
        (folder / f"{i:04d}.jpg").write_bytes(with_orientation(encode(np.zeros((8, 8, 3), np.uint8)), orientation))
    info = sequence.read_info()
    info.source = str(folder)
    sequence.write_info(info)


@pytest.mark.parametrize("lies", ["upright", "as stored"])
@pytest.mark.parametrize("orientation", [2, 3, 4])
def test_sparse_points_tell_how_depth_lies_where_its_shape_does_not(
    sequence: Sequence, tmp_path: Path, orientation: int, lies: str
) -> None:
    with_photos(sequence, tmp_path / "photos", orientation)
    maps = [t / 2.5 for t in TRUTH]
    if lies == "as stored":  # these orientations undo themselves
        maps = [turn_upright(depth, orientation) for depth in maps]
    details = import_depth_folder(sequence, write_all(tmp_path / "d", maps), CONFIG)
    assert details["frames_with_depth"] == 7 and np.median(errors_of(sequence)) < 1e-3


def test_depth_that_may_lie_either_way_is_refused(
    sequence: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_photos(sequence, tmp_path / "photos", 3)
    monkeypatch.setattr(colmap, "read_points", lambda _: sparse_points(CAMERAS, count=2))
    with pytest.raises(BadInput, match=r"do not tell whether the depth maps are turned.*EXIF"):
        import_depth_folder(sequence, write_all(tmp_path / "d", [t / 2.5 for t in TRUTH]), CONFIG)


def test_depth_maps_are_matched_by_name_and_number(tmp_path: Path) -> None:
    photos = [
        Frame(i, name, 8, 6, image="x") for i, name in enumerate(["a b.jpg", "ü.png", "IMG 1.jpeg", "c.jpg", "d.jpg"])
    ]
    names = ["a b.npy", "ü.png.geometric.bin", "IMG 1_depth.exr", "depth_c.png", "c.txt", ".d.png"]
    for name in names:
        (tmp_path / name).write_bytes(b"")
    found = match_depth_files(photos, tmp_path, by_number=False)
    assert {i: path.name for i, path in found.items()} == dict(enumerate(names[:4]))
    (tmp_path / "frame_000012.exr").write_bytes(b"")
    video = [Frame(0, "11", 8, 6, image="x"), Frame(1, "12", 8, 6, image="x")]
    assert {i: p.name for i, p in match_depth_files(video, tmp_path, by_number=True).items()} == {1: "frame_000012.exr"}


def test_geometric_depth_of_colmap_wins_over_photometric(tmp_path: Path) -> None:
    for name in ("a.jpg.photometric.bin", "a.jpg.geometric.bin", "a.png"):
        (tmp_path / name).write_bytes(b"")
    frames = [Frame(0, "a.jpg", 8, 6, image="x")]
    assert match_depth_files(frames, tmp_path, by_number=False)[0].name == "a.jpg.geometric.bin"
    (tmp_path / "a.jpg.geometric.bin").unlink()
    assert match_depth_files(frames, tmp_path, by_number=False)[0].name == "a.png"


def test_one_bad_file_is_a_reason_and_the_others_are_used(sequence: Sequence, tmp_path: Path) -> None:
    folder = write_all(tmp_path / "d", [t / 2.5 for t in TRUTH])
    (folder / "0001.npy").write_bytes((folder / "0001.npy").read_bytes()[:-7])
    np.save(folder / "0002.npy", TRUTH[2][:50])
    np.save(folder / "0004.npy", np.zeros((120, 160), np.float32))
    (folder / "0005.npy").unlink()
    details = import_depth_folder(sequence, folder, CONFIG)
    assert details["frames_with_depth"] == 3 and details["missing_frames"] == [5]
    bad = details["bad_frames"]
    assert sorted(bad) == [1, 2, 4]
    assert "0001.npy: is cut off" in bad[1] and "160x50" in bad[2] and "unknown everywhere" in bad[4]
    assert sequence.read_frames()[1].depth is None


def test_old_depth_stays_where_nothing_can_be_imported(sequence: Sequence, tmp_path: Path) -> None:
    import_depth_folder(sequence, write_all(tmp_path / "d", [t / 2.5 for t in TRUTH]), CONFIG)
    before = [sequence.read_depth(frame) for frame in sequence.read_frames()]
    empty = write_all(tmp_path / "zero", [np.zeros((120, 160), np.float32)] * 7)
    with pytest.raises(BadInput, match="no depth map of 7 can be used: depth of frame 0 is unknown everywhere"):
        import_depth_folder(sequence, empty, CONFIG)
    for folder, message in (("none", "no such folder"), ("ball", "holds no .png"), ("other", "no depth map belongs")):
        if folder == "other":
            write_all(tmp_path / folder, TRUTH[:1])
            (tmp_path / folder / "0000.npy").rename(tmp_path / folder / "else.npy")
        with pytest.raises(BadInput, match=message):
            import_depth_folder(sequence, tmp_path / folder, CONFIG)
    after = [sequence.read_depth(frame) for frame in sequence.read_frames()]
    assert all(a is not None and np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def test_a_source_that_is_not_a_folder_can_be_imported(sequence: Sequence) -> None:
    class Given:
        unit = "cameras"

        def read(self, frame: Frame) -> np.ndarray | None:
            if frame.frame == 2:
                raise BadInput("is damaged", where="somewhere")
            return None if frame.frame == 6 else TRUTH[frame.frame] / np.float32(2.5)

    details = import_depths(sequence, Given(), CONFIG)
    assert details["frames_with_depth"] == 5 and details["missing_frames"] == [6]
    assert details["bad_frames"] == {2: "somewhere: is damaged"}
    assert details["scale"] == 2.5 and details["scale_from"] == "cameras"


def test_colmap_arrays_of_distorted_photos_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distorted = [replace(camera, distortion=np.array([0.2, 0, 0, 0])) for camera in CAMERAS]
    sequence = write_sequence(tmp_path / "ball", distorted, SCENE, depths=False)
    info = sequence.read_info()
    info.kind = "photos"
    sequence.write_info(info)
    monkeypatch.setattr(colmap, "read_points", lambda _: sparse_points(distorted))
    with pytest.raises(BadInput, match=r"undistorted image, which differs from '0000.jpg' by up to \d+\.\d px"):
        import_depth_folder(sequence, write_all(tmp_path / "d", TRUTH, ".jpg.geometric.bin"), CONFIG)


def test_reducing_depth_makes_no_surface_between_two() -> None:
    step = np.full((90, 120), 5.0, np.float32)
    step[:, :47] = 2.0
    step[30:40] = 0
    small = reduced(step, 40)
    assert small.shape == (30, 40) and set(np.unique(small.round(5))) == {0.0, 2.0, 5.0}
