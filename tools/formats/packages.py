"""Imports of packages that are extras, with one message that says how to get them."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from tools.errors import InputError


def need(path: Path | str, extra: str, *modules: str) -> tuple[Any, ...]:
    """Return the modules. Raises ``InputError`` that names the extra when one is not installed."""
    try:
        return tuple(importlib.import_module(name) for name in modules)
    except ImportError as error:
        package = modules[0].split(".")[0].replace("google", "protobuf")  # its module has another name
        raise InputError(f"{path}: needs {package}; install it with: pip install 'micron-bench[{extra}]'") from error
