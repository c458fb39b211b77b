"""`dope prep status`: a row a sequence from its small files, in whatever state they are."""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from prepared_files import STAGES, write_files, write_marker
from typer.testing import CliRunner

import cli
from dope.common.errors import BadInput, UsageError
from pipeline import engines
from pipeline.report import status_table
from pipeline.report.filters import parse_condition, select, sort_rows
from pipeline.report.status_row import NAMES, SCHEMA
from pipeline.report.status_table import held_files, read_status, write_csv, write_parquet
from pipeline.report.status_text import kind_of_reason, lines_of, summary
from pipeline.sequence import Sequence
from pipeline.shards.catalogue import read_catalogue


def rows_of(*places: Path) -> dict[str, dict[str, Any]]:
    return {row["id"]: row for row in read_status(list(places)).to_pylist()}


def only_row(work: Path) -> dict[str, Any]:
    (row,) = read_status([work]).to_pylist()
    return row


def status(*words: object) -> Any:
    return CliRunner().invoke(cli.app, ["prep", "status", *map(str, words)], catch_exceptions=False)


def test_a_finished_sequence_has_every_figure(tmp_path: Path) -> None:
    write_files(tmp_path / "cup_1")
    row = only_row(tmp_path)
    wanted = {
        "id": "cup_1", "status": "ok", "stage": "correspond", "next": None, "reason": None, "category": "cup",
        "kind": "video", "frames": 60, "kept": 50, "registered": 48, "registered_share": 0.96, "error_px": 0.81,
        "points": 2983, "depth_coverage": 0.7, "depth_error": 0.003, "masks": 47, "masks_missing": 1, "masks_empty": 2,
        "masks_flagged": None, "views": 17, "pairs": 64, "correspondences": 512.0, "seconds": 10.0, "cpu_seconds": 7.5,
        "peak_memory_mib": 110.0, "warnings": 1, "warning_texts": "2 models were found", "attempts": 1,
        "work": str(tmp_path), "duplicate": False,
    }  # fmt: skip
    assert {key: row[key] for key in wanted} == wanted
    assert all(row[f"stage_{stage}"] == "ok" for stage in STAGES)


@pytest.mark.parametrize(("done", "following"), [(1, "sfm"), (2, "depth"), (3, "masks"), (4, "correspond")])
def test_a_sequence_waits_for_its_next_stage(done: int, following: str, tmp_path: Path) -> None:
    write_files(tmp_path / "cup", done)
    row = only_row(tmp_path)
    assert (row["status"], row["stage"], row["next"]) == ("waiting", STAGES[done - 1], following)


def test_masks_that_came_with_the_input_are_not_waited_for(tmp_path: Path) -> None:
    write_files(tmp_path / "cup", 3, masks_from="input")
    assert only_row(tmp_path)["next"] == "correspond"


def test_a_failure_has_its_stage_and_reason(tmp_path: Path) -> None:
    write_files(tmp_path / "cup", 1, failed="only 3 of 50 frames register")
    row = only_row(tmp_path)
    assert (row["status"], row["stage"], row["reason"]) == ("failed", "sfm", "only 3 of 50 frames register")
    assert row["stage_sfm"] == "failed" and row["stage_depth"] is None


def test_an_input_that_could_not_be_read_at_all_is_a_row(tmp_path: Path) -> None:
    write_marker(tmp_path / "broken", "frames", "failed", "is not a video")
    row = only_row(tmp_path)
    assert (row["status"], row["reason"]) == ("failed", "is not a video")


def test_an_empty_stage_makes_the_sequence_empty(tmp_path: Path) -> None:
    write_marker(write_files(tmp_path / "cup", 4), "correspond", "empty", "no two views overlap")
    assert only_row(tmp_path)["status"] == "empty"


@pytest.mark.parametrize("name", ["sequence.json", "stages/sfm.json"])
@pytest.mark.parametrize(
    "content",
    [b"", b'{"id": "cu', b"[]", b"null", b"\xff\xfe", b"[" * 100_000, b"7"],
)
def test_a_damaged_file_is_the_reason_of_a_failed_row(name: str, content: bytes, tmp_path: Path) -> None:
    (write_files(tmp_path / "cup") / name).write_bytes(content)
    row = only_row(tmp_path)
    assert row["status"] == "failed" and row["reason"].startswith(f"{name} is ")


