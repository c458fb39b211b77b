from __future__ import annotations

from pathlib import Path

import pytest
from tiny_results import row, write_run

from dope.common.errors import UsageError
from dope.lowshot.results import ResultRow
from dope.results import paper
from dope.results.formats import as_latex, as_markdown, as_text
from dope.results.sources import FoundRow, find_rows
from dope.results.table import Cell, ResultsTable, build_table

MODELNET = {"table": "modelnet40_ls", "part": "test"}


def found(*rows: ResultRow, folder: str = "runs") -> list[FoundRow]:
    return [FoundRow(r, Path(folder) / (r.run or r.method) / "eval" / "results.parquet") for r in rows]


def table(*rows: ResultRow, beside: str = "none", **labels: str) -> ResultsTable:
    return build_table(found(*rows), labels=labels, beside=beside)  # type: ignore[arg-type]


def measured(of: ResultsTable) -> dict[str, tuple[Cell | None, ...]]:
    """label -> cells of what was measured, without chance."""
    return {line.label: line.cells for line in of.blocks[0].lines if line.label != "chance"}


def test_columns_are_the_papers_in_its_order_and_empty_cells_stay_empty() -> None:
    made = table(row(0.3, ways=10), row(0.7, shots=5), row(0.4, ways=10, shots=5), row(0.5, method="rfs", run="r"))
    assert made.columns == ("5w1s", "5w5s", "10w1s", "10w5s")
    dope, rfs = measured(made)["DOPE"], measured(made)["RFS"]
    assert [cell and round(cell.accuracy, 6) for cell in dope] == [None, 70, 30, 40]
    assert [cell and round(cell.accuracy, 6) for cell in rfs] == [50, None, None, None]


def test_a_cell_is_the_mean_of_accuracies_and_of_intervals_over_the_splits() -> None:
    values = [(0.50, 0.01), (0.60, 0.02), (0.55, 0.03), (0.45, 0.04), (0.40, 0.10)]
    rows = [row(a, c, table_split=i, step=i, checkpoint_sha256=str(i), **MODELNET) for i, (a, c) in enumerate(values)]
    (cell,) = measured(table(*rows))["DOPE"]
    assert cell is not None and not cell.missing
    assert (cell.accuracy, cell.ci95) == (pytest.approx(50), pytest.approx(4))
    (cell,) = measured(table(*rows[:3]))["DOPE"]
    assert cell is not None and cell.missing and cell.accuracy == pytest.approx(55)
    for write in (as_text, as_markdown, as_latex):
        lacking, whole = " ".join(write(table(*rows[:3])).split()), write(table(*rows))
        assert lacking.count("(3/5)") == 2 and "(3/5): 3 of 5 splits only." in lacking and "of 5 splits" not in whole


def test_splits_of_a_table_of_ones_own_are_counted() -> None:
    rows = [row(table="mine", table_split=i, part="test") for i in range(3)]
    assert not measured(table(*rows))["DOPE"][0].missing  # type: ignore[union-attr]
    lacking = measured(table(*rows, row(table="mine", part="test", table_split=0, method="rfs", run="r")))["RFS"][0]
    assert lacking is not None and lacking.missing


@pytest.mark.parametrize(
    ("intervals", "best"), [([(0.60, 0.01), (0.57, 0.01)], "a"), ([(0.60, 0.025), (0.57, 0.01)], None)]
)
def test_the_best_is_marked_only_where_no_interval_reaches_its_own(
    intervals: list[tuple[float, float]], best: str | None
) -> None:
    rows = [row(a, c, run=name) for name, (a, c) in zip("ab", intervals, strict=True)]
    made = table(*rows, row(0.2, 0.001, run="c"))
    marked = [label for label, (cell,) in measured(made).items() if cell and cell.best]
    assert marked == ([f"DOPE ({best})"] if best else [])
    text, markdown, latex = as_text(made), as_markdown(made), as_latex(made)
    for drawn, mark in ((text, "60.00*"), (markdown, "**60.00 ± 1.00**"), (latex, r"$\mathbf{60.00} \pm 1.00$")):
        assert (mark in drawn) == (best is not None)
    assert ("No best is marked" in markdown) == (best is None)


