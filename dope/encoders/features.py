"""What an encoder returned, in one form: checked, and with an explanation of what is wrong with it.

An encoder takes images (B, 3, H, W), float in [0, 1], and returns one of

- a tensor (B, D): pooled features;
- a tensor (B, D, h, w): dense features;
- (features, mask) or {"dense": ..., "pooled": ..., "mask": ...}: `mask` (B, h, w) are foreground probabilities of the
  cells; "features" is another name of either kind.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from dope.common.errors import BadInput, DopeError

KINDS = "a tensor (B, D) or (B, D, h, w), a tuple (features, mask), or a dict of dense, pooled, mask"
_SLACK = 1e-3  # probabilities may leave [0, 1] by a rounding


@dataclass(frozen=True)
class Features:
    """Of B images: `dense` (B, D, h, w), `pooled` (B, D), `mask` (B, h, w) in [0, 1]; float32; not all are None."""

    dense: Tensor | None
    pooled: Tensor | None
    mask: Tensor | None


def read_features(output: Any, n_images: int, name: str) -> Features:
    """Check what the encoder `name` returned for `n_images` images.

    Raises:
        BadInput: another type or shape; not finite; a mask that is none.
    """
    where = f"--encoder {name}"
    given: dict[str, Tensor | None] = {"dense": None, "pooled": None, "mask": None}
    for key, value in _parts(output, where).items():
        if value is None:
            continue
        if not isinstance(value, Tensor):
            raise BadInput(f"{key} is a {type(value).__name__} instead of a tensor", where=where, remedy=_expected())
        if key == "mask":
            given["mask"] = value[:, 0] if value.ndim == 4 and value.shape[1] == 1 else value
            continue
        kind = {2: "pooled", 4: "dense"}.get(value.ndim)
        if kind is None or (key != "features" and key != kind) or given[kind] is not None:
            raise BadInput(f"{key} has shape {_shape(value)}", where=where, remedy=_expected())
        given[kind] = value
    return Features(**{key: _checked(key, value, given, n_images, where) for key, value in given.items()})


def _parts(output: Any, where: str) -> Mapping[str, Any]:
    if isinstance(output, Tensor):
        return {"features": output}
    if isinstance(output, Mapping):
        unknown = [str(key) for key in output if key not in ("dense", "pooled", "mask", "features")]
        if unknown or not any(output.get(key) is not None for key in ("dense", "pooled", "features")):
            what = f"returned a dict of {', '.join(map(str, output)) or 'nothing'}"
            raise BadInput(what, where=where, remedy=_expected())
        return output
    if isinstance(output, tuple | list) and len(output) == 2:
        return {"features": output[0], "mask": output[1]}
    size = f" of {len(output)}" if isinstance(output, tuple | list) else ""
    raise BadInput(f"returned a {type(output).__name__}{size}", where=where, remedy=_expected())


def _checked(
    key: str, value: Tensor | None, given: Mapping[str, Tensor | None], n_images: int, where: str
) -> Tensor | None:
    if value is None:
        return None
    if value.is_complex() or not (value.is_floating_point() or key == "mask"):
        raise BadInput(f"{key} is of {value.dtype}, not of floats", where=where, remedy=_expected())
    if value.shape[0] != n_images or 0 in value.shape:
        what = f"{key} has shape {_shape(value)} for {n_images} images"
        remedy = "The first dimension must be the images', also where there is one image"
        raise BadInput(what, where=where, remedy=remedy)
    value = value.float()
    if not value.isfinite().all():
        raise BadInput(f"{key} has values that are not finite", where=where)
    if key == "mask":
        dense = given["dense"]
        if dense is None:
            what = "gives a mask, but no dense features that it could belong to"
            raise BadInput(what, where=where, remedy=_expected())
        if value.shape != (n_images, *dense.shape[-2:]):
            what = f"mask has shape {_shape(value)}, dense features {_shape(dense)}"
            raise BadInput(what, where=where, remedy="A mask is (B, h, w): one value a cell")
        low, high = float(value.min()), float(value.max())
        if low < -_SLACK or high > 1 + _SLACK:
            what = f"mask has values from {low:.3g} to {high:.3g}, which are no probabilities"
            raise BadInput(what, where=where, remedy="Logits become probabilities by a sigmoid")
        return value.clamp(0, 1)
    return value


def raised(error: Exception, images: Tensor, name: str) -> DopeError:
    """The explanation of an exception that the encoder itself raised."""
    what = f"fails on images {_shape(images)} of {images.device}: {type(error).__name__}: {error}"
    return BadInput(what, where=f"--encoder {name}")


def _expected() -> str:
    return f"An encoder returns {KINDS}"


def _shape(value: Tensor) -> str:
    return "x".join(map(str, value.shape))
