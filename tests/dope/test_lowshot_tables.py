"""Evaluation by splits, and the choice of a checkpoint."""

from __future__ import annotations

import json
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tiny_results
import torch
from tiny_checkpoints import ALONE, CONFIG
from tiny_views import write_views
from typer.testing import CliRunner

from cli import app
from dope.checkpoints import save_checkpoint
from dope.common.errors import BadInput, UsageError
from dope.lowshot import results
from dope.lowshot.episodes import EpisodeConfig
from dope.lowshot.evaluate import Evaluation, EvaluationConfig, evaluate
from dope.lowshot.results import ResultRow, mean_over_splits, read_rows
from dope.lowshot.selection import best_checkpoints, evaluate_best
from dope.lowshot.splits import Split, SplitTable
from dope.lowshot.tasks import validation_protocol
from dope.methods import method_of
from dope.networks import NetworkConfig
from dope.results.sources import NAMES
from dope.state import new_state

NETWORK = NetworkConfig(width=0.125, pyramid=8, projector=(8, 4))
TWO_WAYS = EpisodeConfig(ways=2, shots=1, queries=2, episodes=12, fit=True)
TABLE = SplitTable(
    "mine",
    ("Shape 0",),
    (Split(("shape_1", "shape2"), ("SHAPE3", "shape4", "shape5")), Split(("shape4", "shape5"), ("shape1", "shape2"))),
)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_views(tmp_path_factory.mktemp("shards"), categories=6, objects=4, views=1, size=32)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with four checkpoints of unrelated random weights, the last two equal."""
    folder = tmp_path_factory.mktemp("runs") / "my_run"
    config = replace(CONFIG, checkpoint=replace(CONFIG.checkpoint, keep=0))
    for step, seed in ((1, 11), (2, 12), (3, 13), (4, 13)):
        state = replace(new_state(method_of(replace(config, seed=seed)), ALONE), step=step)
        save_checkpoint(folder, state, method_of(config), "data")
    return folder


def config(**changes: Any) -> EvaluationConfig:
    return EvaluationConfig(**{"protocols": (TWO_WAYS,), **changes})


def test_each_split_is_evaluated_on_its_own_classes_and_never_on_base_ones(shards: Path, run: Path) -> None:
    result = evaluate(run, shards, config(), table=TABLE)
    assert [(r.table, r.table_split, r.part, r.n_classes) for r in result.rows] == [
        ("mine", 0, "test", 3),
        ("mine", 1, "test", 2),
    ]
    for row, categories in zip(result.rows, (("shape3", "shape4", "shape5"), ("shape1", "shape2")), strict=True):
        (alone,) = evaluate(run, shards, config(categories=categories)).rows
        assert (
            replace(alone, table="mine", table_split=row.table_split, part="test", evaluation_hash=row.evaluation_hash)
            == row
        )
    val = evaluate(run, shards, config(part="val", table_splits=(1,)), table=TABLE).rows
    assert [(r.table_split, r.part, r.n_classes) for r in val] == [(1, "val", 2)]


def test_what_a_table_cannot_give_is_explained(shards: Path) -> None:
    with pytest.raises(UsageError, match=r"mine has splits 0 to 1, not 2"):
        evaluate(None, shards, config(table_splits=(2,)), table=TABLE, network=NETWORK)
    with pytest.raises(UsageError, match=r"--category: mine says which"):
        evaluate(None, shards, config(categories=("shape1",)), table=TABLE, network=NETWORK)
    for changes, flag in (({"part": "val"}, "--part val"), ({"table_splits": (0,)}, "--table-split")):
        with pytest.raises(UsageError, match=flag):
            evaluate(None, shards, config(**changes), network=NETWORK)
    strict = config(protocols=(replace(TWO_WAYS, ways=3, fit=False),))
    with pytest.raises(UsageError, match=r"mine, test classes of split 1: 3-way 1-shot .* need at least 3 classes"):
        evaluate(None, shards, strict, table=TABLE, network=NETWORK)


def test_classes_that_the_shards_lack_are_an_error_or_left_out_and_said(shards: Path) -> None:
    table = replace(TABLE, splits=(Split(("shape1",), ("shape2", "shape3", "sofa")),))
    with pytest.raises(UsageError, match=r"lack 1 of its 3 classes: sofa\. There are: shape0, shape1"):
        evaluate(None, shards, config(protocols=(replace(TWO_WAYS, fit=False),)), table=table, network=NETWORK)
    result = evaluate(None, shards, config(), table=table, network=NETWORK)
    assert result.rows[0].n_classes == 2 and any("left out sofa" in note for note in result.notes)
    without = replace(TABLE, splits=(Split((), ("shape2", "shape3")),))
    with pytest.raises(UsageError, match="val classes of split 0: there are none"):
        evaluate(None, shards, config(part="val"), table=without, network=NETWORK)


def test_the_shown_mean_is_that_of_accuracies_and_of_intervals(shards: Path) -> None:
    rows = evaluate(None, shards, config(), table=TABLE, network=NETWORK).rows
    more = [replace(row, shots=5, accuracy=0.9) for row in rows]
    (mean, count), (other, _) = mean_over_splits([*rows, *more])
    assert count == 2 and mean.table_split == -1 and other.accuracy == pytest.approx(0.9)
    assert mean.accuracy == pytest.approx((rows[0].accuracy + rows[1].accuracy) / 2)
    assert mean.ci95 == pytest.approx((rows[0].ci95 + rows[1].ci95) / 2)


def test_each_split_is_tested_with_the_checkpoint_its_validation_classes_choose(shards: Path, run: Path) -> None:
    result = evaluate_best(run, shards, config(), TABLE)
    val, test = ([row for row in result.rows if row.part == part] for part in ("val", "test"))
    assert len(val) == 4 * 2 and [row.table_split for row in test] == [0, 1]
    assert {row.seed for row in val} == {validation_protocol(TWO_WAYS).seed} != {TWO_WAYS.seed}
    assert all((row.shots, row.asked_ways, row.ways) == (1, 5, 2) for row in val)
    for row in test:
        of_split = [other for other in val if other.table_split == row.table_split]
        most = max(other.accuracy for other in of_split)
        last = [other.checkpoint for other in of_split if other.accuracy == most][-1]
        assert row.checkpoint == last and row.run == "my_run" and row.method == "dope"
        note = next(note for note in result.notes if note.startswith(f"split {row.table_split}: "))
        assert last in note and "since 5-way needs more classes" in note
        path = run / "checkpoints" / last
        alone = evaluate(path, shards, config(table_splits=(row.table_split,)), table=TABLE).rows
        assert (replace(alone[0], chosen_by="validation"),) == (row,)
    assert {row.chosen_by for row in val} == {""}


def test_of_equally_good_checkpoints_the_later_is_chosen(run: Path, shards: Path) -> None:
    rows = evaluate_best(run, shards, config(), TABLE).rows
    third, fourth = ([r.accuracy for r in rows if r.part == "val" and r.step == step] for step in (3, 4))
    assert third == fourth  # of the same weights
    same = [replace(rows[0], table_split=0, accuracy=a, step=i) for i, a in enumerate((0.5, 0.75, 0.75, 0.6))]
    assert best_checkpoints(same)[0].step == 2


def test_selection_needs_a_run_with_checkpoints(shards: Path, run: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no run's folder"):
        evaluate_best(run / "checkpoints" / "step-00000001.pt", shards, config(), TABLE)
    with pytest.raises(BadInput, match="has no checkpoint"):
        evaluate_best(tmp_path, shards, config(), TABLE)
    with pytest.raises(UsageError, match="--compare-untrained"):
        evaluate_best(run, shards, config(compare_untrained=True), TABLE)


def test_damaged_and_diverged_checkpoints_are_passed_over_and_said(shards: Path, run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "my_run"))
    found = sorted((copy / "checkpoints").glob("*.pt"))
    found[3].write_bytes(b"damaged")
    values = torch.load(found[2], weights_only=True)
    for weights in values["network"].values():
        if weights.is_floating_point():
            weights.fill_(torch.nan)
    torch.save(values, found[2])
    found[2].with_name(found[2].name + ".sha256").unlink()
    result = evaluate_best(copy, shards, config(), TABLE)
    assert {r.step for r in result.rows} == {1, 2} and any("the best of 2 with" in note for note in result.notes)
    passed = [note for note in result.notes if "was passed over" in note]
    assert [note.split()[0] for note in passed] == [path.name for path in found[2:]]
    assert "NaN" in passed[0] and "damaged" in passed[1]
    for path in found:
        path.write_bytes(b"damaged")
    with pytest.raises(BadInput, match=r"none of its 4 checkpoints can be used; step-00000001\.pt: is damaged"):
        evaluate_best(copy, shards, config(), TABLE)


def test_training_classes_with_labels_are_never_tested(
    shards: Path, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dope import checkpoints

    real = checkpoints.load_method

    def with_labels(*arguments: Any) -> Any:
        method, network, meta = real(*arguments)
        return method, network, {**meta, "facts": {"classes": ["shape0", "Shape 5"]}}

    monkeypatch.setattr(checkpoints, "load_method", with_labels)
    with pytest.raises(UsageError, match="labels of shape5, which split 0 of mine tests"):
        evaluate(run, shards, config(), table=TABLE)
    evaluate(run, shards, config(table_splits=(1,)), table=TABLE)


def test_the_command_selects_and_shows_the_mean(shards: Path, run: Path, tmp_path: Path) -> None:
    table = tmp_path / "mine.json"
    splits = [{"val": split.val, "test": split.test} for split in TABLE.splits]
    table.write_text(json.dumps({"base": TABLE.base, "splits": splits}))
    flags = ["--split-file", str(table), "--select", "--ways", "2", "--queries", "2", "--episodes", "12", "--fit"]
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["eval", str(run), str(shards), *flags, "--device", "cpu", "--out", str(out)])
    assert done.exit_code == 0, done.output
    text = " ".join(done.output.split())
    assert "mean of 2 splits, test" in text and "split 1: step-0000000" in text
    rows = read_rows(out / "results.parquet")
    assert rows == read_rows(out / "results.json") and [row.part for row in rows].count("test") == 2
    expected = evaluate_best(run, shards, config(), TABLE).rows
    assert [row.accuracy for row in rows] == [row.accuracy for row in expected]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--select"], "--select: needs splits"),
        (["--table", "co3d"], "no table 'co3d'"),
        (["--table", "co3d_ls", "--split-file", "x.json"], "--split-file: names splits"),
        (["--split-file", "absent.json"], "absent.json: no such file"),
        (["--table", "co3d_ls"], "the shards lack"),
        (["--classifier", "svm"], "'svm' is not one of"),
        (["--support-copies", "3"], "--support-copies: is for --classifier logistic"),
        (["--ways", "1"], "--ways: must be at least 2"),
        (["--cache", "absent", "--ways", "2", "--queries", "1"], "--cache absent: cannot be written to"),
    ],
)
def test_wrong_flags_are_explained(shards: Path, run: Path, flags: list[str], message: str) -> None:
    arguments = ["eval", str(run), str(shards), "--episodes", "3", "--queries", "2", *flags]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code != 0 and message in str(done.exception)


def test_what_cannot_be_kept_is_refused_before_it_is_measured(
    shards: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Evaluation, "measure", None)
    arguments = ["eval", str(run), str(shards), "--ways", "2", "--queries", "2", "--device", "cpu", "--out"]

    def refused(out: Path) -> str:
        return str(CliRunner().invoke(app, [*arguments, str(out)]).exception)

    (tmp_path / "file").write_text("")
    assert f"{tmp_path / 'file'}: is no folder" in refused(tmp_path / "file")
    for name in NAMES:
        (tmp_path / "damaged").mkdir(exist_ok=True)
        (tmp_path / "damaged" / name).write_bytes(b"nonsense")
        assert str(tmp_path / "damaged" / name) in refused(tmp_path / "damaged")
        (tmp_path / "damaged" / name).unlink()
    monkeypatch.setattr("os.access", lambda *_: False)
    assert "cannot be written to. Name a folder for the results by --out" in refused(tmp_path / "new" / "deep")
    assert not (tmp_path / "new").exists()


def test_a_protocol_given_twice_is_measured_once_and_rows_lie_beside_the_checkpoint(
    shards: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def evaluated(name: Path) -> list[ResultRow]:
        flags = ["--ways", "2", "--ways", "2", "--shots", "1", "--queries", "2", "--episodes", "3", "--device", "cpu"]
        done = CliRunner().invoke(app, ["eval", str(name), str(shards), *flags])
        assert done.exit_code == 0 and "at least" not in done.output, done.output
        (file,) = tmp_path.rglob("results.json")
        assert file.parent == tmp_path / "mine" / "eval"
        return read_rows(file)

    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine" / "checkpoints").mkdir(parents=True)
    for place in (tmp_path / "mine", tmp_path / "mine" / "checkpoints"):
        shutil.copy(run / "checkpoints" / "step-00000002.pt", place / "net.pt")
    (one,) = evaluated(Path("mine/net.pt"))
    assert one.run == "mine" and evaluated(tmp_path / "mine" / "checkpoints" / "net.pt") == [one]


def test_old_result_rows_without_the_new_columns_are_read(tmp_path: Path, shards: Path) -> None:
    row = evaluate(None, shards, config(), network=NETWORK).rows[0]
    values = dict(vars(row))
    for name in ("method", "run", "table", "table_split", "part", "support_copies", "chosen_by"):
        del values[name]
    (tmp_path / "results.json").write_text(json.dumps([values]))
    (old,) = read_rows(tmp_path / "results.json")
    assert isinstance(old, ResultRow) and (old.method, old.run, old.table, old.table_split, old.part) == (
        "dope",
        "",
        "",
        -1,
        "all",
    )
    assert (old.support_copies, old.chosen_by) == (1, "")
    pq.write_table(pa.Table.from_pylist([values]), tmp_path / "results.parquet")
    assert results.append_rows(tmp_path / "results.parquet", [replace(row, support_copies=5)])[0] == old


@pytest.mark.parametrize("suffix", [".parquet", ".json"])
def test_a_choice_replaces_an_earlier_one_and_nothing_else(tmp_path: Path, suffix: str) -> None:
    chosen = {"table": "mine", "part": "test", "chosen_by": "validation"}
    first = [tiny_results.row(0.5, table_split=i, step=10 + i, checkpoint_sha256=str(i), **chosen) for i in range(2)]
    newest = tiny_results.row(0.4, table_split=0, step=10, checkpoint_sha256="0", table="mine", part="test")
    later = tiny_results.row(0.6, table_split=0, step=30, checkpoint_sha256="3", **chosen)
    results.append_rows(tmp_path / f"results{suffix}", [*first, newest])
    assert results.append_rows(tmp_path / f"results{suffix}", [later]) == [later, first[1], newest]


def test_evaluations_that_end_at_once_lose_no_rows(
    tmp_path: Path, shards: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = evaluate(None, shards, config(), network=NETWORK).rows[0]
    real = results._write

    def slowly(*arguments: Any) -> None:
        time.sleep(0.05)
        real(*arguments)

    monkeypatch.setattr(results, "_write", slowly)
    path = tmp_path / "results.json"
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda seed: results.append_rows(path, [replace(row, seed=seed)]), range(4)))
    assert sorted(one.seed for one in read_rows(path)) == [0, 1, 2, 3]


def test_the_help_shows_what_a_split_file_is() -> None:
    text = CliRunner().invoke(app, ["eval", "--help"], env={"COLUMNS": "200"}).output
    assert '{"base": [names], "splits": [{"val": [names], "test": [names]}, ...]}' in text
    assert "Classes an episode (5)" in text and "[default: (the temporary folder)]" in text