def test_a_line_alone_is_not_the_best_and_fewer_splits_do_not_compete() -> None:
    assert not measured(table(row(0.9)))["DOPE"][0].best  # type: ignore[union-attr]
    five = [row(a, run=name, table_split=i, **MODELNET) for name, a in (("a", 0.6), ("b", 0.5)) for i in range(5)]
    cells = measured(table(*five, row(0.9, run="lucky", table_split=0, **MODELNET)))
    assert [cells[f"DOPE ({name})"][0].best for name in ("a", "b", "lucky")] == [  # type: ignore[union-attr]
        True, False, False
    ]  # fmt: skip


def test_labels_are_no_longer_than_needed() -> None:
    def labels(*rows: ResultRow, **given: str) -> list[str]:
        return list(measured(table(*rows, **given)))

    rfs = row(method="rfs", run="rfs_run")
    assert labels(row(run="a"), rfs) == ["DOPE", "RFS"]
    assert labels(row(run="a"), row(run="b"), rfs) == ["DOPE (a)", "DOPE (b)", "RFS"]
    assert labels(row(run="a"), row(run="b"), b="no masks") == ["DOPE", "no masks"]
    assert labels(row(run="a"), row(run="a", classifier="centroid")) == [
        "DOPE (local matching)", "DOPE (nearest centroid)"
    ]  # fmt: skip
    untrained = row(run="a", network="untrained", step=None, checkpoint=None, checkpoint_sha256=None)
    assert labels(row(run="a"), untrained) == ["DOPE", "DOPE (untrained)"]
    assert labels(row(run="a"), untrained, a="X") == ["X", "X (untrained)"]
    later = row(run="a", step=2000, checkpoint_sha256="b")
    assert labels(row(run="a"), later) == ["DOPE (step 100)", "DOPE (step 2,000)"]
    assert labels(row(run="a"), row(run="a", config_hash="d" * 16)) == [
        "DOPE (settings cccccccc)", "DOPE (settings dddddddd)"
    ]  # fmt: skip
    assert labels(row(method="mine:encoder", run="", step=None)) == ["mine:encoder"]


def test_rows_with_and_without_copies_of_the_shots_are_lines_of_their_own() -> None:
    rfs = {"method": "rfs", "classifier": "logistic"}
    plain, copied = row(**rfs), row(0.6, shots=5, support_copies=5, **rfs)
    made = table(plain, copied, row(0.7, run="d"))
    assert list(measured(made)) == ["RFS (logistic)", "RFS (logistic, 5 copies a shot)", "DOPE"]
    said = as_text(table(copied))
    assert "Classifier: logistic, 5 copies a shot." in said


def test_checkpoints_of_a_run_are_one_line_only_where_each_split_has_its_own() -> None:
    def lines(*rows: ResultRow) -> list[str]:
        return list(measured(table(*rows)))

    later = {"step": 200, "checkpoint_sha256": "bb"}
    assert lines(row(), row(ways=10, **later)) == ["DOPE (step 100)", "DOPE (step 200)"]
    first, second = row(table_split=0, **MODELNET), row(table_split=1, **later, **MODELNET)
    assert lines(first, second) == ["DOPE"]
    other = row(table_split=1, ways=10, **MODELNET)
    assert lines(first, second, other) == ["DOPE (step 100)", "DOPE (step 200)"]


