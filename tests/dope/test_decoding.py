import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_shards import encode, make_pair, write_shards

from dope.common.errors import BadInput
from dope.decoding import DecodedPair, decode_jpeg, decode_pair, decode_points, jpeg_size, resized
from dope.streaming import PairDataset


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=2, pairs=1)


def npy(points: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, points)
    return buffer.getvalue()


def members_of(size: int) -> dict[str, bytes]:
    pair = make_pair(1, 0, size)
    views = {f"{v + 1}.{kind}": encode("." + kind, of[v]) for v in (0, 1) for kind, of in
             (("jpg", pair.images), ("png", pair.masks))}  # fmt: skip
    return {**views, "corr.npy": npy(pair.points)}


def decode(members: dict[str, bytes], size: int, number: int = 0) -> DecodedPair:
    images, masks = np.empty((2, 3, size, size), np.uint8), np.empty((2, size, size), bool)
    return decode_pair(members, number, "k", images=images, masks=masks, max_points=4096, where="x")


def test_smaller_images_scale_points_and_shrink_by_area(shards: Path) -> None:
    full, half = PairDataset(shards, "train", image_size=64)[0], PairDataset(shards, "train", image_size=32)[0]
    np.testing.assert_allclose(half.points, full.points / 2)
    blocks = full.images[0].reshape(3, 32, 2, 32, 2).mean((2, 4))
    assert np.abs(half.images[0] - blocks).mean() < 3  # JPEG at 64 px
    assert half.masks[1].shape == (32, 32)


@pytest.mark.parametrize(("size", "reduction"), [(112, 2), (56, 4), (28, 8), (100, 2), (113, 1), (224, 1), (300, 1)])
def test_a_jpeg_is_decoded_no_larger_than_needed_and_nothing_moves(size: int, reduction: int) -> None:
    image = make_pair(3, 0, size=224).images[0]
    data = encode(".jpg", image)
    reduced, by = decode_jpeg(data, size)
    assert by == reduction and reduced is not None and reduced.shape[0] == 224 // reduction
    whole = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    ours, expected = resized(reduced, size).astype(float), resized(whole, size).astype(float)
    assert np.abs(ours - expected).mean() < 1.5
    # the best fit of one to the other is at a shift of 0: in tenths of a pixel, along x and y
    if size < 224:
        for axis in (0, 1):
            gradient = np.gradient(expected, axis=axis)
            shift = (gradient * (ours - expected)).sum() / (gradient**2).sum()
            assert abs(shift) < 0.02


@pytest.mark.parametrize("shape", [(225, 224), (224, 226), (223, 223)])
def test_sizes_that_the_reduction_does_not_divide_are_decoded_whole_enough(shape: tuple[int, int]) -> None:
    data = encode(".jpg", np.zeros((*shape, 3), np.uint8))
    assert jpeg_size(data) == shape
    image, by = decode_jpeg(data, 56)
    assert image is not None and all(side % by == 0 for side in shape) and image.shape[0] * by == shape[0]


def test_no_jpeg_has_no_size() -> None:
    for data in (b"", b"\xff\xd8", b"\xff\xd8\xff\xe0\0\0" * 9, encode(".png", np.zeros((8, 8), np.uint8))):
        assert jpeg_size(data) == (0, 0)


@pytest.mark.parametrize("size", [32, 64])
def test_reduced_views_keep_points_on_the_object(size: int) -> None:
    decoded = decode(members_of(128), size, 5)
    assert decoded.object == 5 and decoded.images[0].shape == (3, size, size)
    np.testing.assert_allclose(decoded.points, make_pair(1, 0, 128).points * size / 128, rtol=1e-6)
    for view in (0, 1):
        columns, rows = decoded.points[:, 2 * view].astype(int), decoded.points[:, 2 * view + 1].astype(int)
        assert decoded.masks[view][rows, columns].mean() > 0.97


@pytest.mark.parametrize("points", [
    np.arange(12, dtype=np.float32).reshape(3, 4), np.zeros((0, 4), np.float32), np.arange(8.0).reshape(2, 4),
    np.asfortranarray(np.arange(12, dtype=np.float32).reshape(3, 4)), np.ones((2, 4), ">f4"), np.ones((2, 4), "<f2"),
])  # fmt: skip
def test_points_are_what_numpy_reads(points: np.ndarray) -> None:
    decoded = decode_points(npy(points), 2, "x")
    assert decoded.dtype == np.float32 and decoded.dtype.isnative
    np.testing.assert_array_equal(decoded, points[:2].astype(np.float32))


@pytest.mark.parametrize("data", [
    npy(np.zeros((9, 4), np.float32))[:-1], npy(np.zeros((9, 4), np.float32))[:70], b"", b"\x93NUMPY",
    npy(np.zeros((9, 4), np.float32))[:-16], npy(np.array([object()])),
])  # fmt: skip
def test_cut_off_and_pickled_points_are_refused(data: bytes) -> None:
    with pytest.raises(BadInput, match=r"^x: corr\.npy cannot be read"):
        decode_points(data, 100, "x")


def test_points_of_another_shape_are_refused() -> None:
    with pytest.raises(BadInput, match=r"corr\.npy is int64 \(2, 4\)"):
        decode_points(npy(np.zeros((2, 4), int)), 9, "x")
    with pytest.raises(BadInput, match=r"corr\.npy is float32 \(2, 3\)"):
        decode_points(npy(np.zeros((2, 3), np.float32)), 9, "x")


@pytest.mark.parametrize("name", ["1.jpg", "2.jpg", "1.png", "2.png", "corr.npy"])
def test_a_member_that_is_missing_or_damaged_is_named(name: str) -> None:
    members = members_of(64)
    for data in (b"", members[name][:40], b"\0" * 500):
        with pytest.raises(BadInput, match=rf"{name} cannot be"):
            decode({**members, name: data}, 64)
    del members[name]
    with pytest.raises(BadInput, match=rf"x: has no {name}"):
        decode(members, 64)


HEAD = b"\x93NUMPY\x01\x00v\x00{'descr': '<f4', 'fortran_order': False, 'shape': (%s, 4), }"


@pytest.mark.parametrize(
    "head", [HEAD % b"3'", HEAD % b"01", HEAD % b"9999999999999", HEAD % (b"9" * 30), HEAD.replace(b"}", b" ") % b"3"]
)
def test_a_damaged_head_of_an_array_is_a_damaged_sample_whatever_python_makes_of_it(head: bytes) -> None:
    data = head.ljust(127) + b"\n" + bytes(48)
    with pytest.raises(BadInput, match=r"x: corr\.npy cannot be read"):
        decode_points(data, 100, "x")


def test_a_jpeg_whose_end_is_missing_is_damaged_though_it_can_be_decoded() -> None:
    members = members_of(64)
    whole = members["1.jpg"]
    half = len(whole) // 2
    data = whole[:half] + bytes(len(whole) - half)  # a hole that a broken copy left
    assert decode_jpeg(data, 64)[0] is not None, "else nothing is shown"
    with pytest.raises(BadInput, match=r"x: 1\.jpg is cut off"):
        decode({**members, "1.jpg": data}, 64)
    decode({**members, "1.jpg": whole + bytes(7)}, 64)
