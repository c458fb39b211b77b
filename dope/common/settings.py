"""Settings: frozen dataclasses read from YAML and `--set key=value`, strict about names and types.

A config class lives beside the code it configures; each field has one docstring line (the string literal below
it). Unknown keys are errors that name the closest known key. `config_hash` identifies a resolved config.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import json
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from dope.common.errors import UsageError

Config = TypeVar("Config")


FLAG = "flag"


def by_flag(flag: str, default: Any) -> Any:
    """A field of a config class that says how the work is done, not what comes out: a flag of the command sets it when
    the work begins. No setting may name it, so it is its default wherever a fingerprint is taken."""
    return dataclasses.field(default=default, metadata={FLAG: flag})


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain nested dicts, in the order of its fields."""
    return dataclasses.asdict(config)


def config_hash(config: Any) -> str:
    """16 hex digits that change whenever any setting does."""
    value = to_dict(config) if dataclasses.is_dataclass(config) else config
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]


def from_mapping(cls: type[Config], values: Mapping[str, Any], *, where: str = "configuration") -> Config:
    """Build `cls` from nested mappings; what is absent keeps its default.

    Raises:
        UsageError: an unknown key (the closest known one is named) or a value of the wrong type.
    """
    hints = typing.get_type_hints(cls)
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        _require_setting(cls, str(key), where)
        arguments[key] = _convert(hints[key], value, f"{where}: {key}")
    return cls(**arguments)


def override(config: Config, assignments: Iterable[str]) -> Config:
    """Apply `section.key=value` strings (values are YAML) to a config.

    Raises:
        UsageError: no "=", an unknown key, or a value that is no YAML or of the wrong type.
    """
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        if not equals:
            raise UsageError(f"'{assignment}' is not key=value", where="--set")
        where = f"--set {path.strip()}"
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError as error:
            reason = str(error).replace("\n", " ")
            raise UsageError(f"'{text}' is not valid YAML ({reason})", where=where) from error
        config = _replace(config, path.strip().split("."), value, where)
    return config


def require_at_least(config: Any, **least: float) -> None:
    """Refuse settings that are too small to mean anything; for `__post_init__`.

    Raises:
        UsageError: names the setting, its value and the least that it may have.
    """
    for name, value in least.items():
        if getattr(config, name) < value:
            raise UsageError(f"{name} must be at least {value:g}, not {getattr(config, name)}", where="settings")


def load_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML mapping. Raises `UsageError` where it is absent, malformed or not a mapping."""
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"cannot be read ({error.strerror})", where=path) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(f"is not valid YAML ({error})", where=path) from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise UsageError("must be a mapping of settings", where=path)
    return values


def _require_setting(cls: type, key: str, where: str) -> None:
    """Raise `UsageError` for what is no field of a config class, or a field that only a flag sets (`by_flag`)."""
    fields = {field.name: field for field in dataclasses.fields(cls)}
    known = [name for name, field in fields.items() if FLAG not in field.metadata]
    if key not in fields:
        raise UsageError(_unknown(key, known), where=where)
    if key not in known:
        flag = fields[key].metadata[FLAG]
        raise UsageError(f"'{key}' is no setting: {flag} sets it", where=where, remedy=f"Use {flag}")


def _unknown(key: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(key, list(known), n=1)
    hint = f"did you mean '{close[0]}'?" if close else f"known: {', '.join(sorted(known))}"
    return f"unknown key '{key}' ({hint})"


def _replace(config: Any, path: list[str], value: Any, where: str) -> Any:
    _require_setting(type(config), path[0], where)
    if len(path) == 1:
        hint = typing.get_type_hints(type(config))[path[0]]
        return dataclasses.replace(config, **{path[0]: _convert(hint, value, where)})
    inner = getattr(config, path[0])
    if not dataclasses.is_dataclass(inner):
        raise UsageError(f"'{path[0]}' has no settings below it", where=where)
    return dataclasses.replace(config, **{path[0]: _replace(inner, path[1:], value, where)})


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(hint, value, where)
    if origin is typing.Literal:
        if isinstance(value, bool) and {"on", "off"} & set(typing.get_args(hint)):
            value = "on" if value else "off"  # YAML 1.1 reads a bare on or off as a boolean
        if value not in typing.get_args(hint):
            choices = ", ".join(map(str, typing.get_args(hint)))
            raise UsageError(f"'{value}' is not one of {choices}", where=where)
        return value
    if dataclasses.is_dataclass(hint) and isinstance(value, Mapping):
        return from_mapping(typing.cast(type, hint), value, where=where)
    if origin is tuple and isinstance(value, (list, tuple)):
        kinds = typing.get_args(hint)
        if kinds[-1:] == (Ellipsis,):
            kinds = kinds[:1] * len(value)
        if len(kinds) == len(value):
            return tuple(_convert(kind, item, where) for kind, item in zip(kinds, value, strict=True))
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if hint is float and isinstance(value, str):  # YAML 1.1 reads 1e-4 as a string
        try:
            return float(value)
        except ValueError:
            pass
    if hint is Any or (isinstance(hint, type) and type(value) is hint):
        return value
    name = getattr(hint, "__name__", None) if origin is None else str(hint)
    raise UsageError(f"'{value}' is not of type {name or hint}", where=where)


def _convert_union(hint: Any, value: Any, where: str) -> Any:
    choices = typing.get_args(hint)
    if value is None and type(None) in choices:
        return None
    for choice in choices:
        if choice is type(None):
            continue
        try:
            return _convert(choice, value, where)
        except UsageError:
            continue
    raise UsageError(f"'{value}' is not of type {hint}", where=where)
