"""torch.compile, with an error that helps where it cannot be done."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

from dope.common.errors import DopeError

Output = TypeVar("Output")
REASON = 200  # characters of the reason: compilers say a lot


def compiled(function: Callable[[Tensor], Output]) -> Callable[[Tensor], Output]:
    """The function under torch.compile, which compiles it when it is first called.

    Raises (when called):
        DopeError: it cannot be compiled, most often for want of a C++ compiler, which PyTorch does not bring.
    """
    fast = torch.compile(function)

    def run(images: Tensor) -> Output:
        try:
            return fast(images)
        except Exception as error:
            from torch._dynamo.exc import TorchDynamoException  # seconds to import, unless compiling has done it

            if not isinstance(error, TorchDynamoException):
                raise
            cause = getattr(error, "inner_exception", error)
            reason = " ".join(str(cause).split())[:REASON] or type(cause).__name__
            raise DopeError(
                f"torch.compile failed ({reason})",
                where="compile",
                remedy="Install a C++ compiler (Debian: apt-get install g++), or train with --set compile=false",
            ) from error

    return run
