"""Samples inside shards: read by byte offset, split into their members by a walk over the 512-byte tar headers.

Python's tarfile manages 12,700 members a second, this walk some twenty times as many, and `os.pread` needs neither a
seek nor a lock: any process reads any sample.
"""

from __future__ import annotations

import os
from pathlib import Path

from dope.common.errors import BadInput

BLOCK = 512
REMAKE = "Copy the shard again from where it came, or write the shards anew with `dope prep shards --overwrite`"


def split_members(data: bytes, where: str) -> dict[str, bytes]:
    """The regular files of a run of tar members (headers and padding included), by name.

    Raises:
        BadInput: a header is damaged or the last member is cut off; `where` names the shard.
    """
    members: dict[str, bytes] = {}
    position, long_name = 0, None
    while position + BLOCK <= len(data):
        header = data[position : position + BLOCK]
        if not header.strip(b"\0"):  # the zero blocks that end an archive
            break
        if _stored_checksum(header) != sum(header[:148]) + 8 * 0x20 + sum(header[156:]):
            raise BadInput(f"damaged tar header at byte {position} of the sample", where=where, remedy=REMAKE)
        size = _number(header[124:136])
        start = position + BLOCK
        if start + size > len(data):
            raise BadInput("a sample is cut off", where=where, remedy=REMAKE)
        content = data[start : start + size]
        kind = header[156:157]
        if kind == b"x":
            long_name = _pax_path(content) or long_name
        elif kind == b"L":
            long_name = content.rstrip(b"\0").decode()
        else:
            if kind in (b"0", b"\0"):
                members[long_name or _name(header)] = content
            long_name = None
        position = start + -(-size // BLOCK) * BLOCK
    return members


class ShardReader:
    """Reads byte ranges of the shards of one folder; files are opened when first needed, in each process anew."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._files: dict[str, int] = {}

    def __getstate__(self) -> dict[str, object]:  # descriptors mean nothing in a spawned worker
        return {"folder": self.folder, "_files": {}}

    def read(self, shard: str, offset: int, size: int) -> bytes:
        """`size` bytes at `offset`. Raises `BadInput` where the shard is absent or too short."""
        path = self.folder / shard
        try:
            if shard not in self._files:
                self._files[shard] = os.open(path, os.O_RDONLY)
            data = os.pread(self._files[shard], size, offset)
        except OSError as error:
            raise BadInput(f"cannot be read ({error.strerror})", where=path, remedy=REMAKE) from error
        if len(data) != size:
            raise BadInput(f"ends before byte {offset + size}", where=path, remedy=REMAKE)
        return data

    def sample(self, shard: str, offset: int, size: int, key: str) -> dict[str, bytes]:
        """The members of one sample by extension (`1.jpg`, `corr.npy` ...).

        Raises:
            BadInput: the bytes at this place are not the sample `key`.
        """
        path = str(self.folder / shard)
        members = split_members(self.read(shard, offset, size), path)
        if not members or any(not name.startswith(key + ".") for name in members):
            raise BadInput(
                f"sample '{key}' is not at byte {offset}: the shard and index.parquet are of different datasets",
                where=path,
                remedy=REMAKE,
            )
        return {name[len(key) + 1 :]: content for name, content in members.items()}

    def close(self) -> None:
        """Close the files."""
        while self._files:
            os.close(self._files.popitem()[1])


def _stored_checksum(header: bytes) -> int:
    try:
        return int(header[148:156].strip(b"\0 ") or b"-1", 8)
    except ValueError:
        return -1


def _number(field: bytes) -> int:
    if field[0] & 0x80:  # base 256, for sizes of 8 GiB and more
        return int.from_bytes(bytes([field[0] & 0x7F]) + field[1:], "big")
    return int(field.strip(b"\0 ") or b"0", 8)


def _name(header: bytes) -> str:
    name = header[:100].rstrip(b"\0")
    prefix = header[345:500].rstrip(b"\0") if header[257:262] == b"ustar" else b""
    return (prefix + b"/" + name if prefix and header[257:263] == b"ustar\0" else name).decode()


def _pax_path(content: bytes) -> str | None:
    while content:
        length, _, rest = content.partition(b" ")
        record, content = rest[: int(length) - len(length) - 2], content[int(length) :]
        if record.startswith(b"path="):
            return record[5:].decode()
    return None
