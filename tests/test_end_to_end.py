"""The main job through the command line, on objects that are made and filmed here; and inputs that break it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from dope.common import files
from pipeline.demo.film import DemoConfig, FilmConfig, film_objects

ROOT = Path(__file__).parents[1]
WORKERS = ("--workers", 2)


def dope(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "cli", *map(str, words)], capture_output=True, text=True, cwd=ROOT, timeout=500
    )


def rows(answer: subprocess.CompletedProcess[str]) -> dict[tuple[str, str], dict]:
    found = [json.loads(line) for line in answer.stdout.splitlines()]
    return {(row["sequence"], row["stage"]): row for row in found}


def snapshot(folder: Path) -> dict[str, tuple[int, str]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, files.sha256_of(path))
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }


@pytest.fixture(scope="module")
def films(tmp_path_factory) -> Path:
    """Two filmed objects, with their masks."""
    folder = tmp_path_factory.mktemp("films")
    film = FilmConfig(frames=20, detail=0.25)
    film_objects(folder, DemoConfig(("mug", "chair"), (), per_family=1, containers=("mp4", "avi"), film=film))
    return folder


@pytest.fixture(scope="module")
def prepared(films, tmp_path_factory) -> Path:
    """The films prepared up to shards, beside five inputs that cannot be used."""
    out = tmp_path_factory.mktemp("out")
    bad = tmp_path_factory.mktemp("bad")
    (bad / "letter.mp4").write_text("Dear video,\n" * 200)
    (bad / "empty").mkdir()
    whole = next((films / "mug").glob("*.mp4")).read_bytes()
    (bad / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    inputs = [films / "mug", films / "chair", bad / "nowhere.mov", bad / "letter.mp4", bad / "empty", bad / "cut.mp4"]
    answer = dope("prep", "colmap", *inputs, "--category-from", "parent", "--masks", films / "masks",
                  "--out", out / "work", *WORKERS, "--json")  # fmt: skip
    (out / "colmap.json").write_text(answer.stdout)
    assert answer.returncode == 1, answer.stderr
    for words in (
        ("prep", "masks", out / "work"),
        ("prep", "correspond", out / "work", "--every", 1),
    ):
        answer = dope(*words, *WORKERS, "--json", *(("--sequence", "mug_0", "--sequence", "chair_0")))
        assert answer.returncode == 0, answer.stdout + answer.stderr
    answer = dope("prep", "shards", out / "work", "--out", out / "shards", "--verify")
    assert (out / "shards" / "dataset.json").exists(), answer.stderr
    return out


def test_bad_inputs_are_rows_that_name_the_file_and_the_good_ones_go_on(prepared: Path) -> None:
    table = [json.loads(line) for line in (prepared / "colmap.json").read_text().splitlines()]
    good = {(row["sequence"], row["stage"]): row for row in table if row["status"] == "ok"}
    assert {(name, stage) for name in ("mug_0", "chair_0") for stage in ("frames", "sfm", "depth")} <= set(good)
    for name in ("mug_0", "chair_0"):
        assert good[name, "sfm"]["details"]["registered_share"] >= 0.9
        assert good[name, "depth"]["details"]["mask_coverage"] > 0.6
    reasons = {row["sequence"]: row["reason"] for row in table if row["status"] == "failed"}
    assert set(reasons) == {"nowhere", "letter", "empty", "cut"}
    for name, reason in reasons.items():
        assert name in reason and len(reason) > 20, reason


def test_a_second_run_changes_no_file_and_takes_no_time(prepared: Path, films: Path) -> None:
    work = prepared / "work"
    before = snapshot(prepared)
    answer = dope("prep", "colmap", films / "mug", films / "chair", "--category-from", "parent",
                  "--masks", films / "masks", "--out", work, "--json")  # fmt: skip
    assert answer.returncode == 0 and all(row["skipped"] for row in rows(answer).values())
    for stage in ("masks", "correspond"):
        chosen = ("--sequence", "mug_0", "--sequence", "chair_0")
        every = ("--every", 1) if stage == "correspond" else ()
        answer = dope("prep", stage, work, *every, *chosen, "--json")
        assert answer.returncode == 0 and all(row["skipped"] for row in rows(answer).values())
    answer = dope("prep", "shards", work, "--out", prepared / "shards", "--json")
    assert json.loads(answer.stdout)["skipped"]
    notes = {name for name in before if name.startswith("work/.refused/")}  # the bad inputs are not named any more
    assert len(notes) == 4 and snapshot(prepared) == {name: before[name] for name in before.keys() - notes}


def test_one_worker_gives_the_same_shards_as_two(prepared: Path, films: Path, tmp_path: Path) -> None:
    chosen = ("--workers", 1)
    dope("prep", "colmap", films / "mug", films / "chair", "--category-from", "parent", "--masks", films / "masks",
         "--out", tmp_path / "work", *chosen)  # fmt: skip
    dope("prep", "masks", tmp_path / "work", *chosen)
    dope("prep", "correspond", tmp_path / "work", "--every", 1, *chosen)
    answer = dope("prep", "shards", tmp_path / "work", "--out", tmp_path / "shards")
    assert answer.returncode == 0, answer.stdout + answer.stderr
    ours, theirs = prepared / "shards", tmp_path / "shards"
    tars = sorted(path.name for path in theirs.glob("*.tar"))
    assert len(tars) >= 3 and tars == sorted(path.name for path in ours.glob("*.tar"))
    assert [files.sha256_of(ours / name) for name in tars] == [files.sha256_of(theirs / name) for name in tars]


def test_shards_hold_what_the_index_says(prepared: Path) -> None:
    index = pq.read_table(prepared / "shards" / "index.parquet").to_pylist()
    assert {row["category"] for row in index} == {"mug", "chair"}
    assert {row["split"] for row in index} == {"train", "val"}
    assert all(row["n_correspondences"] >= 32 for row in index)
    frames = {split: {(r["sequence"], r[f]) for r in index for f in ("frame1", "frame2") if r["split"] == split}
              for split in ("train", "val")}  # fmt: skip
    assert not frames["train"] & frames["val"]


def test_training_evaluation_and_figures_run_on_them(prepared: Path, tmp_path: Path) -> None:
    quick = ["data.image_size=64", "data.batch_size=8", "data.pairs_per_object=8", "schedule.epochs=3",
             "network.width=0.25", "data.workers=0", "validation.pairs=8"]  # fmt: skip
    settings = [word for setting in quick for word in ("--set", setting)]
    run, shards = tmp_path / "run", prepared / "shards"
    answer = dope("train", shards, "--out", run, "--preset", "nano", *settings)
    assert answer.returncode == 0, answer.stderr
    events = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert {"start", "step", "validation", "checkpoint", "end"} <= {event["event"] for event in events}
    assert list((run / "tensorboard").iterdir())

    answer = dope("eval", run, shards, "--classes", "instance", "--ways", 2, "--queries", 2, "--episodes", 20,
                  "--compare-untrained")  # fmt: skip
    assert answer.returncode == 0, answer.stderr
    results = files.read_json(run / "eval" / "results.json")
    assert [row["network"] for row in results] == ["trained", "untrained"]
    assert all(row["chance"] == 0.5 and 0 <= row["accuracy"] <= 1 for row in results)

    for kind in ("colouring", "heatmap"):
        answer = dope("figure", run, shards, "--kind", kind, "--masks", "given", "--out", tmp_path / "figures")
        assert answer.returncode == 0, answer.stderr
    assert len(list((tmp_path / "figures").glob("*.png"))) == 4

    answer = dope("train", shards, "--out", run, "--preset", "nano", *settings, "--set", "loss.temperature=0.2")
    assert answer.returncode == 2 and "temperature" in answer.stderr  # a checkpoint of another configuration
    tar = sorted(shards.glob("train-*.tar"))[0]
    damaged = tmp_path / "damaged"
    shutil.copytree(shards, damaged)
    (damaged / tar.name).write_bytes(tar.read_bytes()[: tar.stat().st_size // 2])
    answer = dope("train", damaged, "--out", tmp_path / "other", "--preset", "nano", *settings)
    assert answer.returncode == 1 and tar.name in answer.stderr and "Traceback" not in answer.stderr