def test_chosen_checkpoints_are_told_from_the_same_ones_unchosen() -> None:
    def chosen(**columns: object) -> list[ResultRow]:
        steps = [100, 200, 200, 200, 300]
        return [row(table_split=i, step=s, checkpoint_sha256=str(s), chosen_by="validation", **MODELNET, **columns)
                for i, s in enumerate(steps)]  # fmt: skip

    newest = [row(table_split=i, step=300, checkpoint_sha256="300", **MODELNET) for i in range(5)]
    made = table(*newest, *chosen())
    assert list(measured(made)) == ["DOPE (step 300)", "DOPE (chosen on validation classes)"]
    assert all(cells[0] and not cells[0].missing for cells in measured(made).values())
    said = "Checkpoints that the validation classes of each split chose"
    assert f"{said} (of DOPE (chosen on validation classes) alone)." in made.caption
    assert f"{said}." in table(*chosen()).caption and f"{said}." in as_text(table(*chosen())).replace("\n", " ")
    assert not any(said in sentence for sentence in table(*newest).caption)
    one = [row(table_split=i, chosen_by="validation", **MODELNET) for i in range(5)]
    assert list(measured(table(*newest, *one))) == ["DOPE (step 300)", "DOPE (chosen on validation classes)"]


def test_runs_of_one_name_in_two_folders_are_told_apart_by_their_folders() -> None:
    rows = [row(run="run", config_hash="1", checkpoint_sha256="a"), row(run="run", config_hash="2")]
    made = build_table([*found(rows[0], folder="x"), *found(rows[1], folder="y")], beside="none")
    assert list(measured(made)) == ["DOPE (x/run)", "DOPE (y/run)"]
    labelled = build_table([*found(rows[0], folder="x"), *found(rows[1], folder="y")], labels={"x/run": "ours"})
    assert list(measured(labelled)) == ["ours", "DOPE"]


def test_an_encoder_is_one_line_wherever_its_rows_lie() -> None:
    encoder = {"method": "m:f", "run": "", "step": None, "network": "encoder"}
    there, here = found(row(**encoder), folder="x"), found(row(shots=5, **encoder), folder="y")
    assert list(measured(build_table([*there, *here], beside="none"))) == ["m:f"]
    other = found(row(shots=5, **{**encoder, "checkpoint_sha256": "bb"}), folder="x")
    assert list(measured(build_table([*there, *other], beside="none"))) == ["m:f (weights aa)", "m:f (weights bb)"]


def test_one_label_makes_one_line_of_runs_for_a_setting_each() -> None:
    rows = [row(0.5, method="feat", run="f1"), row(0.7, method="feat", run="f5", shots=5, config_hash="d")]
    cells = measured(table(*rows, f1="FEAT", f5="FEAT"))["FEAT"]
    assert [cell and round(cell.accuracy, 6) for cell in cells] == [50, 70]
    with pytest.raises(UsageError, match="'same' has two measurements of 5-way 1-shot"):
        table(row(run="a"), row(run="b"), a="same", b="same")


def test_rows_that_cannot_be_in_one_table_are_refused() -> None:
    with pytest.raises(UsageError, match=r"two protocols.*seed: 0 and 1"):
        table(row(), row(method="rfs", run="r", seed=1))
    with pytest.raises(UsageError, match="is there twice"):
        table(row(), row())


def test_a_label_for_no_run_is_refused() -> None:
    with pytest.raises(UsageError, match=r"no run 'nope' \(there are: a, b\)"):
        table(row(run="a"), row(run="b"), nope="x")


def test_chance_and_what_all_rows_share_are_said_once() -> None:
    made = table(row(), row(0.3, ways=10), row(0.4, method="rfs", run="r"))
    chance = made.blocks[0].lines[-1]
    assert chance.label == "chance" and [cell and cell.accuracy for cell in chance.cells] == [20, 10]
    text = " ".join(as_text(made).split())
    for said in ("2,500 episodes a setting (seed 0)", "15 queries a class", "10 categories, 200 objects, 2,000 views"):
        assert text.count(said) == 1
    assert "Classifier: local matching." in text and not made.with_classifier
    differing = table(row(), row(method="rfs", run="r", classifier="logistic"))
    assert differing.with_classifier and [line.classifier for line in differing.blocks[0].lines] == [
        "local matching", "logistic", ""
    ]  # fmt: skip


