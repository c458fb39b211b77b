from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from tiny_results import row, write_run

from dope.common.errors import BadInput, DopeError, UsageError
from dope.results.one_protocol import check_no_duplicates, check_one_protocol, keep_only
from dope.results.sources import FoundRow, find_rows


def test_a_run_an_evaluation_folder_and_a_file_bring_the_same_rows(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", row(0.5), row(0.6, shots=5))
    for path in (run, run / "eval", run / "eval" / "results.parquet"):
        found = find_rows([path])
        assert [item.row.accuracy for item in found] == [0.5, 0.6]
        assert {item.run for item in found} == {run}


def test_json_is_read_where_there_is_no_parquet_and_both_are_read_once(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", row(), name="results.json")
    assert len(find_rows([run])) == 1
    write_run(run, row())
    assert [item.file.suffix for item in find_rows([run])] == [".parquet"]


@pytest.mark.parametrize("twice", ["run", "run/eval", "run/eval/results.parquet", "link"])
def test_a_file_named_twice_is_refused(tmp_path: Path, twice: str) -> None:
    run = write_run(tmp_path / "run", row())
    (tmp_path / "link").symlink_to(run)
    with pytest.raises(UsageError, match="the same file"):
        find_rows([run, tmp_path / twice])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: None, "no such run or file"),
        (os.mkfifo, "neither a folder nor a file"),
        (lambda folder: folder.mkdir(), r"holds neither eval/results.parquet nor results.parquet"),
        (lambda folder: (folder / "checkpoints").mkdir(parents=True), "has not been evaluated.*dope eval"),
        (lambda folder: write_run(folder / "inner", row()), r"1 of its folders do \(inner\)\. Name .*/\*"),
        (lambda folder: write_run(folder), "holds no rows"),
        (lambda folder: write_run(folder).joinpath("eval/results.parquet").write_bytes(b"PAR1"), "cannot be read"),
    ],
)
def test_what_holds_no_results_is_explained(tmp_path: Path, make: object, message: str) -> None:
    make(tmp_path / "run")  # type: ignore[operator]
    with pytest.raises(BadInput, match=message) as error:
        find_rows([tmp_path / "run"])
    assert str(tmp_path / "run") in str(error.value)


@pytest.mark.parametrize(
    ("column", "value"),
    [("accuracy", float("nan")), ("accuracy", 57.5), ("ci95", None), ("ways", 0), ("shots", "1"), ("method", None),
     ("step", "last"), ("table_split", None)],
)  # fmt: skip
def test_a_row_edited_by_hand_is_not_believed(tmp_path: Path, column: str, value: object) -> None:
    file = write_run(tmp_path / "run", row(), name="results.json") / "eval" / "results.json"
    rows = json.loads(file.read_text())
    rows[0][column] = value
    file.write_text(json.dumps(rows))
    with pytest.raises(BadInput, match=f"row 0 is damaged: {column} is"):
        find_rows([file])


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("episodes", (2500, 100)), ("queries", (15, 14)), ("seed", (0, 1)), ("classes", ("category", "instance")),
        ("shot_mode", ("several_instances", "one_instance")), ("dataset", ("aaaa", "bbbb")),
        ("part", ("val", "test")), ("split", ("all", "val")), ("table", ("modelnet40_ls", "co3d_ls")),
        ("evaluation_hash", ("e1", "e2")), ("n_objects", (100, 101)),
    ],
)  # fmt: skip
def test_rows_of_two_protocols_are_refused_and_told_apart(
    tmp_path: Path, column: str, values: tuple[object, object]
) -> None:
    runs = [write_run(tmp_path / name, row(**{column: value})) for name, value in zip("ab", values, strict=True)]
    with pytest.raises(UsageError) as error:
        check_one_protocol(find_rows(runs))
    text = str(error.value)
    for said in (column, *map(str, values), str(runs[0] / "eval"), str(runs[1] / "eval"), "by a command of its own"):
        assert said in text
    assert ("--part test" if column == "part" else f"--only {column}={values[0]}") in text


def test_methods_may_have_classifiers_and_checkpoints_of_their_own(tmp_path: Path) -> None:
    rows = [
        row(method="dope"),
        row(method="feat", classifier="attention", shots=5, step=7, checkpoint_sha256="b", config_hash="d"),
        row(method="rfs", classifier="logistic", shots=5, queries=10, asked_queries=15),  # fewer by --fit
        row(method="vispe", classifier="centroid"),
        row(method="rfs", classifier="logistic", support_copies=5, chosen_by="validation"),
    ]
    check_one_protocol([FoundRow(r, tmp_path) for r in (rows[0], rows[1], *rows[3:])])
    check_one_protocol([FoundRow(r, tmp_path) for r in (rows[0], rows[2])])
    with pytest.raises(UsageError, match="queries: 15 and 10"):
        check_one_protocol([FoundRow(r, tmp_path) for r in rows])
    splits = [row(table="mine", table_split=i, queries=15 - i, asked_queries=15) for i in range(3)]
    check_one_protocol([FoundRow(r, tmp_path) for r in splits])
    with pytest.raises(UsageError, match="queries: 15 and 10"):
        check_one_protocol([FoundRow(r, tmp_path) for r in (row(), row(shots=5, queries=10))])


def test_splits_have_objects_of_their_own(tmp_path: Path) -> None:
    table = {"table": "co3d_ls", "part": "test"}
    rows = [row(table_split=i, n_objects=100 + i, **table) for i in range(5)]
    check_one_protocol([FoundRow(r, tmp_path) for r in rows])
    other = row(table_split=3, n_objects=104, method="rfs", **table)
    with pytest.raises(UsageError, match="n_objects: 103 and 104"):
        check_one_protocol([FoundRow(r, tmp_path) for r in (*rows, other)])


def test_a_measurement_in_two_files_is_a_duplicate(tmp_path: Path) -> None:
    run = write_run(tmp_path / "a", row(0.5), row(0.6, shots=5))
    shutil.copytree(run, tmp_path / "b")
    with pytest.raises(UsageError, match=r"dope \(run\), 5-way 1-shot, is there twice: .*a/eval.* and .*b/eval"):
        check_no_duplicates(find_rows([run, tmp_path / "b"]))
    check_no_duplicates(find_rows([run]))


def test_rows_are_chosen_by_their_columns(tmp_path: Path) -> None:
    rows = [row(part="test"), row(part="val"), row(part="val", episodes=100), row(part="val", step=None)]
    found = [FoundRow(r, tmp_path) for r in rows]
    assert [f.row for f in keep_only(found, {"part": "val", "episodes": "2500"})] == [rows[1], rows[3]]
    assert [f.row for f in keep_only(found, {"step": ""})] == [rows[3]]
    with pytest.raises(UsageError, match=r"no rows have part 'tset' \(there are: 'test', 'val'\)"):
        keep_only(found, {"part": "tset"})
    with pytest.raises(DopeError, match="no column 'epsiodes'"):
        keep_only(found, {"epsiodes": "100"})
