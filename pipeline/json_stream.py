"""Huge JSON files, gzipped or not, read element by element: memory does not grow with the file.

Such files are one list, or an object of lists: CO3D's annotations (.jgz) and set lists, COCO's results and datasets.
Python's own decoder takes each element; only its text and a chunk of what follows are ever held.
"""

from __future__ import annotations

import gzip
import json
import re
import zlib
from codecs import getincrementaldecoder
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple, cast

from dope.common.errors import BadInput

CHUNK = 1 << 20
GZIP_MAGIC = b"\x1f\x8b"
BYTE_ORDER_MARK = "\ufeff"  # that some editors put before UTF-8
LONGEST_ESCAPE, LONGEST_WORD = 8, 16
LONGEST_EXPONENT = 2  # characters after a number that may belong to it once more follows: "1" of "1.5", of "1e-7"
BEGINNINGS = {
    word[:n]
    for word in ("true", "false", "null", "NaN", "Infinity", "-Infinity", ".", "e-", "e+", "E-", "E+")
    for n in range(len(word) + 1)
}
"""What an error may stand before only because the text does not go on yet."""

Form = Literal["list", "lists", "any"]
"""What a file must be: a list, an object of lists, or either, where the object may hold other values, too."""
WRONG_FORM = {
    "list": "is not a list",
    "lists": "is not an object of lists",
    "any": "is neither a list nor an object",
}

_space = re.compile(r"[ \t\r\n]*")


class Element(NamedTuple):
    """An element of a list, or a value of the object that is no list."""

    key: str | None
    """That the list or value has in the object; None where the file is one list."""
    number: int
    """From 0 in its list."""
    value: Any
    offset: int
    """Where its text starts in the (unpacked) file, in bytes."""
    length: int
    """Bytes of its text."""


def read_elements(
    path: Path,
    *,
    form: Form = "any",
    largest: int,
    remedy: str,
    may_be_gzipped: bool = True,
    keys: list[str] | None = None,
) -> Iterator[Element]:
    """The elements of a JSON file in UTF-8, in the file's order.

    Args:
        largest: characters of an element. What is larger is an error; a few times as much memory may be needed.
        remedy: what to do about a file that is cut off, damaged or malformed.
        may_be_gzipped: not where elements are to be read again by their offsets.
        keys: where given, the object's keys are added to it as they are met, also those of empty lists.

    Raises:
        BadInput: the file is absent, cut off, damaged, malformed or of another form; the message says at which row
            (from 1) and byte. Elements before that have been yielded by then.
    """
    try:
        raw = path.open("rb")
        gzipped = raw.peek(2)[:2] == GZIP_MAGIC
    except FileNotFoundError:
        raise BadInput("no such file", where=path) from None
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
    with raw:
        if gzipped and not may_be_gzipped:
            raise BadInput("is gzipped", where=path, remedy="Unpack it with `gunzip`")
        # a gzip file's checksum is compared when its end is read: `elements` reads on to there
        file = cast(BinaryIO, gzip.GzipFile(fileobj=raw)) if gzipped else raw
        yield from _JsonText(file, path, largest, remedy, [] if keys is None else keys).elements(form)


