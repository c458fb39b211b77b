import os
import pickle
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO

import pytest
import torch

from dope.checkpoints import (
    find_checkpoint,
    latest_checkpoint,
    list_checkpoints,
    load_network,
    read_checkpoint,
    resume,
    save_checkpoint,
)
from dope.common import files
from dope.common.errors import BadInput, DiskFull, UsageError
from dope.config import TrainConfig, load_config
from dope.distributed import Ranks
from dope.order import Place
from dope.state import TrainState, new_state

SMALL = ["network.width=0.125", "network.pyramid=8", "network.projector=[8, 4]", "data.image_size=32"]
CONFIG = load_config("nano", None, SMALL)
ALONE = Ranks(0, 1, torch.device("cpu"))


def trained(config: TrainConfig = CONFIG, steps: int = 2) -> TrainState:
    state = new_state(config, ALONE)
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        images = torch.rand(2, 3, 32, 32, generator=generator)
        state.network.descriptors(images).square().sum().backward()
        state.optimiser.step()
        state.momentum.update(state.network)
        state.step += 1
    state.place = Place(1, 32)
    state.validation = {"pck": 0.5}
    return state


@pytest.fixture
def run(tmp_path: Path) -> Path:
    save_checkpoint(tmp_path, trained(), CONFIG, "shards")
    return tmp_path


def test_everything_comes_back(run: Path) -> None:
    before, state = trained(), new_state(CONFIG, ALONE)
    resume(run, state, CONFIG, "shards")
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
    state = trained(steps=0)
    for state.step in (5, 10, 15, 20):
        save_checkpoint(tmp_path, state, CONFIG, "shards", keep=2)
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    stems = ["step-00000015.pt", "step-00000020.pt"]
    assert names == sorted(["latest", *stems, *(stem + ".sha256" for stem in stems)])
    assert latest_checkpoint(tmp_path) == tmp_path / "checkpoints" / stems[1]


def test_going_on_from_an_earlier_checkpoint_deletes_neither_the_new_nor_the_later_ones(tmp_path: Path) -> None:
    for step in (2, 8, 9, 3):  # 3 after 9: a run that went back to an earlier place
        save_checkpoint(tmp_path, replace(trained(steps=0), step=step), CONFIG, "shards", keep=1)
    assert [path.name for path in list_checkpoints(tmp_path)] == ["step-00000003.pt", "step-00000009.pt"]
    assert latest_checkpoint(tmp_path) == tmp_path / "checkpoints" / "step-00000003.pt"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_a_full_disk_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def full(path: Path) -> Iterator[Path]:
        with files.explaining_full_disk(path):
            yield Path("/dev/full")

    monkeypatch.setattr(files, "atomic_path", full)
    with pytest.raises(DiskFull, match=r"step-00000000\.pt: no space left"):
        save_checkpoint(tmp_path, trained(steps=0), CONFIG, "shards")


def test_a_crash_while_writing_leaves_the_one_before(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def half(values: object, file: IO[bytes]) -> None:
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", half)
    state = trained(steps=0)
    state.step = 7
    with pytest.raises(Exception, match="no space left"):
        save_checkpoint(run, state, CONFIG, "shards")
    assert [path.name for path in list_checkpoints(run)] == ["step-00000002.pt"]
    assert read_checkpoint(run)["step"] == 2


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def text(path: Path) -> None:
    path.write_text("not a checkpoint")


def code(path: Path) -> None:
    path.write_bytes(pickle.dumps({"network": subprocess.Popen}, protocol=2))


def other_dict(path: Path) -> None:
    torch.save({"weights": 1}, path)


# one flipped byte of a weight can only be found by the hash
@pytest.mark.parametrize(
    ("damage", "with_hash"),
    [(flip, True), *((d, with_hash) for d in (truncate, empty, text, code, other_dict) for with_hash in (True, False))],
)
def test_damage_is_an_error_that_names_the_file_and_another_checkpoint(
    run: Path, damage: Callable[[Path], None], with_hash: bool
) -> None:
    state = trained(steps=0)
    state.step = 9
    path = save_checkpoint(run, state, CONFIG, "shards")
    damage(path)
    if not with_hash:
        path.with_name(path.name + ".sha256").unlink()
    with pytest.raises(BadInput, match=r"step-00000009\.pt: .*step-00000002\.pt"):
        load_network(run)


def test_no_checkpoint_there(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="holds no checkpoint"):
        find_checkpoint(tmp_path)
    with pytest.raises(BadInput, match="no such file"):
        load_network(tmp_path / "none.pt")


def test_other_settings_are_refused_and_all_named(run: Path) -> None:
    other = replace(CONFIG, momentum=0.5, data=replace(CONFIG.data, batch_size=4, workers=7))
    with pytest.raises(UsageError) as caught:
        resume(run, new_state(other, ALONE), other, "shards")
    message = str(caught.value)
    assert "momentum is 0.5, was 0.99" in message and f"data.batch_size is 4, was {CONFIG.data.batch_size}" in message
    assert "workers" not in message and "--out" in message


def test_settings_that_do_not_change_the_result_may_differ(run: Path) -> None:
    other = replace(CONFIG, log_every=99, data=replace(CONFIG.data, workers=7))
    resume(run, new_state(other, ALONE), other, "shards")


def test_other_shards_are_refused(run: Path) -> None:
    with pytest.raises(UsageError, match="other shards"):
        resume(run, new_state(CONFIG, ALONE), CONFIG, "others")
