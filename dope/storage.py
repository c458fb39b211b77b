"""Where shards lie: a local folder, or an object store behind an fsspec URL. The only importer of fsspec.

What is read of a batch is known before it is read. So byte ranges that lie side by side become one long read, a gap of
a few samples is read over, what is further away is skipped, and a remote store is asked for all ranges at once.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

from dope.common.errors import BadInput, UsageError

Shards = str | Path
"""A folder of shards: a local path, or a URL such as `s3://bucket/shards`."""

LOCAL_GAP = 64 << 10
"""Bytes that a local read runs over rather than start anew: less than a sample of 224 px."""
REMOTE_GAP = 1 << 20
"""The same for a remote store, where a request costs as much time as some megabytes."""
LONGEST_READ = 8 << 20
"""Bytes of one read; longer stretches become several, which a remote store serves at the same time."""
MAX_OPEN_FILES = 256
"""Shards that a process keeps open; systems allow as few as 1,024 files."""
ATTEMPTS, PAUSE_S = 3, 1.0
"""How often a remote range is asked for, and the seconds before it is asked for again."""
THREADS = 8
"""Requests at a time to a store whose fsspec class is not asynchronous (hf://)."""

EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gs", "gcs": "gs", "hf": "hf"}
REMEDY = "SHARDS is what `dope prep shards --out` wrote"


class Range(NamedTuple):
    """The bytes from `start` up to `end` of the file `name`."""

    name: str
    start: int
    end: int


class Storage(ABC):
    """The files of one folder. Cheap to make; safe to use in a forked or spawned process, which opens all anew.

    Attributes:
        address: the folder's path or URL.
        gap: bytes that a read runs over.
    """

    address: str
    gap: int

    @abstractmethod
    def where(self, name: str) -> str:
        """The path or URL of a file, for people."""

    @abstractmethod
    def sizes(self) -> dict[str, int]:
        """Name and size in bytes of every file that is there now. Raises `BadInput` where there is no such folder."""

    @abstractmethod
    def open(self, name: str) -> BufferedReader:
        """A file to be read from start to end."""

    @abstractmethod
    def fetch(self, ranges: Sequence[Range]) -> list[bytes | Exception]:
        """Each range as one read: its bytes (fewer where the file ends before), or why there are none."""

    @abstractmethod
    def close(self) -> None:
        """Close what is open; it is opened again when needed."""

    def read(self, ranges: Sequence[Range]) -> list[memoryview | Exception]:
        """Many ranges in as few reads as is sensible: the bytes of each (fewer where the file ends before), or why not.

        Where a long read fails, its ranges are read one by one: one unreadable place costs no others.
        """
        groups = coalesce(ranges, self.gap)
        whole = [Range(*ranges[group[0]][:2], max(ranges[i].end for i in group)) for group in groups]
        found: list[memoryview | Exception] = [OSError()] * len(ranges)
        again: list[int] = []
        for group, merged, data in zip(groups, whole, self.fetch(whole), strict=True):
            if isinstance(data, Exception) and len(group) > 1:
                again += group
                continue
            for i in group:
                start, end = ranges[i].start - merged.start, ranges[i].end - merged.start
                found[i] = data if isinstance(data, Exception) else memoryview(data)[start:end]
        for i, data in zip(again, self.fetch([ranges[i] for i in again]), strict=True):
            found[i] = data if isinstance(data, Exception) else memoryview(data)
        return found

    @abstractmethod
    def read_bytes(self, name: str) -> bytes:
        """A whole file. Raises `BadInput` where it cannot be read."""

    def read_json(self, name: str) -> Any:
        """A JSON file. Raises `BadInput` where it cannot be read or is no JSON."""
        try:
            return json.loads(self.read_bytes(name))
        except ValueError as error:
            raise BadInput(f"is not valid JSON ({error})", where=self.where(name), remedy=REMEDY) from error

    def sha256(self, name: str) -> str:
        """SHA-256 of a whole file, as hex. Raises `BadInput` where it cannot be read."""
        with self._explaining(name), self.open(name) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    @contextmanager
    def _explaining(self, name: str) -> Iterator[None]:
        """Whatever goes wrong in reading a file, as `BadInput` that names it."""
        try:
            yield
        except FileNotFoundError as error:
            raise BadInput("no such file", where=self.where(name), remedy=REMEDY) from error
        except Exception as error:  # of whatever package the store is reached by
            raise BadInput(f"cannot be read ({reason_of(error)})", where=self.where(name)) from error


def open_storage(shards: Shards) -> Storage:
    """The storage of a path or URL; nothing is read yet.

    Raises:
        UsageError: a URL of an unknown kind, or of one whose package is not installed (the extra is named).
    """
    address = os.fspath(shards)
    if address.startswith("file://"):
        return LocalFolder(Path(address.removeprefix("file://")))
    return RemoteFolder(address) if "://" in address else LocalFolder(Path(address))


def coalesce(ranges: Sequence[Range], gap: int, longest: int = LONGEST_READ) -> list[list[int]]:
    """Which ranges to read together: lists of their places, each by position in one file.

    Neighbours are joined where at most `gap` bytes lie between them and the read stays within `longest`.
    """
    groups: list[list[int]] = []
    name, start, end = "", 0, 0
    for i in sorted(range(len(ranges)), key=ranges.__getitem__):
        this = ranges[i]
        if groups and this.name == name and this.start <= end + gap and max(end, this.end) - start <= longest:
            groups[-1].append(i)
            end = max(end, this.end)
        else:
            groups.append([i])
            name, start, end = this
    return groups


class LocalFolder(Storage):
    """A folder of this machine, read by `os.pread`, which needs neither a seek nor a lock."""

    gap = LOCAL_GAP

    def __init__(self, folder: Path) -> None:
        self.folder, self.address = folder, str(folder)
        self._files: dict[str, int] = {}
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:  # neither descriptors nor locks mean anything in a spawned worker
        return {"folder": self.folder}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["folder"])  # type: ignore[misc]

    def where(self, name: str) -> str:
        return f"{self.address}{os.sep}{name}"  # pathlib would cost as much as reading the sample

    def sizes(self) -> dict[str, int]:
        if not self.folder.is_dir():
            raise BadInput("no such folder", where=self.folder, remedy=REMEDY)
        return {path.name: path.stat().st_size for path in self.folder.iterdir() if path.is_file()}

    def open(self, name: str) -> BufferedReader:
        return (self.folder / name).open("rb")

    def read_bytes(self, name: str) -> bytes:
        with self._explaining(name):
            return (self.folder / name).read_bytes()

    def fetch(self, ranges: Sequence[Range]) -> list[bytes | Exception]:
        return [self._pread(*one) for one in ranges]

    def close(self) -> None:
        with self._lock:
            while self._files:
                os.close(self._files.popitem()[1])

    def _pread(self, name: str, start: int, end: int) -> bytes | Exception:
        try:
            return os.pread(self._descriptor(name), end - start, start)
        except OSError as error:
            return error

    def _descriptor(self, name: str) -> int:
        with self._lock:
            descriptor = self._files.pop(name, None)
            if descriptor is None:
                descriptor = os.open(self.folder / name, os.O_RDONLY)
            self._files[name] = descriptor  # the newest is the last
            if len(self._files) > MAX_OPEN_FILES:
                os.close(self._files.pop(next(iter(self._files))))
            return descriptor


