"""All stages in one go: the same work as the single commands, no sequence stops another, and parts of an array job."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import orbit, write_sequence
from tiny_media import encode, pan, write_photos
from typer.testing import CliRunner, Result

from dope.common import files
from dope.common.errors import BadInput, UsageError
from pipeline import commands, prepare, tasks
from pipeline.engines import Share, holding_output
from pipeline.inputs.sources import Source
from pipeline.prepare import ColmapConfig, add_masks, correspond_all
from pipeline.refused import keep_refused
from pipeline.report.status_table import read_status
from pipeline.run import Item, RunConfig, items_of, run_all, still_to_do
from pipeline.sequence import Sequence, SequenceInfo
from pipeline.stages import StageResult, fingerprint, read_marker, run_stage
from pipeline.tasks import RunOptions

ROOT = Path(__file__).parents[2]
CONFIG, HERE = RunConfig(), RunOptions()
STAGES = ["frames", "sfm", "depth", "masks", "correspond"]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Work is done in this process; cameras, depth and matching only say that they were asked."""
    made: list[str] = []

    def stand_in(name: str) -> Callable[..., dict[str, Any]]:
        def work(sequence: Sequence, *_: object) -> dict[str, Any]:
            made.append(f"{name} {sequence.id}")
            if name == "reconstruct" and sequence.id == "bad":
                raise BadInput("nothing registers")
            return {}

        return work

    monkeypatch.setattr(tasks, "run_in_child", lambda work, *args, limits, notify: work(*args, notify))
    for name in ("reconstruct", "compute_depth", "correspond"):
        monkeypatch.setattr(prepare, name, stand_in(name))
    return made


@pytest.fixture
def sources(tmp_path: Path) -> list[Source]:
    """Three captures with masks; the second cannot be reconstructed."""
    found = []
    mask = np.zeros((128, 192), np.uint8)
    mask[:, :60] = 255
    for name in ("ant", "bad", "cat"):
        photos, masks = write_photos(tmp_path / "in" / name, pan(6)), tmp_path / "masks" / name
        masks.mkdir(parents=True)
        for photo in photos.iterdir():
            (masks / f"{photo.stem}.png").write_bytes(encode(mask, ".png"))
        found.append(Source(photos, name, "photos", masks=masks))
    return found


def states(rows: list[StageResult]) -> list[str]:
    return [f"{row.sequence} {row.stage} {row.status}{' skipped' if row.skipped else ''}" for row in rows]


def skipped(rows: list[StageResult]) -> bool:
    return all(row.skipped for row in rows)


def test_a_sequence_that_fails_stops_itself_only(sources: list[Source], tmp_path: Path, calls: list[str]) -> None:
    rows = run_all(items_of(sources, [], {}, tmp_path / "w"), CONFIG, HERE)
    good = [f"{name} {stage} ok" for name in ("ant", "cat") for stage in STAGES]
    assert states(rows) == [*good[:5], "bad frames ok", "bad sfm failed", *good[5:]], rows[0].reason
    assert "compute_depth bad" not in calls and len(calls) == 7


def test_a_sequence_goes_through_all_stages_before_the_next_begins(
    sources: list[Source], tmp_path: Path, calls: list[str]
) -> None:
    run_all(items_of(sources[::2], [], {}, tmp_path / "w"), CONFIG, HERE)
    assert [call.split()[1] for call in calls] == ["ant"] * 3 + ["cat"] * 3


def test_the_single_commands_and_the_run_are_the_same_work(
    sources: list[Source], tmp_path: Path, calls: list[str]
) -> None:
    chosen, config = sources[::2], CONFIG

    def single(work: Path) -> list[StageResult]:
        sequences = [Sequence(work / source.id) for source in chosen]
        rows = prepare.prepare(chosen, work, config.colmap, HERE)
        rows += add_masks(sequences, config.masks, {}, HERE)
        return rows + correspond_all(sequences, config.correspond, HERE)

    run_all(items_of(chosen, [], {}, tmp_path / "one"), config, HERE)
    assert skipped(single(tmp_path / "one"))
    assert not skipped(single(tmp_path / "two"))
    assert skipped(run_all(items_of(chosen, [], {}, tmp_path / "two"), config, HERE))
    assert isinstance(config.colmap, ColmapConfig)