def test_a_folder_or_a_pipe_in_place_of_a_file_is_a_reason(tmp_path: Path) -> None:
    (write_files(tmp_path / "pipe") / "sequence.json").unlink()
    os.mkfifo(tmp_path / "pipe/sequence.json")
    (write_files(tmp_path / "folder") / "stages/sfm.json").unlink()
    (tmp_path / "folder/stages/sfm.json").mkdir()
    rows = rows_of(tmp_path)
    assert rows["pipe"]["reason"] == "sequence.json is empty"
    assert "cannot be read" in rows["folder"]["reason"]


def test_values_of_the_wrong_kind_are_unknown(tmp_path: Path) -> None:
    folder = write_files(tmp_path / "cup", category=["a"], source=7, n_registered="many")
    odd = {"n_points": 10**400, "mean_error_px": "low", "registered_share": True, "warnings": [3, None, "\ud800 odd"]}
    write_marker(folder, "sfm", **odd)
    (folder / "stages/depth.json").write_text('{"status": "ok", "details": [1], "seconds": NaN, "peak_memory_mib": {}}')
    row = only_row(tmp_path)
    assert row["status"] == "ok" and row["warning_texts"] == "? odd"
    assert row["points"] is row["error_px"] is row["category"] is row["source"] is None
    assert row["seconds"] == 8.0


def test_a_marker_without_a_status_is_damaged(tmp_path: Path) -> None:
    (write_files(tmp_path / "cup") / "stages/masks.json").write_text('{"stage": "masks", "status": ["ok"]}')
    row = only_row(tmp_path)
    assert (row["status"], row["stage_masks"]) == ("failed", "damaged")


def test_names_that_are_no_unicode_are_written_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "cup\udcff/stages").mkdir(parents=True)  # how Python spells the byte 0xff
    assert list(rows_of(tmp_path)) == ["cup?"]


def test_a_held_sequence_is_running_and_is_not_disturbed(tmp_path: Path) -> None:
    folder = write_files(tmp_path / "cup", 1)
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not held_files():
            pytest.skip("this system has no /proc/locks")
        assert only_row(tmp_path)["status"] == "running"
    assert only_row(tmp_path)["status"] == "waiting"


@pytest.mark.parametrize(
    ("device", "running"),
    [("{major:02x}:{minor:02x}", True), ("{major:02x}:{other:02x}", False), ("00:{other:02x}", True)],
    ids=["the same", "another disk", "an anonymous one"],
)
@pytest.mark.parametrize("waiting", ["", "-> "])
def test_a_lock_on_another_disk_is_not_taken_for_the_sequences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str, running: bool, waiting: str
) -> None:
    """Inodes count from 1 on each disk: another disk's lock may well have the same."""
    lock = write_files(tmp_path / "cup", 1) / ".lock"
    lock.touch()
    real, inode = os.stat, lock.stat().st_ino
    disk = os.makedev(8, 1)

    def stat(path: Any, **options: Any) -> Any:
        return SimpleNamespace(st_ino=inode, st_dev=disk) if str(path).endswith(".lock") else real(path, **options)

    monkeypatch.setattr(os, "stat", stat)
    place = device.format(major=8, minor=1, other=2)
    lines = (f"1: POSIX  ADVISORY  WRITE 99 08:01:{inode}", f"2: {waiting}FLOCK  ADVISORY  WRITE 99 {place}:{inode}")
    (tmp_path / "locks").write_text("".join(f"{line} 0 EOF\n" for line in lines))
    held = held_files(str(tmp_path / "locks"))
    monkeypatch.setattr(status_table, "held_files", lambda: held)
    assert (only_row(tmp_path)["status"] == "running") is running