def test_reduced_ways_and_queries_are_said() -> None:
    made = " ".join(table(row(ways=4, asked_ways=5), row(ways=4, shots=5, queries=9, asked_queries=15)).caption)
    assert "fewer ways than asked for in 4-way 1-shot" in made
    assert "15 queries a class (as few as 9 where there are not enough objects)" in made


def test_the_papers_figures_stand_beside_a_table_that_it_has() -> None:
    rows = [row(method="dope", table="modelnet40_ls", table_split=0, ways=ways) for ways in (5, 10)]
    made = table(*rows, beside="methods")
    lines = {line.label: [cell and cell.accuracy for cell in line.cells] for line in made.blocks[1].lines}
    assert len(lines) == 12 and lines["DOPE"] == [57.51, 42.73] and lines["DOPE - ABC"] == [62.76, 49.39]
    assert "arXiv 2211.15059" in made.caption[-1]
    everything = table(*rows, beside="all")
    assert [len(block.lines) for block in everything.blocks] == [2, 12, 4, 3]
    assert everything.blocks[3].lines[1].cells[0] == Cell(54.24) and everything.blocks[3].lines[1].cells[1] is None
    assert len(table(*rows, beside="none").blocks) == 1
    assert len(table(row(), beside="all").blocks) == 1, "no table, none of the paper's figures"


def test_the_papers_rows_are_complete() -> None:
    assert [len(paper.paper_rows(name)) for name in ("modelnet40_ls", "shapenet55_ls", "co3d_ls")] == [12, 10, 8]
    for name in ("modelnet40_ls", "shapenet55_ls", "co3d_ls"):
        assert all(list(line.accuracy) == ["5w1s", "5w5s", "10w1s", "10w5s"] for line in paper.paper_rows(name))
    assert paper.paper_rows("co3d_ls")[-1].accuracy == {"5w1s": 61.77, "5w5s": 75.16, "10w1s": 48.07, "10w5s": 62.97}


HOSTILE = r"a|b_50% & $x^2$ {y} \z #1 ~" + "\x1b[31m"


def test_labels_cannot_break_a_format() -> None:
    made = table(row(run="a"), row(run="b"), a=HOSTILE)
    latex = as_latex(made)
    assert r"a|b\_50\% \& \$x\textasciicircum{}2\$ \{y\} \textbackslash{}z \#1 \textasciitilde{}?[31m" in latex
    assert latex.count("{") == latex.count("}")
    line = next(line for line in as_markdown(made).splitlines() if "50%" in line)
    assert line.count("|") - line.count(r"\|") == 3, "two cells"
    assert "\x1b" not in as_text(made) + as_markdown(made) + latex


def test_latex_rows_have_one_cell_a_column() -> None:
    rows = [row(table="modelnet40_ls", table_split=i, ways=w, method=m, classifier=m) for i in range(5)
            for w in (5, 10) for m in ("dope", "rfs")]  # fmt: skip
    latex = as_latex(table(*rows, beside="all"))
    assert r"\begin{tabular}{llrr}" in latex and latex.count(r"\midrule") == 4
    body = [line for line in latex.splitlines() if line.endswith(r"\\") and "multicolumn" not in line]
    assert {line.count(" & ") for line in body} == {3}


def test_text_is_aligned() -> None:
    lines = as_text(table(row(run="a"), row(0.123, run="longer name"), a="漢字")).splitlines()
    rows = [line for line in lines if line.startswith(("漢字", "DOPE", "chance"))]
    from rich.cells import cell_len

    assert len(rows) == 3 and len({cell_len(line) for line in rows}) == 1


def test_one_split_is_no_mean(tmp_path: Path) -> None:
    found = find_rows([write_run(tmp_path / "a", row(table="mine", table_split=0, part="test"))])
    assert not any("means over" in sentence for sentence in build_table(found).caption)