def test_what_work_holds_is_taken_further_without_its_input(
    sources: list[Source], tmp_path: Path, calls: list[str]
) -> None:
    work = tmp_path / "w"
    prepare.prepare(sources, work, CONFIG.colmap, HERE)
    (work / "gap").mkdir()
    held = [Sequence(work / name) for name in ("ant", "bad", "gap")]
    calls.clear()
    rows = run_all(items_of([], held, {}, work), CONFIG, HERE)
    assert states(rows) == [
        *(f"ant {stage} ok skipped" for stage in STAGES[:3]), "ant masks ok", "ant correspond ok",
        "bad frames ok skipped", "bad sfm failed skipped", "gap frames failed",
    ]  # fmt: skip
    assert "'frames' has not been run" in str(rows[-1].reason) and "INPUT" in str(rows[-1].reason)
    held[2].write_info(SequenceInfo("gap", "co3d/apple/gap", "co3d"))
    assert "`dope prep co3d` again" in str(run_all(items_of([], held[2:], {}, work), CONFIG, HERE)[-1].reason)
    assert calls == ["correspond ant"]
    assert skipped(run_all(items_of(sources[:1], [], {}, work), CONFIG, HERE)), "the same work as with its input"


def test_masks_to_import_are_part_of_the_run(sources: list[Source], tmp_path: Path, calls: list[str]) -> None:
    item = Item(tmp_path / "w/ant", sources[0], masks=sources[2].masks)
    rows = run_all([item], CONFIG, HERE)
    assert rows[3].stage == "masks" and rows[3].details["from"] == str(sources[2].masks)
    assert skipped(add_masks([Sequence(item.folder)], CONFIG.masks, {"ant": item.masks or Path()}, HERE))


def test_a_part_knows_what_other_parts_have_still_to_do(
    sources: list[Source], tmp_path: Path, calls: list[str]
) -> None:
    items = items_of(sources, [], {}, tmp_path / "w")
    run_all(items[:1], CONFIG, HERE)
    assert still_to_do(items, CONFIG, Share(0, 3)) == ["bad", "cat"]
    run_all(items[1:], CONFIG, HERE)
    assert still_to_do(items, CONFIG, Share(0, 3)) == [], "what failed is done"
    other = RunConfig(match=type(CONFIG.match)(max_points=99))
    assert still_to_do(items, other, Share(0, 3)) == ["cat"], "results of other settings are none"
    assert still_to_do(items, other, Share(0, 1)) == []
    gone = Item(tmp_path / "w/gone", Source(tmp_path / "in/gone", "gone", "photos"))
    assert still_to_do([*items, gone], CONFIG, Share(0, 4)) == [], "nobody can do what cannot be read"


