"""Huge JSON files as a stream: whatever the chunks cut through, exact places in bytes, damage told with its place."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import pytest

from dope.common.errors import BadInput
from pipeline import json_stream
from pipeline.json_stream import Element, Form, read_elements

NASTY = [
    {"a": [1.5, -2e-7, float("inf")], "b": 'ä\n"]},€𝄞', "ö": {"𝄞": ["ß", {"é": "\\u00e9"}]}},
    {},
    [],
    12345,
    -0.5,
    1.5e-300,
    "x",
    "über 𝄞",
    None,
    True,
    float("-inf"),
    {"c": {"d": [[]]}, "e": "😀 \\"},
]


def read(path: Path, form: Form = "any", largest: int = 1 << 20, **options: Any) -> list[Element]:
    return list(read_elements(path, form=form, largest=largest, remedy="Download it again", **options))


def values(path: Path, form: Form = "any") -> list[Any]:
    return [element.value for element in read(path, form)]


@pytest.mark.parametrize("chunk", [1, 2, 3, 7, 64, 1 << 20])
@pytest.mark.parametrize("zipped", [False, True])
def test_a_stream_gives_the_elements_whatever_the_chunks_cut_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int, zipped: bool
) -> None:
    monkeypatch.setattr(json_stream, "CHUNK", chunk)
    path = tmp_path / "a.json"

    def write(text: str) -> None:
        path.write_bytes(gzip.compress(text.encode()) if zipped else text.encode())

    for options in ({}, {"ensure_ascii": False}, {"ensure_ascii": False, "indent": 2}):
        write(json.dumps(NASTY, **options))
        assert values(path) == values(path, "list") == NASTY
        write("\ufeff" + json.dumps({"ü": NASTY, "b": [], "c": [NASTY]}, **options))
        found = read(path, "lists")
        assert [(e.key, e.number, e.value) for e in found[:-1]] == [("ü", i, v) for i, v in enumerate(NASTY)]
        assert found[-1][:3] == ("c", 0, NASTY)
    write(' { "train" : [ 1 , 2 ] , "info" : 1e+2 , "val" : [ ] , "test":[[3]]}\n ')
    assert [e[:3] for e in read(path)] == [("train", 0, 1), ("train", 1, 2), ("info", 0, 100.0), ("test", 0, [3])]
    for text in ("[]", "{}", " [ ] ", "{ }\n"):
        write(text)
        assert read(path) == []


@pytest.mark.parametrize("chunk", [1, 50, 1 << 20])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_offsets_and_lengths_are_bytes_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int, mark: str
) -> None:
    monkeypatch.setattr(json_stream, "CHUNK", chunk)
    path = tmp_path / "a.json"
    path.write_text(mark + json.dumps({"größe": NASTY, "€": NASTY * 2, "info": "ä"}, ensure_ascii=False), "utf-8")
    content = path.read_bytes()
    found = read(path)
    assert len(found) == 3 * len(NASTY) + 1
    for element in found:
        assert json.loads(content[element.offset : element.offset + element.length]) == element.value
    unpacked = [(element.offset, element.length) for element in found]
    path.write_bytes(gzip.compress(content))
    assert [(element.offset, element.length) for element in read(path)] == unpacked
    with pytest.raises(BadInput, match="is gzipped"):
        read(path, may_be_gzipped=False)


@pytest.mark.parametrize("chunk", [1, 64, 1 << 20])
def test_a_malformed_file_is_named_with_its_row_and_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int
) -> None:
    monkeypatch.setattr(json_stream, "CHUNK", chunk)
    path = tmp_path / "a.jgz"
    text = json.dumps([{"name": "größe", "n": i} for i in range(5)], ensure_ascii=False)
    third = text.index('"n": 2')
    byte = len(text[:third].encode())
    object_of_lists = f'{{"a": {text}, "b": {text[:third]}!{text[third:]}}}'
    inner = len(object_of_lists.partition("!")[0].encode())
    for broken, place, form in (
        (text[:third] + "!" + text[third:], f"row 3, byte {byte} of the unpacked text: expecting", "list"),
        (object_of_lists, f"row 3 of 'b', byte {inner} of", "lists"),
        (text.replace("}, {", "} {"), "row 2, byte ", "list"),
        (text[:-1] + "} ]", "row 6, byte ", "list"),
        (text[:-1] + ", ]", "row 6, byte ", "list"),
        (text + "x", "something follows", "list"),
        ('{"a" 1}', "':' is missing", "any"),
        ('{"a": [1] "b": [2]}', "row 2 of 'a', byte 10 of the unpacked text: ',' is missing", "any"),
        ('{"a": [1],}', "a key is missing", "lists"),
        ("{1: [2]}", "a key is missing", "lists"),
        ("[" * 100_000 + "]" * 100_000, "row 1, ", "list"),
        ("[" + "9" * 10_000 + "]", "row 1, ", "list"),
        ("[nul]", "row 1, byte 1 ", "list"),
        (r'["\uzzzz and more text"]', "row 1, byte ", "list"),
    ):
        path.write_bytes(gzip.compress(broken.encode()))
        with pytest.raises(BadInput, match=r"is not valid JSON.*Download it again") as caught:
            read(path, form)
        assert place in str(caught.value) and str(path) in str(caught.value)


def test_another_form_than_asked_for_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for text, form, what in (
        ('{"a": 1}', "list", "is not a list "),
        ("", "list", "is not a list "),
        ("[1]", "lists", "is not an object of lists"),
        ('{"a": [1], "b": 2}', "lists", "is not an object of lists .row 1 of 'b', byte 16"),
        ("1", "any", "is neither a list nor an object"),
        ("", "any", "is neither a list nor an object"),
    ):
        path.write_text(text)
        with pytest.raises(BadInput, match=what):
            read(path, form)


def test_what_is_wrong_is_said_even_where_much_follows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_stream, "CHUNK", 64)
    path = tmp_path / "a.json"
    path.write_text('[{"a": 1}, {"a" 2}' + ', {"a": 3}' * 1000 + "]")
    with pytest.raises(BadInput, match="row 2, byte 16: expecting"):
        read(path, largest=2000)


@pytest.mark.parametrize("chunk", [1, 5, 1 << 20])
def test_bytes_that_are_not_utf8_are_named_with_their_row_and_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int
) -> None:
    monkeypatch.setattr(json_stream, "CHUNK", chunk)
    path = tmp_path / "a.json"
    for content, place in (
        ('["ä", "ö", "'.encode() + b'\xe4"]', "row 3, byte 14"),
        (b"\xff[1]", "row 1, byte 0"),
        (b'["a", "\xc3', "row 2, byte 7"),
        ("[1]".encode("utf-16"), "row 1, byte 0"),
    ):
        path.write_bytes(content)
        with pytest.raises(BadInput, match=rf"is not UTF-8: .* \({place}\)"):
            read(path)


@pytest.mark.parametrize("chunk", [1, 1 << 20])
def test_a_text_that_ends_anywhere_is_cut_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    monkeypatch.setattr(json_stream, "CHUNK", chunk)
    path = tmp_path / "a.json"
    strings = [r'"A\ud83d\ude00\n\\"', "true", "false", "null", "NaN", "-Infinity", "12", '{"k" : [ 1 , {} ] }']
    text = f'{{"a" : [ {" , ".join(strings)} ] , "b": {{ "k" : -1 }} }}'
    for form_text in (text, f"[{text}, {text}]"):
        for length in range(1, len(form_text)):
            path.write_text(form_text[:length])
            with pytest.raises(BadInput, match=rf"is cut off \(row \d( of '.')?, byte {length}\)"):
                read(path)


def test_a_gzip_file_cut_off_or_damaged_is_named_with_the_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(json_stream, "CHUNK", 4096)
    path = tmp_path / "a.jgz"
    whole = gzip.compress(json.dumps([{"name": f"s{i * 7919 % 1000}", "n": i} for i in range(9000)]).encode())
    path.write_bytes(whole[: len(whole) // 2])
    seen: list[int] = []
    with pytest.raises(BadInput, match=r"is cut off \(row \d+, byte \d+ of the unpacked text\)") as caught:
        seen.extend(element.number for element in read_elements(path, largest=1000, remedy="Download it again"))
    assert len(seen) > 1000 and f"row {len(seen) + 1}," in str(caught.value)
    path.write_bytes(whole[:-12] + bytes(4) + whole[-8:])
    with pytest.raises(BadInput, match=r"is damaged|is cut off|is not valid JSON"):
        read(path)
    path.write_bytes(whole[:-8] + bytes(8))  # a wrong checksum, and nothing else wrong
    with pytest.raises(BadInput, match="is damaged"):
        read(path)
    with pytest.raises(BadInput, match="no such file"):
        read(tmp_path / "absent.jgz")
    with pytest.raises(BadInput, match="cannot be read"):
        read(tmp_path)


@pytest.mark.parametrize("start", [b'["', b"[1.", b"[[0", b"[" + b" " * 100 + b'{"'])
def test_an_element_without_an_end_does_not_fill_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: bytes
) -> None:
    monkeypatch.setattr(json_stream, "CHUNK", 1 << 12)
    path = tmp_path / "bomb.jgz"
    path.write_bytes(gzip.compress(start + (b"1" if start != b"[[0" else b",[]") * (20 << 20)))
    with pytest.raises(BadInput, match=r"row 1, .*not closed"):
        read(path, largest=1 << 16)
