"""Weights & Biases, where a run asks for it: the only importer of wandb. Its failures never stop a training."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dope.common import files
from dope.common.errors import UsageError

IDENTITY = "wandb-id"


def require_wandb() -> Any:
    """The package. Raises `UsageError` where it is not installed."""
    try:
        import wandb
    except ImportError as error:
        raise UsageError(
            f"Weights & Biases cannot be imported ({error})",
            where="log.wandb",
            remedy="pip install 'dope-descriptors[wandb]', or leave out --set log.wandb=...",
        ) from error
    return wandb


class WandbRun:
    """Hands a run's numbers and pictures on; after the first failure it says so once and keeps still.

    Args:
        project: the project, made by W&B where there is none.
        folder: RUN; RUN/wandb-id holds the name that W&B knows it by, so that a resumed run goes on there.
        config: the resolved settings.
        say: takes the one warning.

    Raises:
        UsageError: the package is not installed.
    """

    def __init__(self, project: str, folder: Path, config: Mapping[str, Any], say: Callable[[str], None]) -> None:
        self._wandb, self._say = require_wandb(), say
        self._run: Any = None
        path = folder / IDENTITY
        if not path.is_file():
            files.write_bytes(path, secrets.token_hex(8).encode())
        self._try(lambda: self._begin(project, folder, path.read_text(), config))

    def numbers(self, group: str, step: int, values: Mapping[str, Any]) -> None:
        """Log the numbers among the values as `group/name`."""
        numbers = {f"{group}/{name}": v for name, v in values.items() if isinstance(v, (int, float))}
        if self._run:
            self._try(lambda: self._run.log({**numbers, "step": step}))

    def picture(self, name: str, step: int, image: NDArray[np.uint8]) -> None:
        """Log an image (H, W, 3) uint8 RGB."""
        if self._run:
            self._try(lambda: self._run.log({name: self._wandb.Image(image), "step": step}))

    def close(self, *, failed: bool) -> None:
        """Say that the run has ended, well or not."""
        if self._run:
            self._try(lambda: self._run.finish(exit_code=int(failed)))

    def _begin(self, project: str, folder: Path, identity: str, config: Mapping[str, Any]) -> None:
        name = folder.resolve().name  # "." has none
        self._run = self._wandb.init(
            project=project, id=identity, resume="allow", name=name, dir=str(folder), config=dict(config)
        )
        # our own steps as the axis: W&B's only grow, and a resumed run may go back to a checkpoint
        self._run.define_metric("*", step_metric="step")

    def _try(self, call: Callable[[], Any]) -> None:
        try:
            call()
        except Exception as error:  # of any kind: a network, a quota, a key; a training must not end for that
            self._run = None
            self._say(f"WARNING: Weights & Biases failed ({error}); the training goes on without it")
