import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import pytest
import torch

from dope.checkpoints import (
    best_score,
    find_checkpoint,
    go_on_from,
    latest_checkpoint,
    list_checkpoints,
    load_network,
    note_origin,
    read_checkpoint,
    resume,
    resume_newest,
    save_checkpoint,
)
from dope.common import files, settings
from dope.common.errors import BadInput, DiskFull, UsageError
from dope.config import LogConfig, TrainConfig
from dope.methods import method_of
from dope.order import Place
from dope.state import new_state
from tests.dope.tiny_checkpoints import ALONE, CONFIG, at, keeping, steps_of, trained


@pytest.fixture
def run(tmp_path: Path) -> Path:
    save_checkpoint(tmp_path, trained(), method_of(CONFIG), "shards")
    return tmp_path


def test_everything_comes_back(run: Path) -> None:
    before, state = trained(), new_state(method_of(CONFIG), ALONE)
    resume(run, state, method_of(CONFIG), "shards")
    assert (state.step, state.place, state.validation) == (2, Place(1, 32), {"pck": 0.5})
    for ours, theirs in ((state.network, before.network), (state.momentum, before.momentum)):
        for name, value in ours.state_dict().items():
            assert torch.equal(value, theirs.state_dict()[name]), name
    moments = state.optimiser.state_dict()["state"], before.optimiser.state_dict()["state"]
    assert moments[0].keys() == moments[1].keys()
    assert all(torch.equal(moments[0][i]["exp_avg_sq"], moments[1][i]["exp_avg_sq"]) for i in moments[0])


def test_load_network_is_ready_to_evaluate_and_says_where_it_comes_from(run: Path) -> None:
    network, meta = load_network(run)
    assert not network.training
    assert meta["step"] == 2 and meta["dataset"] == "shards" and meta["validation"] == {"pck": 0.5}
    assert meta["config"]["network"]["projector"] == (8, 4)
    images = torch.rand(1, 3, 32, 32)
    expected = trained().network.eval().descriptors(images)
    torch.testing.assert_close(network.descriptors(images), expected, atol=1e-5, rtol=0)  # of another memory layout
    direct = load_network(Path(meta["path"]))[1]
    assert direct["sha256"] == meta["sha256"]


def test_the_hash_beside_it_is_what_sha256sum_checks(run: Path) -> None:
    name = list_checkpoints(run)[0].name
    subprocess.run(["sha256sum", "-c", f"{name}.sha256"], cwd=run / "checkpoints", check=True, capture_output=True)


def test_old_checkpoints_are_deleted_with_their_hashes(tmp_path: Path) -> None:
    for step in (5, 10, 15, 20):
        save_checkpoint(tmp_path, at(step), method_of(keeping(keep=2)), "shards")
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    stems = ["step-00000015.pt", "step-00000020.pt"]
    assert names == sorted(["latest", *stems, *(stem + ".sha256" for stem in stems)])
    assert latest_checkpoint(tmp_path) == tmp_path / "checkpoints" / stems[1]


def test_going_on_from_an_earlier_checkpoint_deletes_neither_the_new_nor_the_later_ones(tmp_path: Path) -> None:
    for step in (2, 8, 9, 3, 4):  # 3 after 9: a run that went back to an earlier place
        save_checkpoint(tmp_path, at(step), method_of(keeping(keep=2)), "shards")
    assert steps_of(tmp_path) == [3, 4, 8, 9]
    assert latest_checkpoint(tmp_path) == tmp_path / "checkpoints" / "step-00000004.pt"


def test_the_best_and_every_nth_are_kept_besides_the_newest(tmp_path: Path) -> None:
    policy, measured = keeping(keep=1, keep_best=True, keep_every=20), {10: 0.2, 30: 0.6, 50: 0.4}
    for step in range(10, 80, 10):
        pck = measured.get(step)
        is_best = pck is not None and pck > best_score(tmp_path, before=step)
        save_checkpoint(tmp_path, at(step), method_of(policy), "shards", best=pck if is_best else None)
    assert steps_of(tmp_path) == [20, 30, 40, 60, 70]
    assert (tmp_path / "checkpoints/best").read_text() == "step-00000030.pt 0.6\n"
    assert read_checkpoint(tmp_path / "checkpoints/best")["step"] == 30
    assert read_checkpoint(tmp_path / "checkpoints/latest")["step"] == 70
    assert load_network(tmp_path / "checkpoints/best")[1]["step"] == 30  # what `dope eval` does with it
    assert best_score(tmp_path, before=31) == 0.6
    assert best_score(tmp_path, before=30) == float("-inf")  # gone back: the run comes by it again
    find_checkpoint(tmp_path / "checkpoints/best").unlink()
    with pytest.raises(BadInput, match="best: names a checkpoint that is not there"):
        find_checkpoint(tmp_path / "checkpoints/best")


