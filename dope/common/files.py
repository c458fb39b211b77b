"""Files that are either whole or absent: written under a temporary name, synced, renamed."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dope.common.errors import BadInput, DiskFull

TEMPORARY = ".partial"  # suffix of everything half-written; safe to delete when nothing runs


@contextmanager
def explaining_full_disk(path: Path) -> Iterator[None]:
    """Turn "no space left" (and quota) errors of a block into `DiskFull` naming `path`."""
    try:
        yield
    except DiskFull as error:  # of a file in a temporary folder, which says nothing to the user
        raise DiskFull(error.what, where=path, remedy=error.remedy) from error
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskFull(
                "no space left on the disk; nothing that was there before is lost",
                where=path,
                remedy="Free some space or choose another --out, then run the same command again",
            ) from error
        raise


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success sync it and rename it to `path`, else delete it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # the real suffix stays last: writers such as cv2.imwrite choose the format by it
    partial = path.with_name(f".{path.stem}.{os.getpid()}{TEMPORARY}{path.suffix}")
    with explaining_full_disk(path):
        try:
            yield partial
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield an empty temporary folder beside `path`; on success it takes the place of `path`, else it is deleted."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY}")
    shutil.rmtree(partial, ignore_errors=True)
    with explaining_full_disk(path):
        try:
            partial.mkdir()
            yield partial
            replace_folder(partial, path)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def replace_folder(new: Path, path: Path) -> None:
    """Put the folder `new` in the place of `path`, which may exist; on failure `path` is what it was.

    Raises:
        BadInput: `path` is a mount point, or on another disk than `new`.
    """
    old = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY}.old")
    try:
        if path.exists():
            path.replace(old)  # two renames: the moment without either folder does not grow with its size
        new.replace(path)
    except BaseException as error:
        if old.exists() and not path.exists():
            old.replace(path)
        if isinstance(error, OSError) and error.errno in (errno.EBUSY, errno.EXDEV):  # e.g. a volume of a container
            what = f"cannot be replaced as a whole: is it a mount point? ({error.strerror})"
            raise BadInput(what, where=path, remedy="Name a folder inside it") from error
        raise
    shutil.rmtree(old, ignore_errors=True)


def clear_leftovers(folder: Path, of: str | None = None) -> None:
    """Remove what killed processes left half-written in `folder`; bring back a folder that was just being replaced.

    Only where nothing else writes, e.g. under a lock: to `folder`, or to the folder named `of` in it.
    """
    for path in sorted(folder.glob(f".*{TEMPORARY}*")):
        if of is not None and not re.fullmatch(rf"\.{re.escape(of)}\.\d+{re.escape(TEMPORARY)}(\.old)?", path.name):
            continue
        whole = folder / path.name[1:].rsplit(".", 3)[0]  # ".images.123.partial.old" was "images"
        if path.name.endswith(f"{TEMPORARY}.old") and not whole.exists():
            path.replace(whole)
        elif path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` atomically."""
    with atomic_path(path) as partial:
        partial.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically, keys in the given order, so that equal values give equal bytes."""
    write_bytes(path, (json.dumps(value, indent=1, ensure_ascii=False) + "\n").encode())


def read_json(path: Path, *, remedy: str = "Delete it and run again") -> Any:
    """Read JSON. Raises `BadInput` naming the file where it is absent or not JSON.

    Args:
        remedy: what to do about a file that is not JSON; the default is for files that can be made again.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadInput("no such file", where=path) from None
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
    except (ValueError, UnicodeDecodeError) as error:
        raise BadInput(f"is not valid JSON ({error})", where=path, remedy=remedy) from error


def sha256_of(path: Path) -> str:
    """SHA-256 of a whole file, as hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def quick_fingerprint(path: Path, chunk: int = 1 << 20) -> str:
    """A hash of name, size and up to three chunks (start, middle, end): cheap for videos, whole for photos.

    It does not read the modification time, so that a copied input is still the same input.
    """
    size = path.stat().st_size
    digest = hashlib.sha256(os.fsencode(path.name) + f"\0{size}\0".encode())
    with path.open("rb") as file:
        for start in sorted({0, max(0, size // 2 - chunk // 2), max(0, size - chunk)}):
            file.seek(start)
            digest.update(file.read(chunk))
    return digest.hexdigest()