class _JsonText:
    """The unread text of a JSON file, and where it lies in the file."""

    def __init__(self, file: BinaryIO, path: Path, largest: int, remedy: str, keys: list[str]) -> None:
        self.file, self.path, self.largest, self.remedy, self.keys = file, path, largest, remedy, keys
        self.text, self.at, self.ended = "", 0, False
        self.skipped = 0
        """Bytes of the file before what stands at `at`, less `at`."""
        self.key: str | None = None
        self.number = 0
        self.decode_json = json.JSONDecoder().raw_decode
        self.decoder = getincrementaldecoder("utf-8")()

    def elements(self, form: Form) -> Iterator[Element]:
        if self._next() == BYTE_ORDER_MARK and self.skipped + self.at == 0:
            self.at, self.skipped = 1, 2
        opening = self._next()
        if opening == "[" and form != "lists":
            yield from self._list()
        elif opening == "{" and form != "list":
            yield from self._object(form)
        else:
            raise self._wrong(WRONG_FORM[form])
        if self._next():
            raise self._malformed("something follows after the end")

    def _object(self, form: Form) -> Iterator[Element]:
        self._take("{")
        if self._next() == "}":
            self._take("}")
            return
        while True:
            if self._next() not in ('"', ""):
                raise self._malformed("a key is missing")
            self.key, self.number = self._value().value, 0
            self.keys.append(str(self.key))
            self._take(":")
            if self._next() == "[":
                yield from self._list()
            elif form == "lists" and self._next():
                raise self._wrong(WRONG_FORM[form])
            else:
                yield self._value()
            if self._take(",}") == "}":
                return

    def _list(self) -> Iterator[Element]:
        self._take("[")
        if self._next() == "]":
            self._take("]")
            return
        while True:
            yield self._value()
            self.number += 1
            if self.text.startswith(", ", self.at):  # as most files have it: a third less time for short ones
                self.at += 2
            elif self._take(",]") == "]":
                return

    def _next(self) -> str:
        """The next character that is no white space, which stays unread; empty at the end."""
        while True:
            if (found := self.text[self.at : self.at + 1]) > " ":  # by far the most
                return found
            if match := _space.match(self.text, self.at):
                self.at = match.end()
            if self.at < len(self.text):
                return self.text[self.at]
            if not self._more():
                return ""

    def _take(self, characters: str) -> str:
        """Read the next character, which must be one of these."""
        found = self._next()
        if found and found in characters:
            self.at += 1
            return found
        raise self._malformed(f"'{characters[0]}' is missing") if found else self._wrong("is cut off")

    def _value(self) -> Element:
        """The next value, whole."""
        self._next()
        while True:
            error: json.JSONDecodeError | None = None
            try:
                value, end = self.decode_json(self.text, self.at)
                if end + LONGEST_EXPONENT < len(self.text) or self.ended:
                    offset, length = self.skipped + self.at, end - self.at
                    if not self.text.isascii():
                        length = len(self.text[self.at : end].encode())
                        self.skipped += length - (end - self.at)
                    self.at = end
                    return Element(self.key, self.number, value, offset, length)
            except json.JSONDecodeError as caught:
                error = caught
                if not self._may_go_on(caught):
                    raise self._malformed(f"{caught.msg[0].lower()}{caught.msg[1:]}", caught.pos) from caught
            except (ValueError, RecursionError) as caught:  # a number of thousands of digits, thousands of brackets
                raise self._malformed(str(caught)) from caught
            if len(self.text) - self.at > self.largest:
                raise self._malformed(f"larger than {self.largest >> 20} MiB, or not closed")
            if not self._more() and error is not None:
                raise self._wrong("is cut off", at=len(self.text)) from error

    def _may_go_on(self, error: json.JSONDecodeError) -> bool:
        """Could what is wrong be only that the text does not go on yet?"""
        if error.msg.startswith("Unterminated"):
            return True
        if error.msg.startswith("Invalid \\u"):
            return len(self.text) - error.pos < LONGEST_ESCAPE
        return self.text[error.pos : error.pos + LONGEST_WORD] in BEGINNINGS

    def _more(self) -> bool:
        """Read on; False at the end. At least as much as there is unread: a huge element is tried seldom."""
        if self.ended:
            return False
        try:
            chunk = self.file.read(max(CHUNK, len(self.text) - self.at))
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            what = "is cut off" if isinstance(error, EOFError) else "is damaged"
            raise self._wrong(what, at=len(self.text)) from error
        except OSError as error:
            raise BadInput(f"cannot be read ({error.strerror})", where=self.path) from error
        self.ended = not chunk
        try:
            text = self.decoder.decode(chunk, final=self.ended)
        except UnicodeDecodeError as error:
            text = error.object[: error.start].decode()
            if not text:
                raise self._wrong(f"is not UTF-8: {error.reason}", at=len(self.text)) from error
            self.decoder.setstate((error.object[error.start :], 0))  # met again after what stands before it
            self.ended = False
        self.text, self.skipped, self.at = self.text[self.at :] + text, self.skipped + self.at, 0
        return not self.ended

    def _malformed(self, what: str, at: int | None = None) -> BadInput:
        return self._wrong("is not valid JSON", at, f": {what}")

    def _wrong(self, what: str, at: int | None = None, why: str = "") -> BadInput:
        """An error at a place of `text`, by default the next to be read."""
        byte = self.skipped + self.at + len(self.text[self.at : at].encode() if at is not None else b"")
        row = f"row {self.number + 1}" + (f" of {self.key!r:.60}" if self.key is not None else "")
        unpacked = " of the unpacked text" if isinstance(self.file, gzip.GzipFile) else ""
        return BadInput(f"{what} ({row}, byte {byte}{unpacked}{why})", where=self.path, remedy=self.remedy)
