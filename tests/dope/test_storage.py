import hashlib
import os
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
from tiny_shards import to_memory, write_shards

from dope import storage
from dope.common.errors import BadInput, UsageError
from dope.shard_index import read_index, verify_hashes
from dope.storage import LocalFolder, Range, RemoteFolder, Storage, coalesce, open_storage
from dope.streaming import PairDataset, PairLoader
from dope.tar_samples import ShardReader


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=6, pairs=2, val_objects=1, size=32, per_shard=5)


@pytest.fixture
def url(shards: Path) -> Iterator[str]:
    yield to_memory(shards, "storage")
    fsspec.filesystem("memory").rm("/storage", recursive=True)


@pytest.fixture(params=["path", "file://", "memory://"])
def stored(request: pytest.FixtureRequest, shards: Path, url: str) -> Storage:
    return open_storage({"path": shards, "file://": f"file://{shards}", "memory://": url}[request.param])


def test_the_same_bytes_from_everywhere(stored: Storage, shards: Path) -> None:
    data = (shards / "train-000000.tar").read_bytes()
    assert stored.sizes() == {path.name: path.stat().st_size for path in shards.iterdir()}
    assert stored.read_bytes("train-000000.tar") == data
    assert stored.sha256("train-000000.tar") == hashlib.sha256(data).hexdigest()
    assert stored.read_json("dataset.json")["counts"]["pairs"] == 14
    ranges = [
        Range("train-000000.tar", a, b) for a, b in ((700, 900), (0, 512), (300, 710), (5000, 5000), (9000, 9100))
    ]
    assert stored.read(ranges) == [data[one.start : one.end] for one in ranges]
    size = len(data)
    over, missing = stored.read([Range("train-000000.tar", size - 10, size + 10), Range("none.tar", 0, 10)])
    assert over == data[-10:] and isinstance(missing, FileNotFoundError)


def test_what_is_absent_or_no_json_is_named(stored: Storage) -> None:
    for call in (stored.read_bytes, stored.sha256, stored.read_json):
        with pytest.raises(BadInput, match=r"absent\.json: no such file"):
            call("absent.json")
    with pytest.raises(BadInput, match=r"train-000000\.tar: is not valid JSON"):
        stored.read_json("train-000000.tar")


def test_no_such_folder(url: str, tmp_path: Path) -> None:
    for address in (f"{url}/nowhere", str(tmp_path / "nowhere"), f"file://{tmp_path}/nowhere"):
        with pytest.raises(BadInput, match=r"nowhere: no such folder\. SHARDS is what"):
            open_storage(address).sizes()


def test_neighbours_become_one_read_and_far_ones_do_not() -> None:
    ranges = [Range("b", 0, 5), Range("a", 30, 40), Range("a", 0, 10), Range("a", 12, 20), Range("a", 0, 10)]
    assert coalesce(ranges, gap=2) == [[2, 4, 3], [1], [0]]
    assert coalesce(ranges, gap=10) == [[2, 4, 3, 1], [0]]
    assert coalesce(ranges, gap=10, longest=25) == [[2, 4, 3], [1], [0]]
    assert coalesce([], gap=1) == []


