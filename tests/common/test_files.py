"""Files are whole or absent."""

from __future__ import annotations

import errno
import os
import pickle
from pathlib import Path

import pytest

from dope.common import files
from dope.common.errors import BadInput, DiskFull, UsageError
from dope.common.seeds import derive_seed


def test_a_failed_write_leaves_the_old_file_and_no_rubbish(tmp_path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), files.atomic_path(path) as partial:
        partial.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_full_disk_is_explained_and_keeps_what_was_there(tmp_path) -> None:
    folder = tmp_path / "dataset"
    folder.mkdir()
    (folder / "old").write_text("old")
    with pytest.raises(DiskFull, match=r"dataset.*Free some space"), files.atomic_folder(folder):
        raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(DiskFull) as caught, files.atomic_folder(folder) as partial, files.atomic_path(partial / "new"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.where == str(folder), "not a file of the temporary folder"
    assert (folder / "old").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["dataset"]


def test_atomic_folder_replaces_the_old_one(tmp_path) -> None:
    folder = tmp_path / "dataset"
    for name in ("first", "second"):
        with files.atomic_folder(folder) as partial:
            (partial / name).write_text(name)
    assert [p.name for p in folder.iterdir()] == ["second"]


def test_what_killed_runs_left_is_cleared_and_what_they_replaced_comes_back(tmp_path) -> None:
    """A kill between the two renames of a replacement leaves the old folder under its temporary name."""
    (tmp_path / ".images.7.partial.old").mkdir()
    (tmp_path / ".images.7.partial.old/a.jpg").write_text("old")
    (tmp_path / ".images.7.partial").mkdir()
    (tmp_path / "masks").mkdir()
    (tmp_path / ".masks.8.partial.old").mkdir()  # killed after both: the new folder is there
    (tmp_path / ".frames.9.partial.parquet").write_text("half")
    (tmp_path / ".lock").touch()
    files.clear_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lock", "images", "masks"]
    assert (tmp_path / "images/a.jpg").read_text() == "old"


@pytest.mark.parametrize("code", [errno.EBUSY, errno.EXDEV])
def test_a_folder_that_cannot_be_replaced_is_explained_and_stays(tmp_path, monkeypatch, code: int) -> None:
    """What the kernel answers where the folder is a volume of a container."""
    folder = tmp_path / "dataset"
    folder.mkdir()

    def busy(path: Path, _: Path) -> None:
        raise OSError(code, os.strerror(code), str(path))

    monkeypatch.setattr(Path, "replace", busy)
    with pytest.raises(BadInput, match=r"dataset: .*mount point.*Name a folder inside it"), files.atomic_folder(folder):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["dataset"]


def test_damaged_json_is_named(tmp_path) -> None:
    path = tmp_path / "marker.json"
    path.write_text('{"a": ')
    with pytest.raises(BadInput, match=r"marker\.json.*Delete it and run again"):
        files.read_json(path)
    with pytest.raises(BadInput) as caught:
        files.read_json(path, remedy="Copy it again")
    assert caught.value.remedy == "Copy it again"


def test_quick_fingerprint_sees_content_but_not_the_time(tmp_path) -> None:
    path = tmp_path / "v.bin"
    path.write_bytes(b"a" * 5_000_000)
    before = files.quick_fingerprint(path)
    os.utime(path, (1, 1))
    assert files.quick_fingerprint(path) == before
    with path.open("r+b") as file:
        file.seek(2_500_000)
        file.write(b"b")
    assert files.quick_fingerprint(path) != before


def test_errors_survive_pickling_with_their_class() -> None:
    error = pickle.loads(pickle.dumps(UsageError("what", where="there", remedy="Do this")))
    assert type(error) is UsageError
    assert str(error) == "there: what. Do this"


def test_seeds_tell_numbers_from_words_and_never_change() -> None:
    assert derive_seed(1, "a") == 4370761895055960103  # in every version and process
    assert derive_seed(1, 23) != derive_seed(12, 3)
    assert derive_seed(1) != derive_seed("1")
    assert 0 <= derive_seed("x") < 2**63