def test_other_folders_and_files_are_no_sequences(tmp_path: Path) -> None:
    write_files(tmp_path / "cup")
    (tmp_path / "notes").mkdir()
    (tmp_path / ".cup.1.partial").mkdir()
    (tmp_path / "report.html").write_text("")
    assert list(rows_of(tmp_path)) == ["cup"]


def spread_from_four(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processes read, two items at a time, where there are four or more."""
    monkeypatch.setattr(engines, "BATCH", 2)
    monkeypatch.setattr(engines, "SPREAD_FROM", 4)
    monkeypatch.setattr(engines, "default_workers", lambda: 2)


def test_several_processes_read_the_same_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i in range(7):
        write_files(tmp_path / f"cup_{i}", i % 5 + 1)
    alone = read_status([tmp_path])
    spread_from_four(monkeypatch)
    assert read_status([tmp_path]).equals(alone)


def test_several_processes_read_the_same_catalogue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of sequences that cannot be packed, each with its reason."""
    for i in range(7):
        write_files(tmp_path / f"cup_{i}", i % 4 + 1)
    sequences = [Sequence(path) for path in sorted(tmp_path.iterdir())]
    alone = read_catalogue(sequences)
    spread_from_four(monkeypatch)
    assert len(alone[2]) == 7 and read_catalogue(sequences)[1:] == alone[1:]


def test_status_of_other_machines_is_merged_and_duplicates_are_marked(tmp_path: Path) -> None:
    for work, names in (("a", "xy"), ("b", "yz")):
        for name in names:
            write_files(tmp_path / work / name)
    write_parquet(read_status([tmp_path / "b"]), tmp_path / "b.parquet")
    rows = read_status([tmp_path / "a", tmp_path / "b.parquet"]).to_pylist()
    assert [(row["id"], row["duplicate"]) for row in rows] == [("x", False), ("y", True), ("y", True), ("z", False)]


def test_a_table_of_an_older_version_is_filled_up(tmp_path: Path) -> None:
    table = pa.table({"id": ["a"], "status": ["ok"], "pairs": pa.array([3], pa.int32()), "gone": [1]})
    pq.write_table(table, tmp_path / "old.parquet")
    (row,) = read_status([tmp_path / "old.parquet"]).to_pylist()
    assert row["pairs"] == 3 and row["kept"] is None and set(row) == set(NAMES)


def test_what_is_no_status_table_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "text.parquet").write_text("hello")
    pq.write_table(pa.table({"a": [1]}), tmp_path / "other.parquet")
    pq.write_table(pa.table({"id": ["a"], "status": ["ok"], "pairs": ["many"]}), tmp_path / "odd.parquet")
    cases = {
        "absent": "no such folder",
        "text.parquet": "Parquet",
        "other.parquet": "no columns",
        "odd.parquet": "not a",
    }
    for name, message in cases.items():
        with pytest.raises(BadInput, match=message) as error:
            read_status([tmp_path / name])
        assert name in str(error.value)


def test_conditions_compare_numbers_as_numbers_and_texts_as_texts() -> None:
    rows = [
        {"id": "a", "category": "cup", "registered_share": 0.9, "pairs": 10, "reason": "Only 3 frames"},
        {"id": "b", "category": "bowl", "registered_share": 1.0, "pairs": 9, "duplicate": True},
        {"id": "c", "category": None, "registered_share": None, "pairs": None},
    ]
    table = pa.Table.from_pylist(rows, schema=SCHEMA)
    expected = {
        "category=cup": "a", "category != cup": "bc", "category=": "c", "category!=": "ab", "registered_share<1": "a",
        "registered_share >= 0.9": "ab", "pairs>9": "a", "pairs!=10": "bc", "reason~FRAMES": "a",
        "reason!~frames": "bc", "duplicate=true": "b", "id=a": "a",
        "category==cup": "a", "pairs == 9": "b",
    }  # fmt: skip
    for text, ids in expected.items():
        assert "".join(select(table, [parse_condition(text)])["id"].to_pylist()) == ids, text
    assert sort_rows(table, ["-pairs"])["id"].to_pylist() == ["a", "b", "c"]
    assert sort_rows(table, ["pairs"])["id"].to_pylist() == ["b", "a", "c"]


