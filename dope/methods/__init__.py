"""The methods that `dope train --method` knows, a file each, behind one interface (`base.Method`)."""

from __future__ import annotations

from difflib import get_close_matches
from importlib import import_module
from typing import TYPE_CHECKING, Any, get_args

from dope.common.errors import UsageError
from dope.methods.configs import MethodName

if TYPE_CHECKING:
    from pathlib import Path

    import torch

    from dope.config import TrainConfig
    from dope.lowshot.embedding import Embedder
    from dope.methods.base import Method

METHODS: dict[str, str] = {
    "dope": "dope.methods.dope:Dope",
    "simpleshot": "dope.methods.simpleshot:SimpleShot",
    "rfs": "dope.methods.rfs:Rfs",
    "feat": "dope.methods.feat:Feat",
    "supmoco": "dope.methods.supmoco:SupMoCo",
    "vispe": "dope.methods.vispe:Vispe",
    "vispe_moco": "dope.methods.vispe_moco:VispeMoCo",
    "vispe_simsiam": "dope.methods.vispe_simsiam:VispeSimSiam",
}
"""Name -> where its class is; imported when it is asked for."""

KNOWN = tuple(name for name in get_args(MethodName) if name in METHODS)


def method_class(name: str) -> type[Method]:
    """The class of a method. Raises `UsageError` naming the closest one where there is no such method."""
    if name not in METHODS:
        close = get_close_matches(name, KNOWN, n=1)
        hint = f"did you mean '{close[0]}'?" if close else f"known: {', '.join(KNOWN)}"
        raise UsageError(f"unknown method '{name}' ({hint})", where="--method")
    module, attribute = METHODS[name].split(":")
    found: type[Method] = getattr(import_module(module), attribute)
    return found


def method_of(config: TrainConfig) -> Method:
    """The method of a run."""
    return method_class(config.method)(config)


def load_embedder(checkpoint: Path, device: torch.device | str = "cpu") -> tuple[Embedder, dict[str, Any]]:
    """The trained network of a checkpoint (or of a run's newest one) as evaluation sees it, and what is known of it.

    The second value is that of `dope.checkpoints.load_method`.

    Raises:
        BadInput: no checkpoint there, or it cannot be read.
    """
    from dope.checkpoints import load_method

    method, network, meta = load_method(checkpoint, device)
    return method.embedder(network), meta
