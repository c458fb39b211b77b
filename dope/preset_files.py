"""The presets of `dope train`: YAML files of settings, each with a comment that says in its first line what it is.

A preset may say `extends: NAME` and give only what differs from that one.
"""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Any

from dope.common import settings
from dope.common.errors import UsageError

PRESETS = Path(__file__).parent / "presets"
EXTENDS = "extends"


def preset_names() -> list[str]:
    """All presets, sorted."""
    return sorted(path.stem for path in PRESETS.glob("*.yaml"))


def preset_summary(name: str) -> str:
    """What a preset is: the first line of its file, a comment."""
    with (PRESETS / f"{name}.yaml").open(encoding="utf-8") as file:
        return file.readline().removeprefix("#").strip()


def preset_values(name: str, *, where: str = "--preset", extended_by: tuple[str, ...] = ()) -> dict[str, Any]:
    """The settings of a preset, over those of the one that it extends.

    Args:
        where: what an unknown name is blamed on.
        extended_by: the presets on the way here.

    Raises:
        UsageError: unknown (the closest known one is named), or a preset extends itself.
    """
    if name not in preset_names():
        close = get_close_matches(name, preset_names(), n=1)
        hint = f"did you mean '{close[0]}'?" if close else f"known: {', '.join(preset_names())}"
        raise UsageError(f"unknown preset '{name}' ({hint})", where=where)
    path = PRESETS / f"{name}.yaml"
    if name in extended_by:
        way = " -> ".join([*extended_by, name])
        raise UsageError(f"extends itself ({way})", where=path, remedy=f"Take out one '{EXTENDS}'")
    values = settings.load_yaml(path)
    base = values.pop(EXTENDS, None)
    if base is None:
        return values
    return merged(preset_values(str(base), where=f"{path}: {EXTENDS}", extended_by=(*extended_by, name)), values)


def method_values(method: str, preset: str | None) -> dict[str, Any]:
    """What a method's file (presets/methods/METHOD.yaml) says for a preset: `all`, then the presets that this one
    extends from the base on, each over the one before.

    Raises:
        UsageError: no such method.
    """
    from dope.methods import method_class

    method_class(method)  # says which ones there are
    path = PRESETS / "methods" / f"{method}.yaml"
    values: dict[str, Any] = {"method": method}
    sections = settings.load_yaml(path) if path.is_file() else {}
    for name in ("all", *(extended(preset) if preset is not None else ())):
        values = merged(values, sections.get(name) or {})
    return values


def extended(name: str) -> tuple[str, ...]:
    """A preset and those that it extends, the base first."""
    base = settings.load_yaml(PRESETS / f"{name}.yaml").get(EXTENDS)
    return (*(extended(str(base)) if base is not None else ()), name)


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Nested settings, those of `above` over those of `below`; neither is changed."""
    result = dict(below)
    for key, value in above.items():
        inner = result.get(key)
        result[key] = merged(inner, value) if isinstance(inner, dict) and isinstance(value, dict) else value
    return result
