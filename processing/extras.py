"""Packages that only an extra of the installation brings."""

from importlib import import_module
from typing import Any

from processing.errors import ProcessError


def needed(package: str, extra: str) -> Any:
    """The package. Raises ProcessError that names the extra where it is not installed."""
    try:
        return import_module(package)
    except ImportError as error:
        raise ProcessError(f"needs {package}: pip install 'umov[{extra}]'") from error
