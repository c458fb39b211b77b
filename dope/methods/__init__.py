"""The methods that `dope train --method` knows, a file each, behind one interface (`base.Method`)."""

from __future__ import annotations

from difflib import get_close_matches
from importlib import import_module
from typing import TYPE_CHECKING, get_args

from dope.common.errors import UsageError
from dope.methods.configs import MethodName

if TYPE_CHECKING:
    from dope.config import TrainConfig
    from dope.methods.base import Method

METHODS: dict[str, str] = {
    "dope": "dope.methods.dope:Dope",
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
