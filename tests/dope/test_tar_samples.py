import io
import tarfile
from pathlib import Path

import pytest
from tiny_shards import write_shards
from webdataset import TarWriter

from dope.common.errors import BadInput
from dope.shard_index import read_index
from dope.storage import open_storage
from dope.tar_samples import Location, ShardReader, split_members


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=3, pairs=2)


def test_members_equal_tarfile(shards: Path) -> None:
    path = shards / "train-000000.tar"
    with tarfile.open(path) as tar:
        expected = {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]
    assert split_members(path.read_bytes(), "x") == expected


@pytest.mark.parametrize("format", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_long_names_of_all_tar_formats(format: int) -> None:
    names = ["short.1.jpg", "folder/" * 20 + "long.1.png", "x" * 95 + ".json"]
    if format != tarfile.USTAR_FORMAT:
        names += ["ä" * 80 + ".1.jpg", "y" * 300 + ".corr.npy"]
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=format) as tar:
        for i, name in enumerate(names):
            info = tarfile.TarInfo(name)
            info.size = 700 * i
            tar.addfile(info, io.BytesIO(bytes([i]) * info.size))
    assert split_members(buffer.getvalue(), "x") == {name: bytes([i]) * 700 * i for i, name in enumerate(names)}


def test_a_damaged_header_and_a_cut_member_are_errors() -> None:
    buffer = io.BytesIO()
    with TarWriter(buffer, mtime=0, encoder=False) as tar:
        tar.write({"__key__": "a", "jpg": b"1" * 2000})
    data = bytearray(buffer.getvalue())
    with pytest.raises(BadInput, match="cut off"):
        split_members(bytes(data[:1500]), "shard.tar")
    data[3] ^= 1
    with pytest.raises(BadInput, match=r"shard\.tar: damaged tar header"):
        split_members(bytes(data), "shard.tar")


@pytest.mark.parametrize("name", ["é" * 40, "~" * 99, "\x01"])
def test_checksums_of_any_bytes(name: str) -> None:
    info = tarfile.TarInfo(name + ".json")
    info.uname = info.gname = "\xff" * 31
    data = info.tobuf(tarfile.GNU_FORMAT, "latin-1" if name == "~" * 99 else "utf-8")
    assert list(split_members(data, "x")) == [name + ".json"] or len(name) > 95


def with_checksum(header: bytearray) -> bytes:
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    return bytes(header)


def test_numbers_that_would_lead_backwards_are_damage() -> None:
    header = bytearray(tarfile.TarInfo("a.jpg").tobuf(tarfile.USTAR_FORMAT))
    header[124:136] = b"-00000001000"
    with pytest.raises(BadInput, match="damaged tar header"):
        split_members(with_checksum(header), "x")
    pax = tarfile.TarInfo("a.jpg")
    pax.type, pax.size = b"x", 10
    with pytest.raises(BadInput, match="damaged tar header"):
        split_members(pax.tobuf(tarfile.USTAR_FORMAT) + b"0 path=b\n".ljust(512, b"\0"), "x")


def test_samples_are_read_together_in_any_order_and_named_where_damaged(shards: Path) -> None:
    index, reader = read_index(shards, "train"), ShardReader(open_storage(shards))
    locations = [index.location(row) for row in (4, 0, 3, 0)]
    alone = [reader.sample(*at) for at in locations]
    assert reader.samples(locations) == alone
    wrong = Location(*locations[0][:3], "another")
    beyond = Location(locations[0].shard, 10**9, 512, "another")
    first, second, third, fourth = reader.samples([locations[0], wrong, beyond, Location("no.tar", 0, 9, "k")])
    assert first == alone[0]
    assert isinstance(second, BadInput) and "different datasets" in second.what
    assert isinstance(third, BadInput) and "ends before byte" in third.what and str(third.where).endswith(".tar")
    assert isinstance(fourth, BadInput) and "cannot be read (No such file" in fourth.what
    with pytest.raises(BadInput, match="different datasets"):
        reader.sample(*wrong)
