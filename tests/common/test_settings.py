"""Settings are strict: what is misspelt or of the wrong type is an error that helps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import pytest

from dope.common.errors import UsageError
from dope.common.settings import config_hash, from_mapping, load_yaml, override


@dataclass(frozen=True)
class Inner:
    learning_rate: float = 0.1
    sizes: tuple[int, ...] = (1, 2)
    mode: Literal["a", "b"] = "a"


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    count: int | None = None
    name: str = "x"


def test_values_reach_their_fields_and_the_rest_keeps_its_default() -> None:
    config = from_mapping(Outer, {"inner": {"learning_rate": 1, "sizes": [4, 5, 6]}, "count": 3})
    assert config == Outer(Inner(1.0, (4, 5, 6), "a"), 3, "x")
    assert isinstance(config.inner.learning_rate, float)


def test_override_reads_yaml_values() -> None:
    config = override(Outer(), ["inner.learning_rate=1e-4", "inner.mode=b", "count=null", "inner.sizes=[7]"])
    assert config.inner == Inner(1e-4, (7,), "b")


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("inner.learning_rat=1", "did you mean 'learning_rate'"),
        ("iner.learning_rate=1", "did you mean 'inner'"),
        ("name.x=1", "no settings below"),
        ("inner.mode=c", "not one of a, b"),
        ("count=many", "not of type"),
        ("count=true", "not of type"),
        ("inner.sizes=[1, x]", "not of type"),
        ("count", "not key=value"),
        ("inner={learning_rat: 1}", "did you mean 'learning_rate'"),
        ("count={a: 1}", "not of type"),
        ("inner.learning_rate=1" + "0" * 400, "not of type float"),
        ("inner={mode: a, mode: b}", "'mode' is there twice"),
        ("name=true", "not of type str"),
        ("name=null", "not of type str"),
        ("name=2024-13-45", r"--set name: '2024-13-45' is not valid YAML \(month must be in 1\.\.12\)"),
        ("inner.sizes=[1", r"--set inner\.sizes: '\[1' is not valid YAML"),
    ],
)
def test_wrong_assignments_are_named(assignment: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        override(Outer(), [assignment])


def test_a_mapping_changes_only_what_it_names() -> None:
    config = override(Outer(Inner(0.5, (7,))), ["inner={mode: b}"])
    assert config.inner == Inner(0.5, (7,), "b")


@pytest.mark.parametrize("text", ["", "123", "2024-01-31", "1e5", "0x10"])
def test_where_a_text_is_wanted_what_was_typed_is_one(text: str) -> None:
    assert override(Outer(), [f"name={text}"]).name == text


def test_a_key_that_a_file_has_twice_is_an_error(tmp_path) -> None:
    path = tmp_path / "train.yaml"
    path.write_text("inner: {mode: b}\ncount: 1\ninner: {learning_rate: 1}\n")
    with pytest.raises(UsageError, match=r"train\.yaml: is not valid YAML \('inner' is there twice .*line 3"):
        load_yaml(path)
    path.write_text("a: &base {x: 1, y: 2}\nb: {<<: *base, x: 3}\n")
    assert load_yaml(path)["b"] == {"x": 3, "y": 2}


def test_unknown_key_in_a_file_names_the_file_and_the_closest_key(tmp_path) -> None:
    path = tmp_path / "train.yaml"
    path.write_text("inner:\n  learning_rates: 0.2\n")
    with pytest.raises(UsageError, match=r"train\.yaml: inner: unknown key 'learning_rates' \(did you mean"):
        from_mapping(Outer, load_yaml(path), where=str(path))


@pytest.mark.parametrize("text", ["- a\n- b\n", "a: [1", "\x00"])
def test_files_that_are_not_mappings_are_refused(tmp_path, text: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=r"bad\.yaml"):
        load_yaml(path)


def test_hash_changes_with_any_setting_and_only_then() -> None:
    assert config_hash(Outer()) == config_hash(Outer())
    assert config_hash(Outer()) != config_hash(override(Outer(), ["inner.mode=b"]))


@pytest.mark.parametrize(
    "assignment",
    ["depth.long_side=0", "views.every=0", "views.size=1", "pairs.max_pairs=0", "match.max_points=0"],
)
def test_settings_that_mean_nothing_are_refused_by_name(assignment):
    from pipeline.run import RunConfig

    name = assignment.split("=")[0].split(".")[1]
    with pytest.raises(UsageError, match=rf"{name} must be at least \d+, not \d"):
        override(RunConfig(), [assignment])
