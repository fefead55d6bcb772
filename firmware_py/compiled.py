"""How kernels are compiled: numba, cached on disk under a fingerprint of the firmware's own sources.

Numba's cache looks only at the file that a function is written in; a kernel that calls another file's
kernel, or folds in its constants, would be served stale after an edit there. The fingerprint covers all of
``firmware_py``, so an edit anywhere compiles anew and an unchanged tree starts from the cache.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config as numba_config

_Function = TypeVar("_Function", bound=Callable[..., Any])


def source_fingerprint(folder: Path) -> str:
    """Hex digest of every Python file below ``folder``, names included."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(str(path.relative_to(folder)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Where compiled kernels of this version of the firmware are kept."""
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "micron-bench" / f"kernels-{source_fingerprint(Path(__file__).parent)}"


if "NUMBA_CACHE_DIR" not in os.environ:
    numba_config.CACHE_DIR = str(cache_folder())  # pyright: ignore[reportAttributeAccessIssue]


def kernel(function: _Function) -> _Function:
    """Compile ``function``; the pure-Python twin stays reachable as ``.py_func``.

    Division by zero gives inf or nan as in numpy instead of raising, so that a bad sample becomes a
    flagged sample and not an exception in the middle of a tick.
    """
    return cast(_Function, numba.njit(cache=True, error_model="numpy")(function))