@pytest.mark.parametrize(
    "text", ["pairs", "pears>3", "pairs>many", "pairs~1", "pairs<", "duplicate=maybe", "", "=3", "pairs>nan"]
)
def test_conditions_that_mean_nothing_are_refused(text: str) -> None:
    with pytest.raises(UsageError):
        parse_condition(text)


def test_the_table_keeps_long_reasons_on_one_whole_line(tmp_path: Path) -> None:
    reason = "no such thing: " + "a long path/" * 60
    write_files(tmp_path / "cup\x1b[31m", 1, failed=reason)
    write_files(tmp_path / "漢字")
    lines = list(lines_of(read_status([tmp_path])))
    assert len(lines) == 3 and reason in lines[1]
    assert "\x1b" not in lines[1] and "\\x1b[31m" in lines[1]


def test_the_summary_counts_reasons_that_differ_in_numbers_only(tmp_path: Path) -> None:
    for i in range(4):
        write_files(tmp_path / f"cup_{i}", 1, failed=f"{tmp_path}/cup_{i}: only {i} of 50 frames register. Take more")
    write_files(tmp_path / "good")
    lines = summary(read_status([tmp_path]))
    assert lines == ["5 sequences: 1 ok, 4 failed", "  4 x sfm: only N of N frames register"]
    assert kind_of_reason("bowl: gone", "bowl") == "gone"


def test_the_command_filters_sorts_and_exits_with_zero(tmp_path: Path) -> None:
    write_files(tmp_path / "a", 1, failed="too dark")
    write_files(tmp_path / "b", category="bowl")
    answer = status(tmp_path, "--json", "--sort", "-id", "--columns", "id,status")
    lines = [json.loads(line) for line in answer.stdout.splitlines()]
    assert answer.exit_code == 0 and lines == [{"id": "b", "status": "ok"}, {"id": "a", "status": "failed"}]
    assert "too dark" in status(tmp_path, "--status", "failed", "--stage", "sfm").stdout
    assert "too dark" not in status(tmp_path, "--category", "bowl").stdout
    assert status(tmp_path, "--check").exit_code == 1
    assert status(tmp_path, "--check", "--sequence", "b").exit_code == 0


def test_the_command_writes_files(tmp_path: Path) -> None:
    write_files(tmp_path / "work/a")
    answer = status(tmp_path / "work", "--parquet", tmp_path / "a.parquet", "--csv", tmp_path / "a.csv")
    assert answer.stdout == "1 sequence: 1 ok\n"
    assert pq.read_table(tmp_path / "a.parquet")["registered"].to_pylist() == [48]
    assert (tmp_path / "a.csv").read_text().splitlines()[1].startswith('"a","ok"')


def test_no_text_in_a_csv_file_is_a_formula(tmp_path: Path) -> None:
    rows = [{"id": "a", "category": "=cmd|' /C calc'!A0", "error_px": -1.5}, {"id": "-2+3", "category": "@x=y"}]
    write_csv(pa.Table.from_pylist(rows, schema=SCHEMA).select(["id", "category", "error_px"]), tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text().splitlines()[1:] == [
        '"a","\'=cmd|\' /C calc\'!A0",-1.5',
        '"\'-2+3","\'@x=y",',
    ]


@pytest.mark.parametrize("option", ["--csv", "--parquet"])
def test_a_folder_in_place_of_the_file_to_write_is_wrong_usage(option: str, tmp_path: Path) -> None:
    write_files(tmp_path / "work/a")
    with pytest.raises(UsageError, match="is a folder"):
        status(tmp_path / "work", option, tmp_path)


@pytest.mark.parametrize("words", [("--status", "bad"), ("--stage", "mvs"), ("--sort", "size"), ("--columns", "id,x")])
def test_words_that_do_not_exist_are_wrong_usage(words: tuple[str, ...], tmp_path: Path) -> None:
    write_files(tmp_path / "a")
    with pytest.raises(UsageError):
        status(tmp_path, *words)
