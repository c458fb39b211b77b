"""Settings: frozen dataclasses read from YAML and `--set key=value`, strict about names and types.

A config class lives beside the code it configures; each field has one docstring line (the string literal below
it). Unknown keys are errors that name the closest known key. `config_hash` identifies a resolved config.
"""

from __future__ import annotations

import dataclasses
import datetime
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

    `section={key: value}` changes these keys of the section alone. Where a text is wanted, numbers, dates and nothing
    at all are texts as well.

    Raises:
        UsageError: no "=", an unknown key, or a value that is no YAML or of the wrong type.
    """
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        if not equals:
            raise UsageError(f"'{assignment}' is not key=value", where="--set")
        where = f"--set {path.strip()}"
        try:
            value = _parsed(text)
        except ValueError as error:
            raise UsageError(f"'{text}' is not valid YAML ({error})", where=where) from error
        config = _replace(config, path.strip().split("."), value, text.strip(), where)
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
    """Read a YAML mapping. Raises `UsageError` where it is absent, malformed, not a mapping, or has a key twice."""
    try:
        values = _parsed(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"cannot be read ({error.strerror})", where=path) from error
    except ValueError as error:
        raise UsageError(f"is not valid YAML ({error})", where=path) from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise UsageError("must be a mapping of settings", where=path)
    return values


class _StrictLoader(yaml.SafeLoader):
    """YAML in which a mapping that has a key twice is an error: PyYAML forgets the first value in silence."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in seen:
                raise yaml.constructor.ConstructorError(None, None, f"'{key.value}' is there twice", key.start_mark)
            seen.add((key.tag, str(key.value)))
        return super().construct_mapping(node, deep)


def _parsed(text: str) -> Any:
    """The value of a YAML text. Raises `ValueError`, in one line, where it is malformed."""
    try:
        return yaml.load(text, _StrictLoader)
    except (yaml.YAMLError, ValueError) as error:  # e.g. the 13th month is a plain ValueError
        raise ValueError(" ".join(str(error).split())) from error


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


def _replace(config: Any, path: list[str], value: Any, text: str, where: str) -> Any:
    name, *below = path
    _require_setting(type(config), name, where)
    inner = getattr(config, name)
    if not below:
        return _updated(config, {name: _as_text(typing.get_type_hints(type(config))[name], value, text)}, where)
    if not dataclasses.is_dataclass(inner):
        raise UsageError(f"'{name}' has no settings below it", where=where)
    return dataclasses.replace(config, **{name: _replace(inner, below, value, text, where)})


def _updated(config: Any, values: Mapping[str, Any], where: str) -> Any:
    """The config with other values of some settings; a mapping for a section leaves its other settings as they are."""
    hints, changes = typing.get_type_hints(type(config)), {}
    for key, value in values.items():
        _require_setting(type(config), str(key), where)
        inner = getattr(config, key)
        is_section = dataclasses.is_dataclass(inner) and isinstance(value, Mapping)
        changes[key] = _updated(inner, value, where) if is_section else _convert(hints[key], value, where)
    return dataclasses.replace(config, **changes)


def _as_text(hint: Any, value: Any, text: str) -> Any:
    """What was typed, where a text is wanted and YAML reads a number, a date or nothing in it."""
    if hint is not str or isinstance(value, bool):
        return value
    return text if isinstance(value, (int, float, datetime.date)) or not text else value


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
        try:
            return float(value)
        except OverflowError:
            pass
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