def test_a_stage_of_a_newer_version_is_run_again_and_all_after_it(
    sources: list[Source], tmp_path: Path, calls: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    items = items_of(sources[:1], [], {}, tmp_path / "w")
    run_all(items, CONFIG, HERE)
    versions = prepare.stages.STAGE_VERSIONS
    monkeypatch.setitem(versions, "depth", versions["depth"] + 1)
    ran = [row.stage for row in run_all(items, CONFIG, HERE) if not row.skipped]
    assert ran == ["depth", "correspond"]
    assert fingerprint("depth", None, None) != fingerprint("masks", None, None)


def test_empty_results_are_tried_again_where_asked(
    sources: list[Source], tmp_path: Path, calls: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    items = items_of(sources[:1], [], {}, tmp_path / "w")
    with monkeypatch.context() as patch:
        patch.setattr(prepare, "correspond", lambda *_: {"empty": "no pair"})
        assert states(run_all(items, CONFIG, HERE))[-1] == "ant correspond empty"
    assert skipped(run_all(items, CONFIG, HERE))
    assert states(run_all(items, CONFIG, RunOptions(retry_failed=True)))[-1] == "ant correspond ok"


# from here on with real views, pairs and shards, on sequences whose cameras and depth are known


def known(work: Path, name: str, views: int = 8) -> Sequence:
    """A sequence as `prep colmap` would leave it, masks included."""
    sequence = write_sequence(work / name, orbit(views, width=80, height=60, focal=95))
    info = sequence.read_info()
    info.masks_from = "input"
    sequence.write_info(info)
    for stage in STAGES[:3]:
        masks = {"masks": {"masks": views, "missing": 0, "empty": 0}} if stage == "frames" else {}
        assert run_stage(sequence, stage, None, name, lambda masks=masks: masks).ok  # type: ignore[misc]
    return sequence


def prep_run(*words: object) -> Result:
    return CliRunner().invoke(commands.app, ["run", *map(str, words), "--views-every", "1", "--workers", "1"])


def test_the_command_packs_what_is_ok_and_says_the_rest(tmp_path: Path) -> None:
    work, shards = tmp_path / "w", tmp_path / "s"
    known(work, "ant")
    known(work, "one", views=1)
    answer = prep_run("--out", work, "--shards", shards, "--json")
    assert answer.exit_code == 1, answer.output
    rows = [json.loads(line) for line in answer.stdout.splitlines()]
    assert [(row["sequence"], row["status"]) for row in rows[:-1] if row["stage"] == "correspond"] == [
        ("ant", "ok"), ("one", "empty")]  # fmt: skip
    assert rows[-1]["sequences"] == 1 and "empty" in rows[-1]["left_out"]["one"]
    stamp = (shards / "dataset.json").stat().st_mtime_ns
    again = prep_run("--out", work, "--shards", shards)
    assert "done before" in again.stdout and (shards / "dataset.json").stat().st_mtime_ns == stamp


def test_a_place_for_shards_that_is_taken_is_refused_before_any_work(tmp_path: Path) -> None:
    ant = known(tmp_path / "w", "ant")
    answer = prep_run("--out", tmp_path / "w", "--shards", tmp_path / "w")
    assert isinstance(answer.exception, UsageError) and "not shards (ant)" in str(answer.exception)
    assert read_marker(ant, "masks") is None
    answer = prep_run(tmp_path / "nowhere.mp4", "--out", tmp_path / "new", "--shards", tmp_path / "s")
    assert "nowhere" in answer.output and "no sequence has correspondences" in str(answer.exception)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--count", "30", "--set", "depth.agreement.tolerance=0.1"], "frames.count, depth.agreement"),
        (["--mask-features"], "sfm.mask_features"),
        (["--category", "mug"], "--category"),
        (["--category-from", "parent", "--depths", "{}/depths"], "--category-from, --depths"),
    ],
)
def test_what_has_no_effect_without_an_input_is_refused(tmp_path: Path, words: list[str], named: str) -> None:
    ant = known(tmp_path / "w", "ant")
    answer = prep_run("--out", tmp_path / "w", *words)
    assert isinstance(answer.exception, UsageError) and f"as they are: {named} would have no" in str(answer.exception)
    assert read_marker(ant, "masks") is None


@pytest.mark.parametrize("setting", ["sfm.threads", "depth.threads"])
def test_threads_are_a_flag_and_no_setting(tmp_path: Path, setting: str) -> None:
    stage = setting.partition(".")[0]
    (tmp_path / "threads.yaml").write_text(f"{stage}:\n  threads: 2\n")
    for words in (["--set", f"{setting}=2"], ["--config", tmp_path / "threads.yaml"]):
        answer = prep_run(tmp_path, "--out", tmp_path / "w", *words)
        assert isinstance(answer.exception, UsageError) and "Use --threads" in str(answer.exception)


