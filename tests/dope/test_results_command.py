from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tiny_results import row, write_run
from typer.testing import CliRunner

from cli import app
from dope.common.errors import DopeError, UsageError
from dope.results.curves import curves_of, plot_curves
from dope.results.sources import FoundRow

REPOSITORY = Path(__file__).parents[2]


def run_command(*arguments: object) -> str:
    result = CliRunner().invoke(app, ["results", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def training(run: str, gain: float, steps: tuple[int, ...] = (0, 100, 200), **columns: object) -> list[FoundRow]:
    rows = [
        row(0.3 + gain * i, run=run, step=s, checkpoint_sha256=run + str(s), **columns) for i, s in enumerate(steps)
    ]
    return [FoundRow(r, Path(run) / "eval" / "results.parquet") for r in rows]


def test_the_format_is_told_by_the_option_or_by_the_suffix(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", row(0.5))
    assert "50.00 ± 1.00" in run_command(run)
    assert "| DOPE | 50.00 ± 1.00 |" in run_command(run, "--format", "markdown")
    for name, begins in (("t.md", "**Low-shot"), ("t.tex", r"\begin{table}"), ("t.txt", "Low-shot")):
        said = run_command(run, "--out", tmp_path / "new" / name)
        assert name in said and "50.00" not in said
        assert (tmp_path / "new" / name).read_text().startswith(begins)
    run_command(run, "--out", tmp_path / "t.md", "--format", "latex")
    assert (tmp_path / "t.md").read_text().startswith(r"\begin{table}")


def test_labels_parts_and_columns_are_chosen(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", row(0.5, run="a", part="test"), row(0.4, run="a", part="val"))
    b = write_run(tmp_path / "b", row(0.6, run="b", part="test"), row(0.9, run="b", part="test", episodes=7))
    with pytest.raises(UsageError, match="--part test"):
        run_command(a)
    said = run_command(a, b, "--part", "test", "--only", "episodes=2500", "--label", "a=x=1", "--label", f"{b}=ours")
    assert "x=1" in said and "ours" in said and "40.00" not in said and "90.00" not in said


def test_names_may_contain_an_equals_sign(tmp_path: Path) -> None:
    rows = [row(method=f"hf:x?pool={pool}", run="", step=None, checkpoint_sha256=pool) for pool in ("cls", "mean")]
    said = run_command(write_run(tmp_path / "a", *rows), "--label", "hf:x?pool=cls=CLS=1")
    assert "\nCLS=1 " in said and "hf:x?pool=mean" in said and "pool=cls" not in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--format", "html"), "--format: 'html' is not one of text, markdown, latex"),
        (("--paper", "some"), "--paper: 'some' is not one of"),
        (("--label", "=x"), "'=x' is not RUN=TEXT"),
        (("--label", "nope=x"), "--label nope=...: no run 'nope'"),
        (("--label", "run"), "--label: 'run' is not RUN=TEXT"),
        (("--label", "run= "), "--label: 'run= ' is not RUN=TEXT"),
        (("--label", "run=a", "--label", "run=b"), "'run' is given twice"),
        (("--only", "seed=0", "--only", "seed=1"), "--only: 'seed' is given twice"),
        (("--only", "episodes"), "--only: 'episodes' is not COLUMN=VALUE"),
        (("--plot", "curve.jpg"), r"--plot curve.jpg: plots are .png, .pdf, .svg"),
    ],
)
def test_wrong_options_are_explained(tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        run_command(write_run(tmp_path / "run", row()), *arguments)


def test_nothing_is_written_where_the_plot_fails(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", row(step=None, checkpoint=None))
    with pytest.raises(UsageError, match="no row is of a checkpoint"):
        run_command(run, "--plot", tmp_path / "p.png", "--out", tmp_path / "t.md")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_curve_is_a_run_with_a_point_a_checkpoint() -> None:
    found = [*training("b", 0.1, (200, 0, 100)), *training("a", 0.2), *training("a", 0.2, ways=10)]
    curves = curves_of(found, {"a": "ours"})
    assert list(curves) == [(5, 1), (10, 1)] and [curve.label for curve in curves[5, 1]] == ["DOPE", "ours"]
    assert [len(panel) for panel in curves.values()] == [2, 1]
    points = curves[5, 1][0].points
    assert [step for step, *_ in points] == [0, 100, 200]
    np.testing.assert_allclose([value for _, value, _, _ in points], [40, 50, 30])


def test_a_point_is_the_mean_over_the_splits_that_have_it() -> None:
    table = {"table": "modelnet40_ls", "part": "val"}
    found = [item for i in range(3) for item in training("a", 0.1 * i, table_split=i, ci95=0.01 * (i + 1), **table)]
    (curve,) = curves_of(found)[5, 1]
    np.testing.assert_allclose(np.array(curve.points), [[0, 30, 2, 3], [100, 40, 2, 3], [200, 50, 2, 3]])


def test_untrained_networks_and_encoders_are_levels() -> None:
    encoder = row(0.6, method="m:f", run="", step=None, network="encoder", checkpoint=None)
    found = [*training("a", 0.1), FoundRow(encoder, Path("e/results.parquet"))]
    curves = curves_of(found)[5, 1]
    assert [step for step, *_ in curves[1].points] == [None]


def test_checkpoints_chosen_for_each_split_are_a_level_and_no_curve() -> None:
    table = {"table": "mine", "part": "test"}
    rows = [row(0.6 + i / 10, step=100 * i, table_split=i, chosen_by="validation", **table) for i in range(2)]
    chosen = [FoundRow(r, Path("run/eval/results.parquet")) for r in rows]
    found = [item for i in range(2) for item in training("run", 0.1, table_split=i, **table)]
    curve, level = curves_of([*found, *chosen])[5, 1]
    assert len(curve.points) == 3 and "chosen" in level.label
    np.testing.assert_allclose(level.points[0][1:], [65, 1, 2])
    assert level.points[0][0] is None
    with pytest.raises(UsageError, match=r"were chosen for each split.*--part val has all"):
        curves_of(chosen)


def test_points_of_different_splits_are_no_curve() -> None:
    table = {"table": "mine", "part": "val"}
    found = [*training("a", 0.1, table_split=0, **table), *training("a", 0.1, (200,), table_split=1, **table)]
    with pytest.raises(UsageError, match="splits 0 at step 0 and 0, 1 at step 200, whose means are no curve"):
        curves_of(found)


def test_what_cannot_be_one_curve_is_refused() -> None:
    found = [*training("a", 0.1), *training("b", 0.1)]
    with pytest.raises(UsageError, match="'same' has two measurements of 5-way 1-shot at step 0"):
        curves_of(found, {"a": "same", "b": "same"})
    with pytest.raises(UsageError, match="two protocols"):
        curves_of([*training("a", 0.1), *training("b", 0.1, seed=1)])


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_a_picture_is_drawn(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("matplotlib", reason="the extra 'plot' is not installed")
    found = [*training("a", 0.2), *training("b", 0.1), *training("c", 0.1, (50,))]
    path = plot_curves(found, tmp_path / f"curve{suffix}")
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    data = path.read_bytes()
    assert data[:4] in (b"\x89PNG", b"<?xm", b"%PDF")
    if suffix == ".png":
        import cv2

        picture = cv2.imread(str(path))
        for colour in ((0xB2, 0x72, 0x00), (0x00, 0x5E, 0xD5), (0x73, 0x9E, 0x00)):  # BGR of the first three curves
            assert (np.abs(picture.astype(int) - colour).sum(-1) < 12).sum() > 50


def test_ticks_are_whole_steps(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the extra 'plot' is not installed")
    path = plot_curves(training("a", 0.1, (1, 2, 3)), tmp_path / "p.svg")
    # matplotlib names the texts that it draws as paths in comments
    drawn = re.findall(r"<!-- ([\d,]+) -->", path.read_text())
    assert [text for text in drawn if len(text) == 1] == ["1", "2", "3"]


def test_missing_matplotlib_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(DopeError, match=r"--plot: matplotlib is needed.*pip install 'dope-descriptors\[plot\]'"):
        plot_curves(training("a", 0.1), tmp_path / "p.png")
    assert not list(tmp_path.iterdir())


def test_errors_are_one_line_and_exit_with_their_code(tmp_path: Path) -> None:
    a, b = (write_run(tmp_path / name, row(seed=i)) for i, name in enumerate("ab"))
    for arguments, code in (((a, b), 2), ((tmp_path / "none",), 1)):
        command = [sys.executable, REPOSITORY / "cli.py", "results", *map(str, arguments)]
        ended = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, check=False)
        assert ended.returncode == code and ended.stdout == ""
        assert ended.stderr.startswith("error: ") and ended.stderr.count("\n") == 1
