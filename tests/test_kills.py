"""Killed without warning in the midst of each kind of work, `dope prep run` ends with the same shards, byte by byte."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.kills import Run, film


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("films")
    film(out, 2)
    return out


def test_shards_of_a_run_that_was_killed_again_and_again(films: Path, tmp_path: Path) -> None:
    undisturbed, run = Run(films, tmp_path / "undisturbed"), Run(films, tmp_path / "killed")
    undisturbed.finish()
    signs = {  # of the moment that the work in question has begun
        "sfm": ("work", "*/stages/frames.json"),
        "depth": ("work", "*/stages/sfm.json"),
        "correspond": ("work", "*/.views.*.partial"),
        "shards": (".", ".shards.*.partial/*.tar"),
    }
    for stage, (folder, sign) in signs.items():
        assert run.kill_when(lambda: any((run.home / folder).glob(sign))), f"it ended before {stage}"  # noqa: B023
        assert stage in run.places().values() or "done" in run.places().values()
        assert not (run.shards / "dataset.json").exists()
    run.finish()
    assert run.bytes() == undisturbed.bytes() and len(run.bytes()) >= 5
    left = [path for path in run.home.rglob("*partial*") if "stages" not in path.parts]
    assert not left, "what killed runs left half-written is cleared"