def test_a_pointer_protects_what_it_names_whatever_the_policy(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, at(1), method_of(keeping(keep_best=True)), "shards", best=0.5)
    for step in (2, 3):
        save_checkpoint(tmp_path, at(step), method_of(keeping(keep=1)), "shards")
    assert steps_of(tmp_path) == [1, 3]


class Crash(BaseException):
    """The machine goes down: nothing runs any more, no `finally` either."""


@pytest.mark.parametrize("step", [2, 7])
def test_a_crash_at_any_moment_leaves_a_checkpoint_that_can_be_gone_on_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """Over an earlier checkpoint of the same step, and beside an older one that is then deleted."""
    policy, crashes = keeping(keep=1, keep_best=True), 0
    changes = {name: getattr(Path, name) for name in ("replace", "unlink")}
    first, back = trained(), new_state(method_of(CONFIG), ALONE)
    save_checkpoint(tmp_path / "before", first, method_of(CONFIG), "shards", best=0.1)
    state = replace(first, step=step, place=Place(3, 0))
    while True:
        run, done = Path(shutil.copytree(tmp_path / "before", tmp_path / str(crashes))), 0

        def crashing(name: str) -> Callable[..., Any]:
            def change(path: Path, *arguments: Any, **options: Any) -> Any:
                nonlocal done
                done += 1
                if done > crashes:  # noqa: B023
                    raise Crash
                return changes[name](path, *arguments, **options)

            return change

        with monkeypatch.context() as patch:
            for name in changes:
                patch.setattr(Path, name, crashing(name))
            try:
                save_checkpoint(run, state, method_of(policy), "shards", best=0.2)
                crashed = False
            except Crash:
                crashed = True
        found, damaged = resume_newest(run, back, method_of(CONFIG), "shards")
        assert found is not None and not damaged
        assert (back.step, back.place) in ((2, Place(1, 32)), (step, Place(3, 0)))
        assert read_checkpoint(run / "checkpoints/best")["step"] in (2, step)
        if not crashed:
            break
        crashes += 1
    assert crashes >= 8 and steps_of(run) == [step] and back.place == Place(3, 0)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_a_full_disk_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def full(path: Path) -> Iterator[Path]:
        with files.explaining_full_disk(path):
            yield Path("/dev/full")

    monkeypatch.setattr(files, "atomic_path", full)
    with pytest.raises(DiskFull, match=r"step-00000000\.pt: no space left"):
        save_checkpoint(tmp_path, trained(steps=0), method_of(CONFIG), "shards")


def test_a_crash_while_writing_leaves_the_one_before(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def half(values: object, file: IO[bytes]) -> None:
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", half)
    state = trained(steps=0)
    state.step = 7
    with pytest.raises(Exception, match="no space left"):
        save_checkpoint(run, state, method_of(CONFIG), "shards")
    assert [path.name for path in list_checkpoints(run)] == ["step-00000002.pt"]
    assert read_checkpoint(run)["step"] == 2


def test_every_checkpoint_has_the_settings_and_their_hash(run: Path) -> None:
    values = read_checkpoint(run)
    assert settings.from_mapping(TrainConfig, values["config"]) == CONFIG
    assert values["config_hash"] == settings.config_hash(CONFIG)


ON_A_FULL_DISK = """
import pathlib, shutil, sys
from test_checkpoints import CONFIG, DiskFull, at, method_of, read_checkpoint, save_checkpoint
run = pathlib.Path(sys.argv[1]) / "run"
size = save_checkpoint(run, at(1), method_of(CONFIG), "shards").stat().st_size
for room in (0, 8192, size // 4, size // 2, size - 4096):  # it is full in the midst of this or that part of the file
    (run / "else").unlink(missing_ok=True)
    (run / "else").write_bytes(bytes(shutil.disk_usage(run).free - room))
    try:
        save_checkpoint(run, at(2), method_of(CONFIG), "shards")
    except DiskFull as error:
        print(error)
    print(read_checkpoint(run)["step"], sorted(path.name for path in (run / "checkpoints").iterdir()))
"""


def test_a_disk_that_is_really_full_keeps_the_checkpoint_before(tmp_path: Path) -> None:
    mount = 'mount -t tmpfs -o size=16m none "$1"'
    command = ["unshare", "--mount", "--map-root-user", "sh", "-euc"]
    path = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[2])])
    environment = {**os.environ, "PYTHONPATH": path}
    try:
        allowed = subprocess.run([*command, mount, "sh", tmp_path], capture_output=True).returncode == 0
    except FileNotFoundError:
        allowed = False
    if not allowed:
        pytest.skip("mounting a file system of its own is not allowed here")
    script = f'{mount}; "$2" -c "$3" "$1"'
    answer = subprocess.run(
        [*command, script, "sh", tmp_path, sys.executable, ON_A_FULL_DISK],
        capture_output=True, text=True, env=environment,
    )  # fmt: skip
    assert answer.returncode == 0, answer.stderr
    lines = answer.stdout.splitlines()
    assert len(lines) == 10
    for said, left in zip(lines[::2], lines[1::2], strict=True):
        assert "step-00000002.pt: no space left on the disk; nothing that was there before is lost" in said
        assert left == "1 ['latest', 'step-00000001.pt', 'step-00000001.pt.sha256']"


