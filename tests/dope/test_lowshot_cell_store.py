"""Descriptors beyond --memory: they come back as they were, nothing stays on the disk, and a full disk is explained."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tiny_views import write_views
from torch import Tensor

from dope.common.errors import DiskFull, UsageError
from dope.lowshot import cell_store, local
from dope.lowshot.cell_store import CellStore, SpillFile
from dope.lowshot.encoding import ViewCells
from dope.lowshot.episodes import EpisodeConfig
from dope.lowshot.evaluate import EvaluationConfig, evaluate
from dope.networks import NetworkConfig

NETWORK = NetworkConfig(width=0.125, pyramid=16, projector=(24, 12))
CONFIG = EvaluationConfig(protocols=(EpisodeConfig(ways=3, shots=2, queries=2, episodes=10),))


def doubled(features: Tensor, norms: NDArray[np.float32]) -> Tensor:
    return 2 * features[:, :3]


def view(seed: int) -> ViewCells:
    rng = np.random.default_rng(seed)
    norms = np.sort(rng.random(12).astype(np.float32))[::-1].copy()
    descriptors, rest = (
        torch.from_numpy(rng.random((4, 3), np.float32)),
        torch.from_numpy(rng.random((8, 5), np.float32)),
    )
    return ViewCells((3, 4), rng.permutation(12), norms, descriptors, rest, doubled)


@pytest.mark.parametrize("room", [0, 10**9, 2 * view(0).nbytes])
def test_views_come_back_as_they_were_once_each(tmp_path: Path, room: float) -> None:
    store = CellStore(SpillFile(tmp_path))
    assert all(store.put(i, view(i), room) for i in range(5))
    assert store.spilled == {0: 5, 10**9: 0}.get(int(room), 3)
    assert list(tmp_path.iterdir()) == []  # the file has no name, so that nothing can stay
    for i, cells in store.take_all():
        same = view(i)
        np.testing.assert_array_equal(cells.cells, same.cells)
        np.testing.assert_array_equal(cells.norm_map, same.norm_map)
        assert torch.equal(cells.at(np.array([0, 11, 5])), same.at(np.array([0, 11, 5])))
        assert torch.equal(cells.descriptors(0, 12), same.descriptors(0, 12))
    assert list(store.take_all()) == []


def test_without_a_file_what_has_no_room_is_refused() -> None:
    store = CellStore(None)
    assert [store.put(i, view(i), 1.5 * view(0).nbytes) for i in range(3)] == [True, False, False]


def test_a_full_disk_says_which_and_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spill = SpillFile(tmp_path)
    full_device = os.open("/dev/full", os.O_RDWR)
    monkeypatch.setattr(spill, "_file", os.fdopen(full_device, "r+b", buffering=0))
    with pytest.raises(DiskFull, match=r"no space left for descriptors beyond --memory.*--cache") as error:
        CellStore(spill).put(0, view(0), 0)
    assert str(tmp_path) in str(error.value)

    def full(*arguments: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(DiskFull, match="--cache"):
        SpillFile(tmp_path).reserve((1000, 20, 256))


def test_a_folder_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--cache .*absent: cannot be written to"):
        SpillFile(tmp_path / "absent")
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match=r"--cache .*file: cannot be written to"):
        SpillFile(tmp_path / "file")


def test_a_reserved_array_lies_beside_what_is_appended(tmp_path: Path) -> None:
    spill = SpillFile(tmp_path)
    first = spill.append(np.arange(5, dtype=np.int32))
    array = spill.reserve((3, 2))
    last = spill.append(np.arange(7, dtype=np.float32))
    array[:] = 9
    assert spill.read(first).tolist() == [0, 1, 2, 3, 4] and spill.read(last).tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert (array == 9).all() and spill.read(spill.append(np.empty((0, 4), np.float32))).shape == (0, 4)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_views(tmp_path_factory.mktemp("shards"), size=32)


def evaluated(shards: Path, **changes: Any) -> Any:
    return evaluate(None, shards, replace(CONFIG, **changes), network=NETWORK)


def test_rows_do_not_depend_on_batches_memory_or_cache(shards: Path, tmp_path: Path) -> None:
    whole = evaluated(shards)
    for changes in (
        {"batch": 3, "memory_gib": 0.0},
        {"memory_gib": 0.0, "spill": "always", "cache": tmp_path},
        {"memory_gib": 0.0, "spill": "never", "batch": 7},
        {"memory_gib": 1e-4, "spill": "always"},
    ):
        assert evaluated(shards, **changes).rows == whole.rows
    assert whole.encode_ms_per_view > 0 and whole.match_ms_per_episode > 0


def test_what_takes_less_time_is_done_and_a_full_disk_left_alone() -> None:
    gib = cell_store.GIB
    assert local._why_not_spill(0.01, 0.2, 9 * gib) == ""
    assert "slower" in local._why_not_spill(0.01, 0.015, 9 * gib)
    assert "full" in local._why_not_spill(0.01, 0.2, gib // 2)


def test_spilling_that_is_stopped_midway_changes_no_row(shards: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected, asked = evaluated(shards).rows, []
    monkeypatch.setattr(local, "_TRIED", 4)

    def stop_at_eight(*arguments: float) -> str:
        asked.append(arguments)
        return "enough" if len(asked) == 2 else ""

    monkeypatch.setattr(local, "_why_not_spill", stop_at_eight)
    result = evaluated(shards, memory_gib=0.0)
    assert result.rows == expected and len(asked) == 2
    assert any(note.startswith("enough: ") and "encoded twice" in note for note in result.notes)
