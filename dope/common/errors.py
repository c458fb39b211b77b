"""The errors that a user is meant to read: what was wrong, where, and what to do about it."""

from __future__ import annotations

from pathlib import Path


class DopeError(Exception):
    """A failure with an explanation. `dope` prints it without a traceback and exits with 1.

    Args:
        what: what went wrong, in one clause.
        where: the file, folder or setting it is about, if there is one.
        remedy: what the user can do, with the flag's name.
    """

    def __init__(self, what: str, *, where: str | Path | None = None, remedy: str | None = None) -> None:
        self.what, self.where, self.remedy = what, None if where is None else legible(where), remedy
        super().__init__(str(self))

    def __str__(self) -> str:
        text = f"{self.where}: {self.what}" if self.where else self.what
        return f"{text}. {self.remedy}" if self.remedy else text

    def __reduce__(self) -> tuple[object, ...]:  # keyword-only arguments do not survive the default pickling
        return (_rebuild, (type(self), self.what, self.where, self.remedy))


def legible(name: str | Path) -> str:
    """A file's name as text that can be written anywhere: bytes of it that are no UTF-8 become escapes."""
    return str(name).encode("utf-8", "backslashreplace").decode()


class UsageError(DopeError):
    """The command line or configuration is wrong: exit code 2."""


class BadInput(DopeError):
    """One input (a video, a folder, a shard, a checkpoint) cannot be used; the others can."""


class DiskFull(DopeError):
    """No space left while writing. What was there before is untouched."""


class WorkerDied(DopeError):
    """A process that works for this one was killed, e.g. by a lack of memory: it may go well the next time."""


def _rebuild(cls: type[DopeError], what: str, where: str | None, remedy: str | None) -> DopeError:
    return cls(what, where=where, remedy=remedy)
