"""Depth maps made by other tools: every format, unit and name, and files that lie."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic import Scene, orbit, pixel_centres, write_sequence

from dope.common.errors import BadInput
from pipeline.cameras import colmap
from pipeline.cameras.sparse_points import SparsePoints
from pipeline.depth.depth_folder import match_depth_files
from pipeline.depth.import_scale import ImportConfig
from pipeline.depth.imported import import_depth_folder, import_depths
from pipeline.depth.mvs import DepthConfig
from pipeline.depth.readers import MAX_PIXELS, read_depth_file
from pipeline.depth.resample import reduced
from pipeline.geometry import Camera
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


def write_png(path: Path, depth: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(".png", np.rint(np.nan_to_num(depth) * 1000).astype(np.uint16))[1].tobytes())


def write_tiff(path: Path, depth: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(".tiff", depth.astype(np.float32))[1].tobytes())


def write_exr(path: Path, depth: np.ndarray, channel: str = "Z") -> None:
    exr = pytest.importorskip("OpenEXR")
    with exr.File({"type": exr.scanlineimage}, {channel: depth.astype(np.float32)}) as file:
        file.write(str(path))


def write_bin(path: Path, depth: np.ndarray) -> None:
    height, width = depth.shape
    path.write_bytes(f"{width}&{height}&1&".encode() + depth.astype("<f4").tobytes())


WRITERS: dict[str, Callable[[Path, np.ndarray], None]] = {
    ".png": write_png,
    ".tiff": write_tiff,
    ".exr": write_exr,
    ".npy": np.save,
    ".npz": lambda path, depth: np.savez_compressed(path, depth=depth.astype(np.float16)),
    ".jpg.geometric.bin": write_bin,
}


def write_all(folder: Path, depths: list[np.ndarray], suffix: str = ".npy") -> Path:
    folder.mkdir(exist_ok=True)
    for i, depth in enumerate(depths):
        WRITERS[suffix](folder / f"{i:04d}{suffix}", depth)
    return folder


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


def npz_of(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def npy_head(shape: tuple[int, ...], dtype: str = "<f4") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"shape": shape, "fortran_order": False, "descr": dtype})
    return file.getvalue()


def npz_bomb() -> bytes:
    """A member that claims, and truly is when unpacked, far more than a depth map."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.npy", npy_head((60000, 60000)) + bytes(1 << 20))
    return file.getvalue()


def packed_by(method: int, name: str = "depth.npy") -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        archive.writestr(name, npy_head((6, 8)) + bytes(range(192)))
    return file.getvalue()


def damaged_lzma() -> bytes:
    data = bytearray(packed_by(zipfile.ZIP_LZMA))
    data[60:80] = bytes(20)
    return bytes(data)