class Counting(LocalFolder):
    """Counts reads, and cannot read across byte 1,000 of a.tar."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.reads: list[Range] = []

    def fetch(self, ranges):  # type: ignore[no-untyped-def]
        self.reads += ranges
        found = super().fetch(ranges)
        broken = [one.name == "a.tar" and one.start <= 1000 < one.end for one in ranges]
        return [OSError(5, "I/O error") if bad else data for bad, data in zip(broken, found, strict=True)]


def test_an_unreadable_place_costs_its_neighbours_nothing(tmp_path: Path) -> None:
    data = os.urandom(3000)
    for name in ("a.tar", "b.tar"):
        (tmp_path / name).write_bytes(data)
    counting = Counting(tmp_path)
    ranges = [Range(name, start, start + 600) for name in ("a.tar", "b.tar") for start in (0, 600, 1200)]
    found = counting.read(ranges)
    assert [isinstance(part, OSError) for part in found] == [False, True, False, False, False, False]
    assert found[2] == data[1200:1800] and found[4] == data[600:1200]
    assert counting.reads == [Range("a.tar", 0, 1800), Range("b.tar", 0, 1800), *ranges[:3]]


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_few_files_are_open_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "MAX_OPEN_FILES", 3)
    for number in range(9):
        (tmp_path / f"{number}.tar").write_bytes(bytes([number]) * 4)
    folder, before = LocalFolder(tmp_path), open_files()
    for _ in range(2):
        assert folder.read([Range(f"{n}.tar", 0, 4) for n in range(9)]) == [bytes([n]) * 4 for n in range(9)]
    assert open_files() <= before + 3
    folder.close()
    assert open_files() == before


def test_a_remote_range_is_asked_for_again_unless_it_is_not_there(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    memory, asked = fsspec.filesystem("memory"), []
    real = type(memory).cat_file

    def moody(self: object, path: str, start: int | None = None, end: int | None = None, **options: object) -> bytes:
        asked.append(path.rsplit("/", 1)[-1])
        if asked.count("train-000001.tar") == 1 and path.endswith("train-000001.tar"):
            raise ConnectionError("reset by peer")
        return real(self, path, start, end)

    monkeypatch.setattr(type(memory), "cat_file", moody)
    monkeypatch.setattr(storage, "PAUSE_S", 0.0)
    names = ["train-000000.tar", "train-000001.tar", "none.tar"]
    found = open_storage(url).read([Range(name, 0, 100) for name in names])
    assert [len(part) for part in found[:2]] == [100, 100]  # type: ignore[arg-type]
    assert isinstance(found[2], FileNotFoundError)
    assert sorted(asked) == ["none.tar", "train-000000.tar", "train-000001.tar", "train-000001.tar"]


def test_every_process_opens_the_store_anew(url: str) -> None:
    remote = open_storage(url)
    assert isinstance(remote, RemoteFolder)
    first = remote._fs[0]
    assert remote._fs[0] is first
    read, write = os.pipe()
    if (child := os.fork()) == 0:
        os.write(write, b"same" if remote._fs[0] is first else b"anew")
        os._exit(0)
    os.waitpid(child, 0)
    assert os.read(read, 4) == b"anew"
    other = pickle.loads(pickle.dumps(remote))  # as a spawned worker gets it
    assert other._opened is None and other.read_bytes("train-000000.tar") == remote.read_bytes("train-000000.tar")


def test_a_reader_survives_pickling_after_it_opened_files(shards: Path) -> None:
    index, reader = read_index(shards, "train"), ShardReader(open_storage(shards))
    first = reader.sample(*index.location(0))
    assert pickle.loads(pickle.dumps(reader)).sample(*index.location(0)) == first
    reader.close()
    assert reader.sample(*index.location(0)) == first  # what was closed opens again


@pytest.mark.parametrize(("scheme", "package", "extra"), [("s3", "s3fs", "s3"), ("gs", "gcsfs", "gs"),
                                                           ("hf", "huggingface_hub", "hf")])  # fmt: skip
def test_a_package_that_is_not_there_names_its_extra(
    scheme: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UsageError, match=rf"{scheme}:// needs .* pip install 'dope-descriptors\[{extra}\]'"):
        PairDataset(f"{scheme}://bucket/shards", "train")


def test_a_kind_of_url_that_nobody_knows() -> None:
    with pytest.raises(UsageError, match=r"quatsch://a/b: cannot be opened \(Protocol not known: quatsch\)"):
        read_index("quatsch://a/b", "train")


def test_a_listing_that_fails_is_explained(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("An error occurred (403)\nwhen calling")

    monkeypatch.setattr(type(fsspec.filesystem("memory")), "ls", refuse)
    with pytest.raises(
        BadInput, match=r"memory://storage: cannot be listed \(An error occurred \(403\)\).*credentials"
    ):
        read_index(url, "train")


@pytest.mark.parametrize("workers", [0, 2])
def test_remote_shards_give_the_same_batches(shards: Path, url: str, workers: int) -> None:
    here, there = PairDataset(shards, "train", image_size=32), PairDataset(url, "train", image_size=32)
    assert there.index.fingerprint == here.index.fingerprint
    rows = [[0, 11, 5], [4, 6, 10], [1, 2, 3]]
    for ours, theirs in zip(PairLoader(here, rows), PairLoader(there, rows, workers=workers), strict=True):
        assert ours.keys == theirs.keys and bool((ours.images1 == theirs.images1).all())
        assert bool((ours.points == theirs.points).all())


def test_remote_damage_is_found_and_named(url: str) -> None:
    memory = fsspec.filesystem("memory")
    verify_hashes(url)
    data = bytearray(memory.cat_file("/storage/train-000001.tar"))
    data[5000] ^= 1
    memory.pipe_file("/storage/train-000001.tar", bytes(data))
    with pytest.raises(BadInput, match=r"memory://storage/train-000001\.tar: its SHA-256"):
        verify_hashes(url, "train")
    memory.pipe_file("/storage/train-000001.tar", bytes(data[:3000]))
    with pytest.raises(BadInput, match=r"memory://storage/train-000001\.tar: is cut off"):
        read_index(url, "train")
    memory.rm("/storage/train-000001.tar")
    with pytest.raises(BadInput, match=r"memory://storage/train-000001\.tar: this shard is missing"):
        read_index(url, "train")
    memory.rm("/storage/dataset.json")
    with pytest.raises(BadInput, match=r"memory://storage: is no folder of shards"):
        read_index(url, "train")
