"""Checkpoints of a run: whole or absent, checked when read, resumed only under the settings they were made with.

    RUN/checkpoints/
      step-00001200.pt          network, momentum network, optimiser, place in the order, settings, versions
      step-00001200.pt.sha256   its hash, as `sha256sum -c` reads it
      latest                    the name of the newest one, written last

Nothing random is stored: every random number derives from (seed, step, rank).
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

import dope
from dope.common import files, settings
from dope.common.errors import BadInput, UsageError
from dope.config import TrainConfig, differing_keys
from dope.networks import DopeNetwork, NetworkConfig
from dope.order import Place
from dope.state import TrainState

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = 1
LATEST = "latest"


def save_checkpoint(run: Path, state: TrainState, config: TrainConfig, dataset: str, keep: int = 0) -> Path:
    """Write RUN/checkpoints/step-XXXXXXXX.pt, its hash and the pointer; delete old ones beyond `keep` (0 keeps all).

    Those of later steps, which a run that went on from an earlier checkpoint finds there, neither count nor go.

    Args:
        dataset: fingerprint of the training shards.
    """
    path = run / "checkpoints" / f"step-{state.step:08d}.pt"
    values = {
        "format": FORMAT,
        "step": state.step,
        "epoch": state.place.epoch,
        "samples_consumed": state.place.consumed,
        "network": state.network.state_dict(),
        "momentum": state.momentum.network.state_dict(),
        "optimiser": state.optimiser.state_dict(),
        "config": settings.to_dict(config),
        "config_hash": settings.config_hash(config),
        "dataset": dataset,
        "validation": state.validation,
        "untrained": state.untrained,
        "damaged": sorted(state.damaged),
        "versions": {"dope": dope.__version__, "torch": str(torch.__version__)},
    }
    with files.atomic_path(path) as partial:
        with partial.open("wb") as file:  # given a path, torch's own writer hides that the disk is full
            torch.save(values, file)
        digest = files.sha256_of(partial)
    files.write_bytes(_hash_path(path), f"{digest}  {path.name}\n".encode())
    files.write_bytes(path.parent / LATEST, f"{path.name}\n".encode())
    if keep:
        until_now = [other for other in list_checkpoints(run) if other.name <= path.name]
        for old in until_now[:-keep]:
            old.unlink()
            _hash_path(old).unlink(missing_ok=True)
    return path


def list_checkpoints(run: Path) -> list[Path]:
    """The checkpoints of a run, oldest first."""
    return sorted((run / "checkpoints").glob("step-*.pt"))


def latest_checkpoint(run: Path) -> Path | None:
    """The newest whole checkpoint of a run, or None where there is none."""
    pointer = run / "checkpoints" / LATEST
    if pointer.is_file():
        path = pointer.parent / pointer.read_text().strip()
        if path.is_file():
            return path
    known = list_checkpoints(run)
    return known[-1] if known else None


def find_checkpoint(path: Path) -> Path:
    """The checkpoint that a user means by a file or by a run's folder. Raises `BadInput` where there is none."""
    if path.is_file():
        return path
    found = latest_checkpoint(path) if path.is_dir() else None
    if found is None:
        what = "holds no checkpoint" if path.is_dir() else "no such file or folder"
        raise BadInput(what, where=path, remedy="Give a folder that `dope train --out` wrote, or one of its *.pt files")
    return found


def read_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint without running any code it might hold.

    Raises:
        BadInput: unreadable, cut off, damaged since it was written, or no checkpoint of this package.
    """
    path = find_checkpoint(path)
    others = [other.name for other in list_checkpoints(path.parent.parent) if other != path]
    remedy = f"Give another one, e.g. {path.parent / others[-1]}" if others else "Copy it again, or train again"
    recorded = _hash_path(path)
    if recorded.is_file() and recorded.read_text().split(maxsplit=1)[:1] != [files.sha256_of(path)]:
        raise BadInput(f"is damaged: its SHA-256 is not the one in {recorded.name}", where=path, remedy=remedy)
    try:
        values = torch.load(path, map_location=device, weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, OSError, ValueError, KeyError) as error:
        reason = str(error).split("\n", 1)[0]
        raise BadInput(f"cannot be read as a checkpoint ({reason})", where=path, remedy=remedy) from error
    if not isinstance(values, dict) or "network" not in values or values.get("format") != FORMAT:
        raise BadInput("is no checkpoint of this version of dope", where=path, remedy=remedy)
    return values


def resume(path: Path, state: TrainState, config: TrainConfig, dataset: str) -> None:
    """Put `state` where the checkpoint was.

    Raises:
        BadInput: the checkpoint cannot be read.
        UsageError: it was made with other settings (all that differ are named) or from other shards.
    """
    values = read_checkpoint(path, next(state.network.parameters()).device)
    differing = differing_keys(settings.to_dict(config), values["config"])
    if differing:
        keys = "; ".join(f"{key} is {ours}, was {theirs}" for key, (ours, theirs) in differing.items())
        raise UsageError(
            f"was made with other settings: {keys}",
            where=path,
            remedy=f"Go on with the old values (--set {next(iter(differing))}=...), or train anew into another --out",
        )
    if values["dataset"] != dataset:
        raise UsageError(
            f"was trained on other shards (fingerprint {values['dataset']}, these have {dataset})",
            where=path,
            remedy="Go on with the same shards, or train anew into another --out",
        )
    state.network.load_state_dict(values["network"])
    state.momentum.network.load_state_dict(values["momentum"])
    state.optimiser.load_state_dict(values["optimiser"])
    state.step, state.place = values["step"], Place(values["epoch"], values["samples_consumed"])
    state.validation, state.untrained = values["validation"], values["untrained"]
    state.damaged = set(values.get("damaged", ()))


def load_network(path: Path, device: torch.device | str = "cpu") -> tuple[DopeNetwork, dict[str, Any]]:
    """The trained network of a checkpoint (or of a run's newest one), in eval mode, and what is known of it.

    The second value has `path`, `sha256`, `step`, `epoch`, `config` (plain nested dict), `config_hash`, `dataset`,
    `validation` and `versions`.

    Raises:
        BadInput: no checkpoint there, or it cannot be read.
    """
    path = find_checkpoint(path)
    values = read_checkpoint(path, device)
    network = DopeNetwork(settings.from_mapping(NetworkConfig, values["config"]["network"], where=str(path)))
    weights: dict[str, Tensor] = values["network"]
    network.load_state_dict(weights)
    meta = {k: values[k] for k in ("step", "epoch", "config", "config_hash", "dataset", "validation", "versions")}
    return network.to(device).eval(), {"path": str(path), "sha256": files.sha256_of(path), **meta}


def _hash_path(path: Path) -> Path:
    return path.with_name(path.name + ".sha256")