def test_no_checkpoint_there(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="holds no checkpoint"):
        find_checkpoint(tmp_path)
    with pytest.raises(BadInput, match="no such file"):
        load_network(tmp_path / "none.pt")


def test_other_settings_are_refused_and_all_named(run: Path) -> None:
    other = replace(CONFIG, momentum=0.5, data=replace(CONFIG.data, batch_size=4, workers=7))
    with pytest.raises(UsageError) as caught:
        resume(run, new_state(method_of(other), ALONE), method_of(other), "shards")
    message = str(caught.value)
    assert "momentum is 0.5, was 0.99" in message and f"data.batch_size is 4, was {CONFIG.data.batch_size}" in message
    assert "workers" not in message and "--out" in message


def test_settings_that_do_not_change_the_result_may_differ(run: Path) -> None:
    other = replace(CONFIG, log=LogConfig(every=99, pictures=0), data=replace(CONFIG.data, workers=7))
    resume(run, new_state(method_of(other), ALONE), method_of(other), "shards")


def test_a_setting_younger_than_the_checkpoint_had_its_defaults_effect(run: Path) -> None:
    path = find_checkpoint(run)
    values = torch.load(path, weights_only=True)
    del values["config"]["data"]["order"]
    torch.save(values, path)
    Path(f"{path}.sha256").unlink()
    resume(run, new_state(method_of(CONFIG), ALONE), method_of(CONFIG), "shards")
    other = replace(CONFIG, data=replace(CONFIG.data, order="sequential"))
    with pytest.raises(UsageError, match=r"data\.order is sequential, was shuffled"):
        resume(run, new_state(method_of(other), ALONE), method_of(other), "shards")


def test_other_shards_are_refused(run: Path) -> None:
    with pytest.raises(UsageError, match="other shards"):
        resume(run, new_state(method_of(CONFIG), ALONE), method_of(CONFIG), "others")


def goes_on(how: str | Path, run: Path) -> int:
    """As a run does: from where, and a note of it. Returns the step."""
    state = new_state(method_of(CONFIG), ALONE)
    found, _ = go_on_from(how, run, state, method_of(CONFIG), "shards")
    note_origin(how, run, found)
    return state.step


def test_a_requeued_job_that_names_a_checkpoint_of_another_run_goes_on_where_it_was(tmp_path: Path) -> None:
    given = save_checkpoint(tmp_path / "old", at(3), method_of(CONFIG), "shards")
    run = tmp_path / "run"
    assert [goes_on(given, run), goes_on(given, run)] == [3, 3]  # killed before it wrote one of its own
    save_checkpoint(run, at(5), method_of(CONFIG), "shards")
    given.unlink()
    assert [goes_on(given, run), goes_on("auto", run)] == [5, 5]
    other = save_checkpoint(tmp_path / "other", at(9), method_of(CONFIG), "shards")
    with pytest.raises(UsageError, match=r"already holds a run \(step-00000005\.pt\)"):
        goes_on(other, run)


def test_going_back_within_a_run_lasts(tmp_path: Path) -> None:
    early, _ = (save_checkpoint(tmp_path, at(step), method_of(keeping(keep=0)), "shards") for step in (2, 8))
    assert goes_on(early, tmp_path) == 2
    assert [goes_on("auto", tmp_path), goes_on(early, tmp_path)] == [2, 2]  # killed before its first own one
    save_checkpoint(tmp_path, at(4), method_of(keeping(keep=0)), "shards")
    assert [goes_on("auto", tmp_path), goes_on(early, tmp_path)] == [4, 4]
    (tmp_path / "checkpoints/origin").unlink()
    assert goes_on(early, tmp_path) == 2


def test_a_restart_goes_on_in_the_new_folder_it_insisted_on_but_not_in_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "one")
    assert goes_on("never", tmp_path) == 0
    save_checkpoint(tmp_path, at(4), method_of(CONFIG), "shards")
    with pytest.raises(UsageError, match="already holds a run"):
        goes_on("never", tmp_path)
    monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", "1")
    assert goes_on("never", tmp_path) == 4
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "two")  # torchrun starts again what was refused at first
    with pytest.raises(UsageError, match="already holds a run"):
        goes_on("never", tmp_path)
