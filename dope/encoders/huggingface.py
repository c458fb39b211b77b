"""Hugging Face vision models from a local folder: `--encoder hf:FOLDER`, `hf:FOLDER?pool=cls&size=448`.

Vision transformers such as DINOv2 and DINOv3 (ViT) give a grid of patch tokens, dense features of stride 14 or 16;
models with feature maps (ConvNeXt, ResNet) give those. Nothing is fetched, and no code from the folder runs.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qsl

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dope.common import files
from dope.common.errors import BadInput, DopeError, UsageError
from dope.encoders.load import LoadedEncoder

Pool = Literal["mean", "cls"]

PREPROCESSOR = "preprocessor_config.json"
UNUSED = ("pooler.", "classifier.", "head.", "mask_token", "embeddings.mask_token")
"""Parameters that may be missing in the weights: they have no part in the features."""


@dataclass(frozen=True)
class Preprocessing:
    """From images in [0, 1] to what the model was trained with."""

    mean: tuple[float, float, float]
    """Subtracted, a channel each."""
    std: tuple[float, float, float]
    """Divided by, a channel each."""
    side: int
    """Pixels; views are resized to it, rounded to a multiple of the patch size."""


class HuggingFaceEncoder(nn.Module):
    """Images (B, 3, H, W) in [0, 1] to {"dense": (B, D, h, w)} and, with `pool="cls"`, {"pooled": (B, D)}.

    Args:
        model: maps `pixel_values` to an output with `last_hidden_state`: tokens (B, prefix + h * w, D), where the
            prefix is the CLS token and `config.num_register_tokens` registers, or nothing; or maps (B, D, h, w).
        preprocessing: mean, std and size.
        pool: "cls", or "mean": no pooled features of its own, so that the mean over cells is taken.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, model: nn.Module, preprocessing: Preprocessing, pool: Pool = "mean") -> None:
        super().__init__()
        self.model, self.pool = model, pool
        self.patch = patch_size(model.config)
        self.side = round_to_multiple(preprocessing.side, self.patch or 1)
        self.registers = int(getattr(model.config, "num_register_tokens", 0) or 0)
        self._interpolates = "interpolate_pos_encoding" in inspect.signature(model.forward).parameters
        self.register_buffer("mean", torch.tensor(preprocessing.mean).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(preprocessing.std).view(1, 3, 1, 1), persistent=False)

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        if images.shape[-2:] != (self.side, self.side):
            size = (self.side, self.side)
            images = F.interpolate(images, size, mode="bicubic", align_corners=False, antialias=True).clamp(0, 1)
        pixels = (images - self.mean) / self.std
        options = {"interpolate_pos_encoding": True} if self._interpolates else {}
        hidden = self.model(pixel_values=pixels, **options).last_hidden_state
        if hidden.ndim == 4:
            if self.pool == "cls":
                raise UsageError(
                    "the model has feature maps and no CLS token", where="?pool=cls", remedy="Leave it out"
                )
            return {"dense": hidden}
        n_tokens, special = hidden.shape[1], 1 + self.registers
        grid = self.side // self.patch if self.patch else math.isqrt(max(0, n_tokens - special))
        prefix = n_tokens - grid * grid
        if prefix not in (0, special):
            what = f"{n_tokens} tokens are not {grid}x{grid} patches, alone or after CLS and {self.registers} registers"
            raise BadInput(what, where="--encoder hf:", remedy="Give the size that the model expects by ?size=N")
        features = {"dense": hidden[:, prefix:].transpose(1, 2).unflatten(2, (grid, grid))}
        if self.pool == "cls":
            if prefix == 0:
                raise UsageError("the model has no CLS token", where="?pool=cls", remedy="Use ?pool=mean")
            features["pooled"] = hidden[:, 0]
        return features


def load_huggingface(text: str, device: torch.device | str = "cpu") -> LoadedEncoder:
    """Load `hf:FOLDER?pool=cls&size=N`.

    Raises:
        UsageError: no such folder; an unknown option.
        DopeError: transformers is missing.
        BadInput: the folder lacks a file, needs code of its own, or lacks weights.
    """
    folder, pool, size = _parse(text)
    transformers = _transformers(text)
    _check_files(folder, text)
    preprocessing = read_preprocessing(folder / PREPROCESSOR, size)
    local: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False}
    try:
        config = transformers.AutoConfig.from_pretrained(str(folder), **local)
        # safetensors alone: other formats are pickles, which are code
        local |= {"config": config, "use_safetensors": True, "output_loading_info": True}
        with _no_progress_bar(transformers):
            model, info = transformers.AutoModel.from_pretrained(str(folder), **local)
    except Exception as error:  # whatever transformers raises of a folder it cannot use
        what = f"cannot be loaded by transformers {transformers.__version__}: {_first_line(error)}"
        raise BadInput(what, where=folder, remedy="Code of the folder's own is never run") from error
    missing = sorted(key for key in info["missing_keys"] if not key.startswith(UNUSED))
    if missing:
        what = f"lacks {len(missing)} of the model's weights ({', '.join(missing[:3])}), which would be random"
        raise BadInput(what, where=folder, remedy="Download the folder again")
    if patch_size(model.config) is None and not _has_maps(model):
        raise BadInput(f"{type(model).__name__} is no vision model with patches or feature maps", where=folder)
    encoder = HuggingFaceEncoder(model.float(), preprocessing, pool).to(device).eval()
    options = f"?pool={pool}" if pool == "cls" else ""
    options += f"{'&' if options else '?'}size={size}" if size else ""
    settings = f"{files.sha256_of(folder / 'config.json')} {preprocessing} {pool}"
    return LoadedEncoder(
        encoder,
        f"hf:{folder.resolve().name}{options}",
        _weights_hash(folder),
        hashlib.sha256(settings.encode()).hexdigest()[:16],
    )


