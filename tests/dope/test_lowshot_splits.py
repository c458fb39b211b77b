from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dope.common.errors import BadInput, UsageError
from dope.lowshot.splits import TABLES, match_categories, paper_table, read_split_file, table_names


def write(path: Path, value: Any) -> Path:
    path.write_text(json.dumps(value))
    return path


@pytest.mark.parametrize(
    ("name", "base", "sizes"),
    [
        ("modelnet40_ls", 20, [(10, 10), (10, 10), (8, 12), (9, 11), (9, 11)]),
        ("shapenet55_ls", 25, [(10, 20)] * 5),
        ("co3d_ls", 31, [(10, 10)] * 5),
    ],
)
def test_the_papers_tables(name: str, base: int, sizes: list[tuple[int, int]]) -> None:
    table = paper_table(name)
    assert (table.name, len(table.base)) == (name, base)
    assert [(len(split.val), len(split.test)) for split in table.splits] == sizes
    for split in table.splits:
        assert not set(split.test) & set(table.base) and not set(split.val) & set(table.base)
        assert set(split.val) | set(split.test) == set(table.splits[0].val) | set(table.splits[0].test)


def test_letters_count_by_position_where_the_printed_indices_are_wrong() -> None:
    splits = paper_table("modelnet40_ls").splits
    assert ["flower_pot" in split.val for split in splits] == [True, False, True, False, False]
    assert ["stairs" in split.val for split in splits] == [False, True, True, False, True]


def test_an_unknown_table_names_the_closest_one() -> None:
    assert table_names() == ["co3d_ls", "modelnet40_ls", "shapenet55_ls"]
    with pytest.raises(UsageError, match=r"--table: no table 'modelnet40' \(did you mean 'modelnet40_ls'"):
        paper_table("modelnet40")


def test_a_file_of_ones_own_and_one_of_the_papers_format(tmp_path: Path) -> None:
    own = {"base": ["a"], "splits": [{"val": ["b"], "test": ["c", "d"]}, {"val": [], "test": ["b"]}]}
    table = read_split_file(write(tmp_path / "mine.json", own))
    assert (table.name, table.base, table.splits[0].test, table.splits[1].val) == ("mine", ("a",), ("c", "d"), ())
    letters = {"b": {"assignment": ["v", "t"]}, "c": {"assignment": ["t", "v"]}, "d": {"assignment": ["t", "t"]}}
    paper = {"train": {"a": 3}, "val_test": letters}
    table = read_split_file(write(tmp_path / "paper.json", paper))
    assert [(split.val, split.test) for split in table.splits] == [(("b",), ("c", "d")), (("c",), ("b", "d"))]


def test_other_splits_under_the_name_of_a_table_of_the_paper_are_refused(tmp_path: Path) -> None:
    file = write(tmp_path / "co3d_ls.json", GOOD)
    with pytest.raises(BadInput, match=r"name of the paper's table 'co3d_ls', and other splits"):
        read_split_file(file)
    file.write_bytes((TABLES / "co3d_ls.json").read_bytes())
    assert read_split_file(file) == paper_table("co3d_ls")


GOOD: dict[str, Any] = {"base": ["a"], "splits": [{"val": ["b"], "test": ["c"]}]}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([], "no table of splits"),
        ({"splits": "x", "base": []}, "'splits' is not a list"),
        ({"splits": GOOD["splits"]}, "base is not a list of classes"),
        ({**GOOD, "bases": []}, "unknown key 'bases'"),
        ({**GOOD, "splits": []}, "has no split"),
        ({**GOOD, "splits": [{"val": ["b"], "test": []}]}, "split 0 has no test classes"),
        ({**GOOD, "splits": [{"val": ["b"]}]}, "split 0 has not just 'val' and 'test'"),
        ({**GOOD, "splits": [{"val": ["b"], "test": [3]}]}, "test of split 0 is not a list of classes"),
        ({**GOOD, "splits": [{"val": ["b"], "test": ["c", ""]}]}, "test of split 0 is not a list of classes"),
        ({**GOOD, "base": ["a", "a"]}, "'a' is twice in base"),
        ({**GOOD, "splits": [{"val": ["b"], "test": ["cup_x", "Cup X"]}]}, "'Cup X' is twice in test of split 0"),
        ({**GOOD, "splits": [*GOOD["splits"], {"val": ["c"], "test": ["c"]}]}, "'c' is in val and in test of split 1"),
        ({**GOOD, "splits": [{"val": ["A"], "test": ["c"]}]}, r"'A' is trained on \(base\) and in val of split 0"),
        ({**GOOD, "splits": [{"val": ["b"], "test": ["a"]}]}, r"'a' is trained on \(base\) and in test of split 0"),
        ({"train": {"a": 1}, "val_test": {"b": {"assignment": ["x"]}}}, "class 'b' has no assignment"),
        ({"train": {"a": 1}, "val_test": {"b": {}}}, "class 'b' has no assignment"),
        ({"train": ["a"], "val_test": {}}, "not a mapping of classes"),
        (
            {"train": {}, "val_test": {"b": {"assignment": ["t", "t"]}, "c": {"assignment": ["t"]}}},
            "'c' is assigned in 1 splits, others in 2",
        ),
    ],
)
def test_bad_tables_name_the_file_and_the_class(tmp_path: Path, value: Any, message: str) -> None:
    path = write(tmp_path / "bad.json", value)
    with pytest.raises(BadInput, match=message) as error:
        read_split_file(path)
    assert str(path) in str(error.value)


def test_absent_damaged_and_doubled_files(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no such file"):
        read_split_file(tmp_path / "absent.json")
    (tmp_path / "cut.json").write_text('{"base": ["a"')
    with pytest.raises(BadInput, match=r"cut\.json: is not valid JSON"):
        read_split_file(tmp_path / "cut.json")
    (tmp_path / "twice.json").write_text(
        '{"train": {}, "val_test": {"b": {"assignment": ["t"]}, "b": {"assignment": ["v"]}}}'
    )
    with pytest.raises(BadInput, match="'b' is there twice"):
        read_split_file(tmp_path / "twice.json")


def test_names_match_without_case_and_separators() -> None:
    there = ["Night-Stand", "range hood", "cup"]
    found, missing = match_categories(["night_stand", "rangehood"], there, where="x")
    assert (found, missing) == (("Night-Stand", "range hood"), ())


def test_missing_classes_are_listed_beside_what_is_there() -> None:
    with pytest.raises(UsageError, match=r"lack 2 of its 3 classes: sofa, tent\. There are: bowl, cup\..*--fit"):
        match_categories(["cup", "sofa", "tent"], ["cup", "bowl"], where="x")
    assert match_categories(["cup", "sofa"], ["cup", "bowl"], where="x", fit=True) == (("cup",), ("sofa",))
    with pytest.raises(UsageError, match="lack 1 of its 1 classes"):
        match_categories(["sofa"], ["cup"], where="x", fit=True)
    with pytest.raises(UsageError, match="'Cup' and 'cup' of the shards are one class"):
        match_categories(["cup"], ["cup", "Cup"], where="x")
