"""python-can without its reader of MF4 logs, which nothing here uses."""

from __future__ import annotations

import importlib
import sys
from typing import Any


def import_can() -> Any:
    """Import the package ``can``. Where asammdf is installed, ``can`` imports it and pandas with it: 3 s of every
    process. It is hidden meanwhile, and can be imported afterwards."""
    is_hidden = "can" not in sys.modules and "asammdf" not in sys.modules
    if is_hidden:
        sys.modules["asammdf"] = None  # type: ignore[assignment]
    try:
        return importlib.import_module("can")
    finally:
        if is_hidden:
            del sys.modules["asammdf"]
