"""Containers of an array job that write one folder of shards together."""

import fcntl
import multiprocessing
import shutil
from pathlib import Path
from typing import Any

import pytest
from synthetic import orbit, write_sequence

from dope.common.errors import DiskFull, UsageError
from pipeline.correspond.match import CorrespondConfig, correspond
from pipeline.correspond.views import ViewsConfig
from pipeline.engines import Share
from pipeline.sequence import Sequence
from pipeline.shards import dataset
from pipeline.shards.dataset import ShardsConfig, check_output, verify_shards, write_shards
from pipeline.stages import run_stage

CONFIG = ShardsConfig(samples_per_shard=7, holdout="none")


@pytest.fixture(scope="module")
def sequences(tmp_path_factory: pytest.TempPathFactory) -> list[Sequence]:
    work = tmp_path_factory.mktemp("work")
    first = write_sequence(work / "one", orbit(8, width=80, height=60, focal=95))
    config = CorrespondConfig(ViewsConfig(every=1))
    assert run_stage(first, "correspond", config, "", lambda: correspond(first, config)).ok
    shutil.copytree(first.folder, work / "two")
    return [first, Sequence(work / "two")]


@pytest.fixture(scope="module")
def alone(sequences: list[Sequence], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes that a single run writes."""
    out = tmp_path_factory.mktemp("alone") / "out"
    write_shards(sequences, out, CONFIG)
    return bytes_of(out)


def bytes_of(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.iterdir()}


def test_the_last_part_completes_the_folder(sequences: list[Sequence], alone: dict[str, bytes], tmp_path: Path) -> None:
    out, waiting = tmp_path / "out", []
    for index in (2, 0, 1):
        assert not out.exists()
        waiting.append(write_shards(sequences, out, CONFIG, share=Share(index, 3))["waiting_for"])
    n_tars = sum(name.endswith(".tar") for name in alone)
    assert waiting[0] > waiting[1] > waiting[2] == 0 and waiting[0] == n_tars - len(range(2, n_tars, 3))
    assert bytes_of(out) == alone
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert write_shards(sequences, out, CONFIG, share=Share(1, 3))["skipped"]


def _part(sequences: list[Sequence], out: Path, index: int) -> None:
    write_shards(sequences, out, CONFIG, share=Share(index, 4))


def test_parts_at_the_same_time(sequences: list[Sequence], alone: dict[str, bytes], tmp_path: Path) -> None:
    out = tmp_path / "out"
    context = multiprocessing.get_context("fork")
    children = [context.Process(target=_part, args=(sequences, out, index)) for index in range(4)]
    for child in children:
        child.start()
    for child in children:
        child.join(120)
    assert [child.exitcode for child in children] == [0] * 4
    assert bytes_of(out) == alone
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_part_that_broke_off_goes_on_and_the_old_dataset_stays(
    sequences: list[Sequence], alone: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    write_shards(sequences[:1], out, CONFIG)
    before, real, written = bytes_of(out), dataset.write_tar, []

    def write_tar(path: Path, kind: Any, samples: Any, name: str) -> dataset.WrittenShard:
        written.append(name)
        if len(written) == 3:
            raise OSError(28, "No space left on device")
        return real(path, kind, samples, name)

    monkeypatch.setattr(dataset, "write_tar", write_tar)
    with pytest.raises(DiskFull):
        write_shards(sequences, out, CONFIG, share=Share(0, 2))
    assert bytes_of(out) == before
    write_shards(sequences, out, CONFIG, share=Share(0, 2))
    assert len(written) - len(set(written)) == 1  # only the tar that failed was begun again
    write_shards(sequences, out, CONFIG, share=Share(1, 2))
    assert bytes_of(out) == alone
    verify_shards(out)


def test_what_killed_parts_left_is_not_in_the_dataset(
    sequences: list[Sequence], alone: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    write_shards(sequences, out, CONFIG, share=Share(0, 2))
    (tars,) = tmp_path.glob(".out.*.parts/tars")
    (tars / ".train-000001.17717.partial.tar").write_bytes(b"half")
    write_shards(sequences, out, CONFIG, share=Share(1, 2))
    assert bytes_of(out) == alone
    (out / ".train-000001.17717.partial.tar").write_bytes(b"half, by an earlier version")
    write_shards(sequences, out, CONFIG, share=Share(1, 2), overwrite=True)
    write_shards(sequences, out, CONFIG, share=Share(0, 2), overwrite=True)
    assert bytes_of(out) == alone


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_job_killed_when_the_dataset_was_in_its_place_leaves_nothing(
    sequences: list[Sequence], alone: dict[str, bytes], tmp_path: Path, overwrite: bool
) -> None:
    out = tmp_path / "out"
    write_shards(sequences, out, CONFIG, share=Share(0, 2))
    real = shutil.rmtree

    def killed(path: Path, **options: Any) -> None:
        if path.suffix == ".parts":
            raise KeyboardInterrupt
        real(path, **options)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(shutil, "rmtree", killed)
        write_shards(sequences, out, CONFIG, share=Share(1, 2))
    assert bytes_of(out) == alone and len(list(tmp_path.iterdir())) == 2
    for index in range(2):
        write_shards(sequences, out, CONFIG, share=Share(index, 2), overwrite=overwrite)
        assert bytes_of(out) == alone
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("count", [1, 2])
def test_parts_of_other_settings_go_unless_somebody_writes_them(
    sequences: list[Sequence], tmp_path: Path, count: int
) -> None:
    out, other = tmp_path / "out", ShardsConfig(samples_per_shard=5, holdout="none")
    write_shards(sequences, out, other, share=Share(0, 2))
    (left,) = tmp_path.iterdir()
    foreign = tmp_path / ".out.old.parts"
    foreign.mkdir()

    def write_all() -> None:
        for index in range(count):
            write_shards(sequences, out, CONFIG, share=Share(index, count), overwrite=True)

    with (left / ".lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        write_all()
    assert sorted(tmp_path.iterdir()) == sorted([left, foreign, out])
    write_all()
    assert sorted(tmp_path.iterdir()) == sorted([foreign, out])


def test_a_mount_point_is_refused_before_any_work() -> None:
    with pytest.raises(UsageError, match=r"mount point.*Name a folder inside it"):
        check_output(Path("/proc"), CONFIG)
