"""`dope prep render`: what its options come to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

import cli
from pipeline.render import prepare


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """(sources, work, config, ...) of each call of `prepare_renders`, which does nothing."""
    calls: list[Any] = []

    def record(*arguments: Any) -> list[Any]:
        calls.append(arguments)
        return []

    monkeypatch.setattr(prepare, "prepare_renders", record)
    return calls


def render(*words: object) -> Result:
    return CliRunner().invoke(cli.app, ["prep", "render", *map(str, words)])


def test_recipe_and_renderer_may_come_from_a_file_and_flags_go_before_it(tmp_path: Path, called: list[Any]) -> None:
    mesh, settings = tmp_path / "a.obj", tmp_path / "settings.yaml"
    mesh.touch()
    settings.write_text("recipe: abc\nrenderer: cycles\n")
    given: list[object] = [mesh, "--out", tmp_path / "work"]
    for more in ([], ["--config", settings], ["--config", settings, "--recipe", "plain"]):
        assert render(*given, *more).exit_code == 0
    chosen = [(config.recipe, config.renderer) for _, _, config, *_ in called]
    assert chosen == [("plain", "fast"), ("abc", "cycles"), ("plain", "cycles")]


@pytest.mark.parametrize("option", [("--category", "gear"), ("--limit", "2"), ("--category-from", "parent")])
def test_options_of_meshes_are_refused_where_there_are_none(tmp_path: Path, called: list[Any], option: Any) -> None:
    result = render("--recipe", "procedural", "--count", 3, "--out", tmp_path, *option)
    assert option[0] in str(result.exception) and not called


@pytest.mark.parametrize("limit", ["--minutes", "--memory-gib"])
@pytest.mark.parametrize("value", ["inf", "nan", "0"])
def test_limits_are_numbers(tmp_path: Path, called: list[Any], limit: str, value: str) -> None:
    result = render("--recipe", "procedural", "--count", 1, "--out", tmp_path, limit, value)
    assert limit in str(result.exception) and not called