GOOD = np.linspace(1, 2, 48, dtype=np.float32).reshape(6, 8)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.npy", b"", "is no NumPy array"),
        ("a.npy", npy_head((6, 8)).replace(b"}", b"{") + bytes(192), "is no NumPy array"),
        ("a.npy", npy_head((60000, 60000)), "claims too many numbers"),
        ("a.npy", npy_head((6, 8)) + bytes(100), "is cut off"),
        ("a.npy", npy_head((-6, -8)) + bytes(192), "."),
        ("a.npy", npy_head((2, 3, 8, 1)) + bytes(192), "is no depth map: 2 x 3 x 8 x 1"),
        ("a.npy", npy_head((6, 8), "<c8") + bytes(384), "is no depth map"),
        ("a.npy", npy_head((6, 8), "|u1") + bytes(48), "8 bits"),
        ("a.npy", npy_head((6, 8), "|O") + bytes(384), "Python objects"),
        ("a.npz", npz_of(depth=GOOD)[:-30], "is no NPZ"),
        ("a.npz", npz_of(rgb=GOOD, other=GOOD), "holds no array of depth, but other, rgb"),
        ("a.npz", damaged_lzma(), "is no NPZ"),
        ("a.npz", packed_by(zipfile.ZIP_STORED, "ä.npy").replace("ä".encode(), b"\xff\xff"), "is no NPZ"),
        ("a.npz", npz_bomb(), "claims too many numbers"),
        ("a.bin", b"60000&60000&1&" + bytes(64), "64 bytes for 60000 x 60000 x 1"),
        ("a.bin", b"8&6&1&" + bytes(4 * 47), "is not a depth map of COLMAP"),
        ("a.bin", b"-8&-6&1&" + bytes(4 * 48), "is not a depth map of COLMAP"),
        ("a.bin", b"\xff\xd8\xff\xe0", "is not a depth map of COLMAP"),
        ("a.png", cv2.imencode(".png", (GOOD * 100).astype(np.uint8))[1].tobytes(), "8 bits"),
        ("a.png", cv2.imencode(".png", np.ones((6, 8, 3), np.uint16))[1].tobytes(), "6 x 8 x 3"),
        ("a.png", cv2.imencode(".png", (GOOD * 100).astype(np.uint16))[1].tobytes()[:-20], "cut off"),
        ("a.tiff", cv2.imencode(".tiff", GOOD)[1].tobytes()[:40], "decoded"),
        ("a.tiff", b"not a tiff", "decoded"),
        ("a.exr", b"not an exr", "is no EXR"),
        ("a.xyz", b"", "is no kind of depth map"),
    ],
)
def test_files_that_lie_are_refused_by_name(tmp_path: Path, name: str, data: bytes, message: str) -> None:
    path = tmp_path / f"spaces & ü {name}"
    path.write_bytes(data)
    if name.endswith("exr"):
        pytest.importorskip("OpenEXR")
    with pytest.raises(BadInput, match=message) as caught:
        read_depth_file(path)
    assert caught.value.where == str(path)


def test_a_png_that_claims_more_than_memory_is_refused(tmp_path: Path) -> None:
    import struct
    import zlib

    data = cv2.imencode(".png", (GOOD * 100).astype(np.uint16))[1].tobytes()
    head = b"IHDR" + struct.pack(">II", 60000, 60000) + data[24:29]
    bomb = data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:]
    (tmp_path / "bomb.png").write_bytes(bomb)
    with pytest.raises(BadInput):
        read_depth_file(tmp_path / "bomb.png")
    assert MAX_PIXELS < 60000 * 60000


@pytest.mark.parametrize("channel", ["Z", "depth", "V", "Y", "R", "distance"])
def test_exr_channels_of_depth(tmp_path: Path, channel: str) -> None:
    write_exr(tmp_path / "a.exr", GOOD, channel)
    assert np.array_equal(read_depth_file(tmp_path / "a.exr").values, GOOD)


def test_exr_that_is_cut_off_or_without_depth_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    exr = pytest.importorskip("OpenEXR")
    write_exr(tmp_path / "a.exr", GOOD)
    whole = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(whole[:-60])
    with pytest.raises(BadInput):
        read_depth_file(tmp_path / "a.exr")
    assert not capfd.readouterr().out
    with exr.File({"type": exr.scanlineimage}, {"A": GOOD, "B": GOOD}) as file:
        file.write(str(tmp_path / "b.exr"))
    with pytest.raises(BadInput, match="no channel of depth, but A, B"):
        read_depth_file(tmp_path / "b.exr")


def test_exr_with_a_part_of_the_image_is_refused(tmp_path: Path) -> None:
    exr = pytest.importorskip("OpenEXR")
    whole = np.array([0, 0], np.int32), np.array([20, 20], np.int32)
    part = np.array([3, 2], np.int32), np.array([10, 7], np.int32)
    header = {"type": exr.scanlineimage, "displayWindow": whole, "dataWindow": part}
    with exr.File(header, {"Z": GOOD}) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(BadInput, match="a part of its image only"):
        read_depth_file(tmp_path / "a.exr")


def test_exr_without_its_package_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    (tmp_path / "a.exr").write_bytes(b"x")
    with pytest.raises(BadInput, match=r"pip install 'dope-descriptors\[exr\]'"):
        read_depth_file(tmp_path / "a.exr")


def test_reducing_depth_makes_no_surface_between_two() -> None:
    step = np.full((90, 120), 5.0, np.float32)
    step[:, :47] = 2.0
    step[30:40] = 0
    small = reduced(step, 40)
    assert small.shape == (30, 40) and set(np.unique(small.round(5))) == {0.0, 2.0, 5.0}
