"""`--encoder module:function` (or FILE.py:function, hf:FOLDER): found, imported, and told apart from others."""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn

from dope.common import files
from dope.common.errors import BadInput, UsageError

Encode = Callable[[Tensor], Any]
"""Images (B, 3, H, W) float in [0, 1] to features: see `dope.encoders.features`."""


@dataclass(frozen=True)
class LoadedEncoder:
    """An encoder and what result rows say of it.

    Attributes:
        encode: images to features.
        name: "module:function" or "hf:FOLDER'S NAME".
        sha256: of the source file, or of the model's weights.
        config_hash: 16 hex digits: of the parameters of an `nn.Module`, or of the model's settings.
    """

    encode: Encode
    name: str
    sha256: str
    config_hash: str


def load_encoder(text: str, device: torch.device | str = "cpu") -> LoadedEncoder:
    """Load what `--encoder` names; an `nn.Module` is moved to the device and set to eval mode.

    The current directory is importable. What is named may be an encoder, or a factory (a function or class that can
    be called without arguments) that returns one.

    Raises:
        UsageError: not of a known form; no such module or function; not callable.
        BadInput: the module or the factory fails.
    """
    if text.startswith("hf:"):
        from dope.encoders.huggingface import load_huggingface

        return load_huggingface(text, device)
    module_name, colon, attribute = text.rpartition(":")
    if not colon or not module_name or not attribute:
        remedy = "Say module:function, FILE.py:function or hf:FOLDER"
        raise UsageError(f"'{text}' is not an encoder", where="--encoder", remedy=remedy)
    module = _import(module_name, text)
    encode = _encoder_of(_find(module, attribute, text), text)
    if isinstance(encode, nn.Module):
        encode.to(device).eval()
    source = getattr(module, "__file__", None)
    sha256 = files.sha256_of(Path(source)) if source and Path(source).is_file() else ""
    return LoadedEncoder(encode, text, sha256, _parameters_hash(encode))


def _import(name: str, text: str) -> ModuleType:
    try:
        if name.endswith(".py"):
            return _import_file(Path(name))
        _make_current_directory_importable()
        return importlib.import_module(name)
    except UsageError:
        raise
    except ModuleNotFoundError as error:
        missing = error.name or ""
        if not name.endswith(".py") and (name == missing or name.startswith(missing + ".")):
            remedy = "It must lie in the current directory or be installed"
            raise UsageError(f"no module '{missing}' for '{text}'", where="--encoder", remedy=remedy) from error
        what = f"imports '{missing}', which is not installed"
        raise BadInput(what, where=f"--encoder {text}", remedy=f"Install it beside dope: {sys.executable}") from error
    except Exception as error:
        what = f"cannot be imported: {type(error).__name__}: {error}"
        raise BadInput(what, where=f"--encoder {text}") from error


def _import_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise UsageError("no such file", where=f"--encoder {path}")
    # a name that no installed module has; registered, since dataclasses and pickles look there
    name = f"dope_encoder_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(path.resolve().parent))  # its neighbours, as `python FILE.py` would find them
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    finally:
        with contextlib.suppress(ValueError):
            sys.path.remove(str(path.resolve().parent))
    return module


def _make_current_directory_importable() -> None:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    importlib.invalidate_caches()


def _find(module: ModuleType, attribute: str, text: str) -> Any:
    found: Any = module
    for name in attribute.split("."):
        if not hasattr(found, name):
            close = difflib.get_close_matches(name, [n for n in dir(found) if not n.startswith("_")], n=1)
            remedy = f"Did you mean '{close[0]}'?" if close else None
            raise UsageError(f"the module has no '{name}'", where=f"--encoder {text}", remedy=remedy)
        found = getattr(found, name)
    return found


def _encoder_of(found: Any, text: str) -> Encode:
    """The callable that takes images: what was named, or what it returns as a factory."""
    if not callable(found):
        what = f"is a {type(found).__name__}, not a function of images"
        raise UsageError(what, where=f"--encoder {text}")
    if isinstance(found, nn.Module) or not _takes_nothing(found):
        return found
    try:
        made = found()
    except Exception as error:
        what = f"called without arguments, as a factory, it fails: {type(error).__name__}: {error}"
        raise BadInput(what, where=f"--encoder {text}") from error
    if not callable(made):
        what = f"takes no arguments, and returns a {type(made).__name__} instead of a function of images"
        raise UsageError(what, where=f"--encoder {text}")
    return made


def _takes_nothing(function: Any) -> bool:
    try:
        inspect.signature(function).bind()
    except TypeError:
        return False
    except ValueError:  # built in, without a signature
        return False
    return True


def _parameters_hash(encode: Encode) -> str:
    """Of the parameters and buffers of a module: the same source may have loaded other weights; else ""."""
    if not isinstance(encode, nn.Module):
        return ""
    digest = hashlib.sha256()
    for name, value in sorted(encode.state_dict().items()):
        if isinstance(value, Tensor):
            digest.update(f"{name} {tuple(value.shape)} {value.dtype}".encode())
            digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]
