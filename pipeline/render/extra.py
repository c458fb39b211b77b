"""The packages of the extra `render`."""

from __future__ import annotations

from dope.common.errors import DopeError


def missing(package: str) -> DopeError:
    """The error where a package that rendering needs is not installed."""
    return DopeError(
        f"rendering needs {package}, which is not installed", remedy="pip install 'dope-descriptors[render]'"
    )