def read_preprocessing(path: Path, size: int | None = None) -> Preprocessing:
    """Read mean, std and size of preprocessor_config.json; `size` takes the place of its own.

    Raises:
        BadInput: the file is damaged or lacks one of them.
    """
    values = files.read_json(path, remedy="Download it again")
    try:
        normalised = values.get("do_normalize", True)
        mean, std = (values["image_mean"], values["image_std"]) if normalised else ([0.0] * 3, [1.0] * 3)
        if size is None:
            cropped = values.get("do_center_crop", "crop_size" in values) and "crop_size" in values
            size = _side(values["crop_size"] if cropped else values["size"])
        mean, std = tuple(map(float, mean)), tuple(map(float, std))
        if len(mean) != 3 or len(std) != 3 or not all(map(math.isfinite, mean + std)) or min(std) <= 0 or size < 1:
            raise ValueError("not three finite numbers each, or not above 0")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        what = f"has no usable image_mean, image_std and size ({type(error).__name__}: {error})"
        raise BadInput(what, where=path, remedy="Download it again") from error
    return Preprocessing(mean, std, size)


def patch_size(config: Any) -> int | None:
    """Side of a patch in pixels; None where the model has none."""
    value = getattr(config, "patch_size", None)
    if isinstance(value, list | tuple):
        value = value[0] if len(set(value)) == 1 else None
    return value if isinstance(value, int) and value > 0 else None


def round_to_multiple(side: int, patch: int) -> int:
    """The multiple of the patch size (at least one patch) that is nearest; of two, the greater."""
    return max(1, (2 * side + patch) // (2 * patch)) * patch


def _parse(text: str) -> tuple[Path, Pool, int | None]:
    where = f"--encoder {text}"
    name, _, query = text.removeprefix("hf:").partition("?")
    options = dict(parse_qsl(query, keep_blank_values=True))
    unknown = set(options) - {"pool", "size"}
    if unknown:
        raise UsageError(f"unknown option '{min(unknown)}'", where=where, remedy="There are pool=mean|cls and size=N")
    pool, size = options.get("pool", "mean"), options.get("size")
    if pool not in ("mean", "cls"):
        raise UsageError(f"pool is '{pool}'", where=where, remedy="It is mean or cls")
    if size is not None and not (size.isdecimal() and 1 <= int(size) <= 4096):
        raise UsageError(f"size is '{size}'", where=where, remedy="It is a number of pixels, 1 to 4096")
    if not name or not Path(name).is_dir():
        remedy = f"Models are read from folders: hf download {name or 'OWNER/MODEL'} --local-dir FOLDER"
        raise UsageError(f"no folder '{name}'", where=where, remedy=remedy)
    return Path(name), pool, int(size) if size else None  # type: ignore[return-value]


def _check_files(folder: Path, text: str) -> None:
    for name in ("config.json", PREPROCESSOR):
        if not (folder / name).is_file():
            raise BadInput(f"has no {name}", where=folder, remedy="Download all files of the model")
    if not any(folder.glob("*.safetensors")):
        what = "has no weights as .safetensors (others are pickles, which can run code)"
        raise BadInput(what, where=folder, remedy="Download or convert them")
    config = files.read_json(folder / "config.json", remedy="Download it again")
    if not isinstance(config, dict) or "model_type" not in config:
        raise BadInput("has no model_type", where=folder / "config.json", remedy="Download it again")


def _transformers(text: str) -> Any:
    try:
        import transformers
    except ImportError as error:
        what = "transformers is needed to read Hugging Face models"
        raise DopeError(what, where=f"--encoder {text}", remedy="pip install transformers") from error
    return transformers


@contextlib.contextmanager
def _no_progress_bar(transformers: Any) -> Iterator[None]:
    """Without the library's bar over the weights, which our own would run into."""
    logging = transformers.utils.logging
    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()


def _has_maps(model: Any) -> bool:
    """Convolutional models of the library, whose last hidden state is a map."""
    return hasattr(model.config, "hidden_sizes") and hasattr(model.config, "depths")


def _side(size: Any) -> int:
    if isinstance(size, dict):
        if "height" in size and size["height"] != size.get("width", size["height"]):
            raise ValueError(f"size {size} is not square")
        size = size["shortest_edge"] if "shortest_edge" in size else size["height"]
    return int(size)


def _weights_hash(folder: Path) -> str:
    """Of one file of weights its SHA-256; of several, that of their hashes."""
    hashes = [files.sha256_of(path) for path in sorted(folder.glob("*.safetensors"))]
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
