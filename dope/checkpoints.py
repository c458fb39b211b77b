"""Checkpoints of a run: whole or absent, checked when read, resumed only under the settings they were made with.

    RUN/checkpoints/
      step-00001200.pt          network, momentum network, optimiser, place in the order, settings, versions
      step-00001200.pt.sha256   its hash, as `sha256sum -c` reads it
      latest                    the name of the newest one
      best                      with checkpoint.keep_best: the name of the one with the best PCK, and that PCK
      origin                    what `--resume` named where it was not auto: the same command goes on, it does not begin
                                there again (deleted, it does)

Nothing random is stored: every random number derives from (seed, step). Files are written in this order and only
then are old ones deleted, so that a crash at any moment leaves a checkpoint that `latest` or the list of files finds.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch
from torch import nn

import dope
from dope.common import files, settings
from dope.common.errors import BadInput, UsageError
from dope.config import CheckpointConfig, TrainConfig, differing_keys
from dope.distributed import restarts, started_by
from dope.methods import method_class
from dope.methods.base import Method
from dope.networks import DopeNetwork
from dope.order import Place
from dope.preset_files import merged
from dope.state import TrainState

FORMAT = 1
LATEST, BEST, ORIGIN = "latest", "best", "origin"
PARTS = (
    "step", "epoch", "samples_consumed", "network", "momentum", "optimiser", "config", "config_hash", "dataset",
    "validation", "untrained", "versions",
)  # fmt: skip
"""What a checkpoint of this format has; `damaged` and `facts` came later."""


def save_checkpoint(run: Path, state: TrainState, method: Method, dataset: str, *, best: float | None = None) -> Path:
    """Write RUN/checkpoints/step-XXXXXXXX.pt, its hash and the pointers; delete what `config.checkpoint` lets go.

    Args:
        dataset: fingerprint of the training shards.
        best: the score of this very step, where it is the best so far; the pointer `best` then points here.

    Raises:
        DiskFull: the checkpoints that were there before are untouched.
    """
    config, path = method.config, run / "checkpoints" / f"step-{state.step:08d}.pt"
    values = {
        "format": FORMAT,
        "step": state.step,
        "epoch": state.place.epoch,
        "samples_consumed": state.place.consumed,
        "network": state.network.state_dict(),
        "momentum": method.companion_state(state.momentum),
        "optimiser": state.optimiser.state_dict(),
        "config": settings.to_dict(config),
        "config_hash": settings.config_hash(config),
        "dataset": dataset,
        "validation": state.validation,
        "untrained": state.untrained,
        "damaged": sorted(state.damaged),
        "facts": state.facts,
        "versions": {"dope": dope.__version__, "torch": str(torch.__version__)},
    }
    with files.atomic_path(path) as partial:
        with partial.open("wb") as file:  # given a path, torch's own writer hides that the disk is full
            try:
                torch.save(values, file)
            except RuntimeError as error:  # here as well: it fails once more when it closes what it could not write
                raise error.__context__ if isinstance(error.__context__, OSError) else error from None
        digest = files.sha256_of(partial)
        # of a checkpoint that this one replaces: after a crash before the next line it would belie a whole file
        _hash_path(path).unlink(missing_ok=True)
    files.write_bytes(_hash_path(path), f"{digest}  {path.name}\n".encode())
    files.write_bytes(path.parent / LATEST, f"{path.name}\n".encode())
    if best is not None:
        files.write_bytes(path.parent / BEST, f"{path.name} {best}\n".encode())
    for old in _superfluous(run, state.step, config.checkpoint):
        _hash_path(old).unlink(missing_ok=True)
        old.unlink(missing_ok=True)
    return path


def _superfluous(run: Path, step: int, policy: CheckpointConfig) -> list[Path]:
    """What goes: neither among the newest, nor a multiple of `keep_every`, nor pointed to, nor of a later step.

    Later ones are found there by a run that went on from an earlier checkpoint.
    """
    if not policy.keep:
        return []
    pointed = {pointed_to(run, LATEST), pointed_to(run, BEST)}
    until_now = [path for path in list_checkpoints(run) if _step_of(path) <= step]
    return [
        path
        for path in until_now[: -policy.keep]
        if path not in pointed and not (policy.keep_every and _step_of(path) % policy.keep_every == 0)
    ]


def list_checkpoints(run: Path) -> list[Path]:
    """The checkpoints of a run, oldest first."""
    return sorted((run / "checkpoints").glob("step-" + "[0-9]" * 8 + ".pt"))


def pointed_to(run: Path, pointer: str) -> Path | None:
    """The checkpoint that RUN/checkpoints/latest or best names, or None where there is no such file."""
    file = run / "checkpoints" / pointer
    words = file.read_text(errors="replace").split() if file.is_file() else []
    path = file.parent / words[0] if words else None
    return path if path and path.is_file() else None


def best_score(run: Path, *, before: int) -> float:
    """The score of the best checkpoint; minus infinity where there is none from before step `before`.

    A run that goes on from an earlier checkpoint comes by its later ones again.
    """
    path = pointed_to(run, BEST)
    if path is None or _step_of(path) >= before:
        return float("-inf")
    try:
        return float((run / "checkpoints" / BEST).read_text().split()[1])
    except (IndexError, ValueError):  # written by hand
        return float("-inf")


def latest_checkpoint(run: Path) -> Path | None:
    """The newest checkpoint of a run, or None where there is none."""
    known = list_checkpoints(run)
    return pointed_to(run, LATEST) or (known[-1] if known else None)


def find_checkpoint(path: Path) -> Path:
    """The checkpoint that a user means by a file (also `latest` or `best`) or by a run's folder.

    Raises:
        BadInput: there is none.
    """
    found = latest_checkpoint(path) if path.is_dir() else None
    if path.is_file():
        found = pointed_to(path.parent.parent, path.name) if path.name in (LATEST, BEST) else path
    if found is None:
        what = "no such file or folder"
        if path.is_dir():
            what = "holds no checkpoint"
        elif path.is_file():
            what = "names a checkpoint that is not there"
        raise BadInput(what, where=path, remedy="Give a folder that `dope train --out` wrote, or one of its *.pt files")
    return found


def read_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint without running any code it might hold.

    Raises:
        BadInput: unreadable, cut off, damaged since it was written, with code in it, or no checkpoint of this package.
        UsageError: of another version of this package.
    """
    path = find_checkpoint(path)
    others = [other for other in list_checkpoints(path.parent.parent) if other != path]
    older = [other for other in others if other.name < path.name]
    remedy = f"Give another one, e.g. {(older or others)[-1]}" if others else "Copy it again, or train again"
    recorded = _hash_path(path)
    try:
        # bytes: a damaged one need not be text
        if recorded.is_file() and recorded.read_bytes().split()[:1] != [files.sha256_of(path).encode()]:
            raise BadInput(f"is damaged: its SHA-256 is not the one in {recorded.name}", where=path, remedy=remedy)
        values = torch.load(path, map_location=device, weights_only=True)
    except pickle.UnpicklingError as error:
        what = "holds something other than tensors and plain values: damage, or code, which is never run"
        raise BadInput(what, where=path, remedy=remedy) from error
    except (RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        reason = str(error).split("\n", 1)[0]
        raise BadInput(f"cannot be read as a checkpoint ({reason})", where=path, remedy=remedy) from error
    if not isinstance(values, dict) or "network" not in values or "format" not in values:
        raise BadInput("is no checkpoint of dope", where=path, remedy=remedy)
    if values["format"] != FORMAT:
        versions = values.get("versions")
        version = versions.get("dope", "unknown") if isinstance(versions, dict) else "unknown"
        raise UsageError(
            f"was written by dope {version} in format {values['format']}; this one reads format {FORMAT}",
            where=path,
            remedy="Use that version of dope for this run, or train anew into another --out",
        )
    missing = [part for part in PARTS if part not in values]
    if missing or not isinstance(values["config"], dict):
        what = f"lacks {', '.join(missing)}" if missing else "has settings that are none"
        raise BadInput(what, where=path, remedy=remedy)
    return values


def resume(path: Path, state: TrainState, method: Method, dataset: str) -> None:
    """Put `state` where the checkpoint was.

    Raises:
        BadInput: the checkpoint cannot be read.
        UsageError: it was made with other settings (all that differ are named) or from other shards.
    """
    path = find_checkpoint(path)
    values = read_checkpoint(path, next(state.network.parameters()).device)
    # a setting younger than the checkpoint had its default's effect then
    then = merged(settings.to_dict(TrainConfig()), values["config"])
    differing = differing_keys(settings.to_dict(method.config), then)
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
    try:
        state.network.load_state_dict(values["network"])
        method.load_companion(state.momentum, values["momentum"])
        state.optimiser.load_state_dict(values["optimiser"])
    except (RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = str(error).split("\n", 1)[0]
        remedy = "Give another one, or train anew into another --out"
        raise BadInput(f"does not fit the network of its settings ({reason})", where=path, remedy=remedy) from error
    state.step, state.place = values["step"], Place(values["epoch"], values["samples_consumed"])
    state.validation, state.untrained = values["validation"], values["untrained"]
    state.damaged = set(values.get("damaged", ()))
    state.facts = values.get("facts", state.facts)


def resume_newest(run: Path, state: TrainState, method: Method, dataset: str) -> tuple[Path | None, list[BadInput]]:
    """Put `state` where the newest checkpoint of a run that can be read was; damaged ones are passed over.

    Returns:
        The checkpoint, or None where the run has none at all; and what was wrong with those passed over.

    Raises:
        BadInput: there are checkpoints, and all of them are damaged.
        UsageError: as `resume`.
    """
    newest = latest_checkpoint(run)
    if newest is None:
        return None, []
    damaged: list[BadInput] = []
    for path in reversed([path for path in list_checkpoints(run) if path.name <= newest.name]):
        try:
            resume(path, state, method, dataset)
        except BadInput as error:
            damaged.append(error)
        else:
            return path, damaged
    what = f"{damaged[0].what}; no older one can be read either"
    raise BadInput(what, where=newest, remedy="Copy the run again, or train anew into another --out")


def go_on_from(
    how: str | Path, out: Path, state: TrainState, method: Method, dataset: str
) -> tuple[Path | None, list[BadInput]]:
    """Put `state` where the `how` of `dope train --resume` says: auto, never, or a checkpoint or run.

    A command that names a checkpoint and is given again (a requeued job, ranks that are started anew) goes on from the
    newest one that it has made since, see `note_origin`.

    Returns:
        The checkpoint, or None where the run begins; and what was wrong with newer ones.

    Raises:
        BadInput: no such checkpoint, or it (where the run goes on, every one of it) is damaged.
        UsageError: as `resume`; or `never` or a checkpoint of another run, and `out` holds a run.
    """
    newest = latest_checkpoint(out)
    if how == "auto" or (newest is not None and _began_like_this(how, out)):
        return resume_newest(out, state, method, dataset)
    found = None if how == "never" else find_checkpoint(Path(how))
    if newest is not None and (found is None or not _is_of(found, out)):
        raise UsageError(
            f"already holds a run ({newest.name})",
            where=out,
            remedy="Give another --out, delete this folder, or go on with --resume auto",
        )
    if found is not None:
        resume(found, state, method, dataset)
    return found, []


def note_origin(how: str | Path, out: Path, found: Path | None) -> None:
    """Write down that `out` begins, by `--resume how`, at the checkpoint `found`; nothing to note for `auto`.

    Where it goes back to an earlier checkpoint of its own, that one is its newest from now on.
    """
    if how == "auto" or _began_like_this(how, out):
        return
    if found is not None and _is_of(found, out):
        files.write_bytes(out / "checkpoints" / LATEST, f"{found.name}\n".encode())
    files.write_bytes(out / "checkpoints" / ORIGIN, f"{_origin(how)}\n".encode())


def _origin(how: str | Path) -> str:
    return f"never, {started_by()}" if how == "never" else str(Path(how).resolve())


def _began_like_this(how: str | Path, out: Path) -> bool:
    """Whether `out` was begun by this very command; one that insists on a new folder is the same only in a restart."""
    file = out / "checkpoints" / ORIGIN
    noted = file.read_text(errors="replace").rstrip("\n") if file.is_file() else None
    return noted == _origin(how) and (how != "never" or restarts() > 0)


def _is_of(checkpoint: Path, run: Path) -> bool:
    return checkpoint.parent.resolve() == (run / "checkpoints").resolve()


def load_network(path: Path, device: torch.device | str = "cpu") -> tuple[DopeNetwork, dict[str, Any]]:
    """The trained DOPE network of a checkpoint (or of a run's newest one), in eval mode, and what is known of it.

    The second value is that of `load_method`.

    Raises:
        BadInput: no checkpoint there, or it cannot be read.
        UsageError: of another method, whose network describes whole images only.
    """
    method, network, meta = load_method(path, device)
    if not isinstance(network, DopeNetwork):
        what = f"is of method {method.name}, which has no dense descriptors"
        raise UsageError(what, where=meta["path"], remedy="Give a checkpoint of `dope train --method dope`")
    return network, meta


def load_method(path: Path, device: torch.device | str = "cpu") -> tuple[Method, nn.Module, dict[str, Any]]:
    """The method of a checkpoint (or of a run's newest one), its trained network in eval mode, and what is known of it.

    The last value has `path`, `sha256`, `step`, `epoch`, `config` (plain nested dict), `config_hash`, `dataset`,
    `validation`, `versions` and `facts`.

    Raises:
        BadInput: no checkpoint there, or it cannot be read.
    """
    path = find_checkpoint(path)
    values = read_checkpoint(path, device)
    config = settings.from_mapping(TrainConfig, values["config"], where=str(path))
    method, facts = method_class(config.method)(config), values.get("facts", {})
    network = method.new_network(facts)
    try:
        network.load_state_dict(values["network"])
    except (RuntimeError, TypeError, AttributeError) as error:
        reason = str(error).split("\n", 1)[0]
        raise BadInput(f"does not fit the network of its settings ({reason})", where=path) from error
    meta = {k: values[k] for k in ("step", "epoch", "config", "config_hash", "dataset", "validation", "versions")}
    known = {"path": str(path), "sha256": files.sha256_of(path), **meta, "facts": facts}
    return method, network.to(device).eval(), known


def _hash_path(path: Path) -> Path:
    return path.with_name(path.name + ".sha256")


def _step_of(path: Path) -> int:
    return int(path.stem.removeprefix("step-"))
