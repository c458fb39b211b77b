"""The arguments of `dope eval`: RUN and SHARDS, or SHARDS alone with an encoder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dope.common.errors import UsageError


def run_and_shards(places: Sequence[str], encoder: str | None) -> tuple[Path | None, str]:
    """RUN (None with `--encoder`) and SHARDS.

    Raises:
        UsageError: too few or too many; both a run and an encoder; neither.
    """
    if encoder is None:
        if len(places) == 1:
            remedy = "Give both, or evaluate another encoder on them by --encoder module:function"
            raise UsageError("RUN and SHARDS are needed, here is one of them", where=places[0], remedy=remedy)
        if len(places) != 2:
            raise UsageError(f"RUN and SHARDS are needed, here are {len(places)} arguments", where="dope eval")
        return Path(places[0]), places[1]
    if len(places) == 2:
        remedy = f"Leave out {places[0]} to evaluate the encoder, or --encoder to evaluate the run"
        raise UsageError("a run and an encoder are given", where=f"--encoder {encoder}", remedy=remedy)
    if len(places) != 1:
        raise UsageError(f"SHARDS alone is needed, here are {len(places)} arguments", where=f"--encoder {encoder}")
    return None, places[0]
