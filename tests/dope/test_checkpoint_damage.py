"""Checkpoints that are damaged, hold code, or only look like one."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch

from dope import checkpoints
from dope.checkpoints import (
    list_checkpoints,
    load_network,
    read_checkpoint,
    resume,
    resume_newest,
    save_checkpoint,
)
from dope.common import files
from dope.common.errors import BadInput, UsageError
from dope.methods import method_of
from dope.state import new_state
from tests.dope.tiny_checkpoints import ALONE, CONFIG, at, keeping, trained


@pytest.fixture
def run(tmp_path: Path) -> Path:
    save_checkpoint(tmp_path, trained(), method_of(CONFIG), "shards")
    return tmp_path


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


class Malicious:
    """Runs a command when it is unpickled, in the folder of whoever does that."""

    def __reduce__(self) -> tuple[object, ...]:
        return os.system, ("touch was-run",)


def code(path: Path) -> None:
    path.write_bytes(pickle.dumps({"network": Malicious()}, protocol=2))


def code_in_a_whole_checkpoint(path: Path) -> None:
    torch.save({**torch.load(path, weights_only=True), "validation": Malicious()}, path)


def other_dict(path: Path) -> None:
    torch.save({"weights": 1}, path)


DAMAGES = (truncate, empty, text, code, code_in_a_whole_checkpoint, other_dict)


# one flipped byte of a weight can only be found by the hash
@pytest.mark.parametrize(
    ("damage", "with_hash"),
    [(flip, True), *((d, with_hash) for d in DAMAGES for with_hash in (True, False))],
)
def test_damage_is_an_error_that_names_the_file_and_another_checkpoint(
    run: Path, damage: Callable[[Path], None], with_hash: bool
) -> None:
    path = save_checkpoint(run, at(9), method_of(CONFIG), "shards")
    damage(path)
    if not with_hash:
        path.with_name(path.name + ".sha256").unlink()
    with pytest.raises(BadInput, match=r"step-00000009\.pt: .*step-00000002\.pt"):
        load_network(run)


@pytest.mark.parametrize("with_code", [code, code_in_a_whole_checkpoint])
def test_code_in_a_checkpoint_is_never_run(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_code: Callable[[Path], None]
) -> None:
    monkeypatch.chdir(tmp_path)
    (path,) = list_checkpoints(run)
    with_code(path)
    path.with_name(path.name + ".sha256").write_text(f"{files.sha256_of(path)}  {path.name}\n")  # a careful attacker
    with pytest.raises(BadInput, match="code, which is never run"):
        read_checkpoint(path)
    assert not Path("was-run").exists()
    with suppress(RuntimeError):  # the bare pickle turns out to be no checkpoint, but only once it has run
        torch.load(path, weights_only=False)
    assert Path("was-run").exists(), "it would have run"


def test_another_format_is_refused_with_what_to_do(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_checkpoint(run, at(9), method_of(CONFIG), "shards")
    monkeypatch.setattr(checkpoints, "FORMAT", checkpoints.FORMAT + 1)
    message = rf"step-00000009\.pt: was written by dope {checkpoints.dope.__version__} in format 1; .*Use that version"
    for read in (read_checkpoint, load_network):
        with pytest.raises(UsageError, match=message):
            read(run)
    with pytest.raises(UsageError, match="in format 1"):  # nor is an older one taken in its place
        resume_newest(run, new_state(method_of(CONFIG), ALONE), method_of(CONFIG), "shards")


@pytest.mark.parametrize("damage", [flip, truncate, empty])
def test_going_on_passes_over_damaged_checkpoints(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    paths = [save_checkpoint(tmp_path, at(step), method_of(keeping(keep=0)), "shards") for step in (3, 6, 9)]
    for path in paths[1:]:
        damage(path)
    state = new_state(method_of(CONFIG), ALONE)
    found, damaged = resume_newest(tmp_path, state, method_of(CONFIG), "shards")
    assert found == paths[0] and state.step == 3
    assert [error.where for error in damaged] == [str(paths[2]), str(paths[1])]
    damage(paths[0])
    with pytest.raises(BadInput, match=r"step-00000009\.pt: .*no older one can be read either"):
        resume_newest(tmp_path, state, method_of(CONFIG), "shards")


def parts(*without: str, **other: Any) -> Callable[[Path], None]:
    """Writes a checkpoint without some of its parts, and others changed."""

    def damage(path: Path) -> None:
        values = {**torch.load(path, weights_only=True), **other}
        torch.save({name: value for name, value in values.items() if name not in without}, path)
        path.with_name(path.name + ".sha256").unlink()

    return damage


def hash_that_is_no_text(path: Path) -> None:
    path.with_name(path.name + ".sha256").write_bytes(b"\xff\xfe\x80")


@pytest.mark.parametrize(
    ("damage", "what"),
    [
        (hash_that_is_no_text, "is damaged: its SHA-256 is not the one in"),
        (parts("config", "momentum"), "lacks momentum, config"),
        (parts(config=[1]), "has settings that are none"),
        (parts(network={}), "does not fit the network of its settings"),
        (parts(optimiser={"state": {}, "param_groups": []}), "does not fit the network"),
        (parts(format=2, versions=[]), "was written by dope unknown in format 2"),
    ],
)
def test_what_only_looks_like_a_checkpoint_is_explained(run: Path, damage: Callable[[Path], None], what: str) -> None:
    (path,) = list_checkpoints(run)
    damage(path)
    with pytest.raises((BadInput, UsageError), match=rf"step-00000002\.pt: {what}"):
        resume(run, new_state(method_of(CONFIG), ALONE), method_of(CONFIG), "shards")
