"""How much memory a training step takes: what autograd keeps for the backward pass, and the peak."""

from __future__ import annotations

import resource
import sys
from types import TracebackType

import torch
from torch import Tensor, nn

MIB = 2**20


class MemoryWatch:
    """Measures the passes within it: the most bytes that autograd holds at once, parameters left out.

    Storages that several operations keep count once, as they lie in memory once. Outside of it nothing is slower.

    Args:
        network: whose parameters are left out.
        device: where it lies.
    """

    def __init__(self, network: nn.Module, device: torch.device) -> None:
        self._parameters = {parameter.untyped_storage().data_ptr() for parameter in network.parameters()}
        self._device = device
        self._users: dict[int, int] = {}  # of each storage that is held
        self._held = self._most_held = 0
        self._hooks = torch.autograd.graph.saved_tensors_hooks(lambda tensor: _Saved(tensor, self), _Saved.unpack)

    def __enter__(self) -> MemoryWatch:
        if self._device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self._device)
        self._hooks.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._hooks.__exit__(kind, error, trace)

    def report(self) -> dict[str, float]:
        """`activations_mib`, and `peak_mib`: of the GPU since the watch began, else of this process since it began."""
        if self._device.type == "cuda":
            peak = float(torch.cuda.max_memory_allocated(self._device))
        else:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)
        return {"activations_mib": round(self._most_held / MIB, 1), "peak_mib": round(peak / MIB, 1)}

    def hold(self, storage: int, size: int) -> None:
        """Note one more user of a storage of `size` bytes."""
        self._users[storage] = self._users.get(storage, 0) + 1
        if self._users[storage] == 1 and storage not in self._parameters:
            self._held += size
            self._most_held = max(self._most_held, self._held)

    def release(self, storage: int, size: int) -> None:
        """Note one user less."""
        self._users[storage] -= 1
        if self._users[storage] == 0:
            del self._users[storage]  # the address may be used again
            if storage not in self._parameters:
                self._held -= size


class _Saved:
    """A tensor that autograd holds for as long as this object lives."""

    def __init__(self, tensor: Tensor, watch: MemoryWatch) -> None:
        self.tensor, self._watch = tensor, watch
        storage = tensor.untyped_storage()
        self._place = storage.data_ptr(), storage.nbytes()
        watch.hold(*self._place)

    def unpack(self) -> Tensor:
        """The tensor again."""
        return self.tensor

    def __del__(self) -> None:
        self._watch.release(*self._place)