class RemoteFolder(Storage):
    """A folder behind an fsspec URL; credentials and endpoints come from where the store's package looks for them."""

    gap = REMOTE_GAP

    def __init__(self, url: str) -> None:
        self.address = url.rstrip("/")
        self._opened: tuple[int, Any, str] | None = None
        _ = self._fs  # what is not installed is said now

    def __getstate__(self) -> dict[str, Any]:
        return {"address": self.address, "_opened": None}

    @property
    def _fs(self) -> tuple[Any, str]:
        """fsspec's filesystem and the folder's path in it, opened in each process anew: the event loops of the
        asynchronous ones do not survive a fork."""
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = (os.getpid(), *_open_url(self.address))
        return self._opened[1:]

    def where(self, name: str) -> str:
        return f"{self.address}/{name}"

    def sizes(self) -> dict[str, int]:
        fs, root = self._fs
        try:
            fs.invalidate_cache()  # a listing of before is not what is there now
            listed = fs.ls(root, detail=True)
        except FileNotFoundError as error:
            raise BadInput("no such folder", where=self.address, remedy=REMEDY) from error
        except Exception as error:
            what = f"cannot be listed ({reason_of(error)})"
            raise BadInput(what, where=self.address, remedy="Look at the URL and at your credentials") from error
        files = [entry for entry in listed if entry["type"] == "file"]
        return {entry["name"].rstrip("/").rsplit("/", 1)[-1]: int(entry["size"] or 0) for entry in files}

    def open(self, name: str) -> BufferedReader:
        fs, root = self._fs
        return fs.open(f"{root}/{name}", "rb")

    def read_bytes(self, name: str) -> bytes:
        fs, root = self._fs
        with self._explaining(name):
            return fs.cat_file(f"{root}/{name}")

    def fetch(self, ranges: Sequence[Range]) -> list[bytes | Exception]:
        results: list[bytes | Exception] = self._cat(ranges)
        for attempt in range(1, ATTEMPTS):
            failed = [i for i, data in enumerate(results) if isinstance(data, Exception) and _may_pass(data)]
            if not failed:
                break
            time.sleep(PAUSE_S * attempt)
            for i, data in zip(failed, self._cat([ranges[i] for i in failed]), strict=True):
                results[i] = data
        return results

    def close(self) -> None:
        self._opened = None

    def _cat(self, ranges: Sequence[Range]) -> list[bytes | Exception]:
        fs, root = self._fs

        def cat(some: Sequence[Range], **options: Any) -> list[bytes | Exception]:
            paths = [f"{root}/{one.name}" for one in some]
            starts, ends = [one.start for one in some], [one.end for one in some]
            try:
                return fs.cat_ranges(paths, starts, ends, on_error="return", **options)
            except Exception as error:  # what a store throws all the same is no reason to lose the worker
                return [error] * len(some)

        if not ranges:
            return []
        if fs.async_impl:
            return cat(ranges)  # all at the same time
        with ThreadPoolExecutor(min(THREADS, len(ranges))) as pool:
            # nothing beyond the range is read ahead
            return [data for some in pool.map(lambda one: cat([one], cache_type="none"), ranges) for data in some]


def _open_url(url: str) -> tuple[Any, str]:
    import fsspec.core

    protocol = url.split("://", 1)[0].rsplit("::", 1)[-1]
    try:
        fs, root = fsspec.core.url_to_fs(url)
    except ImportError as error:
        extra = EXTRAS.get(protocol)
        remedy = f"pip install 'dope-descriptors[{extra}]'" if extra else str(error)
        raise UsageError(f"{protocol}:// needs a package that is not installed", where=url, remedy=remedy) from error
    except ValueError as error:
        remedy = "Give a local folder, or a URL such as s3://bucket/shards, gs:// or hf://"
        raise UsageError(f"cannot be opened ({reason_of(error)})", where=url, remedy=remedy) from error
    return fs, root.rstrip("/")


def _may_pass(error: Exception) -> bool:
    return not isinstance(error, (FileNotFoundError, PermissionError))


def reason_of(error: Exception) -> str:
    """One line: an OSError's reason without the path, which is said anyway, else the first line."""
    return (isinstance(error, OSError) and error.strerror) or str(error).split("\n", 1)[0] or type(error).__name__