def test_inputs_that_cannot_be_used_stay_to_be_seen_until_they_can(tmp_path: Path) -> None:
    work = tmp_path / "w"
    Sequence(work / "fox").write_info(SequenceInfo("fox", str(write_photos(tmp_path / "a/fox", pan(2))), "photos"))
    other = write_photos(tmp_path / "b/fox", pan(2, seed=1))

    def shown() -> dict[str, str]:
        return {row["id"]: row["reason"] for row in read_status([work]).to_pylist() if row["status"] == "failed"}

    lost, gone = tmp_path / "lost.mp4", tmp_path / "gone.mp4"
    assert prep_run(lost, gone, "--out", work).exit_code == 1
    assert sorted(shown()) == ["gone", "lost"] and f"{lost}: no such file" in shown()["lost"]
    assert prep_run(lost, "--out", work, "--num-shards", 2, "--shard-index", 1).exit_code == 0
    assert sorted(shown()) == ["lost"], "the other is not named any more; this one is the first part's"
    page = tmp_path / "report.html"
    assert CliRunner().invoke(commands.app, ["report", str(work), "--out", str(page)]).exit_code == 0
    assert "no such file or folder" in page.read_text()
    keep_refused(work, prepare.prepare([Source(other, "fox", "photos")], work, ColmapConfig(), HERE))
    assert "holds the sequence of" in shown()["fox"] and "lost" not in shown()
    assert prep_run("--out", work).exit_code == 1 and "fox" in shown(), "a run without inputs names none"
    keep_refused(work, [])
    assert not shown() and not (work / ".refused").exists()


def test_the_part_that_ends_last_writes_the_shards(tmp_path: Path) -> None:
    work, shards = tmp_path / "w", tmp_path / "s"
    for name in ("ant", "bee", "cat"):
        known(work, name)
    parts = [("--out", work, "--shards", shards, "--num-shards", 2, "--shard-index", part) for part in (1, 0)]
    first = prep_run(*parts[0])
    assert first.exit_code == 0 and not shards.exists(), first.output
    assert "2 sequences are to be done: ant, cat" in " ".join(first.output.split())
    assert prep_run(*parts[1]).exit_code == 0
    assert files.read_json(shards / "dataset.json")["counts"]["sequences"] == 3


def test_two_writers_of_one_folder_of_shards(tmp_path: Path) -> None:
    known(tmp_path / "w", "ant")
    shards = tmp_path / "s"
    assert prep_run("--out", tmp_path / "w").exit_code == 0
    with holding_output(shards):
        answer = CliRunner().invoke(commands.app, ["shards", str(tmp_path / "w"), "--out", str(shards)])
        assert isinstance(answer.exception, BadInput)
        assert f"{shards}: is being worked on by process {os.getpid()}" in str(answer.exception)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["w"]


def test_what_a_killed_writer_left_is_cleared_and_a_folder_half_replaced_comes_back(tmp_path: Path) -> None:
    for name in (".s.99999.partial", ".s.99999.partial.old", ".s.v2.99999.partial"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "train-000000.tar").write_text(name)
    with holding_output(tmp_path / "s"):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == [".s.v2.99999.partial", "s"]
    assert (tmp_path / "s/train-000000.tar").read_text().endswith("old")


@pytest.mark.skipif(sys.platform != "linux", reason="looks for the run's processes in /proc")
@pytest.mark.parametrize("signal_", [signal.SIGTERM, signal.SIGINT])
def test_a_stopped_run_ends_its_children_and_says_how_to_go_on(tmp_path: Path, signal_: signal.Signals) -> None:
    work = tmp_path / "w"
    for name in ("ant", "bee"):
        known(work, name, views=20)
    words = ["prep", "run", "--out", work, "--views-every", "1", "--workers", "2"]
    with subprocess.Popen(
        [sys.executable, "-m", "cli", *map(str, words)], stderr=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT,
        text=True, start_new_session=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:  # fmt: skip
        # SIGINT is ignored in what a script has put into the background, and children inherit that
        while process.poll() is None and not (at_work := list(work.glob("*/.views.*.partial"))):
            time.sleep(0.005)
        process.send_signal(signal_)
        said = process.communicate(timeout=60)[1]
    assert process.returncode == 130, said
    assert "run the same command again to go on" in said and "Traceback" not in said
    assert [read_marker(Sequence(path.parent), "correspond") for path in at_work] == [None] * len(at_work)
    deadline = time.monotonic() + 20
    while (left := running_in_group(process.pid)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not left, "somebody of the run is left"


def running_in_group(group: int) -> list[str]:
    """What /proc says of the processes of a group, zombies left out."""
    said = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            said.append(path.read_text().rpartition(") ")[2].split())
    return [" ".join(words) for words in said if int(words[2]) == group and words[0] != "Z"]
