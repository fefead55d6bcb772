"""How kernels are compiled: numba, cached on disk under a fingerprint of every source that a kernel can see.

Numba's own cache looks only at the file that a function is written in; a kernel that calls another file's
kernel, or folds in its constants, would be served stale after an edit there. The fingerprint here covers the
module and all of our modules that it imports, directly or not: an edit compiles anew what it can reach and
nothing else. Import this module only where kernels are: it pulls in numba.
"""

from __future__ import annotations

import ast
import hashlib
import os
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config as numba_config

_Function = TypeVar("_Function", bound=Callable[..., Any])

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("hal", "drivers", "sim_devices", "firmware_py", "tools")


def _files_of(dotted: str, root: Path) -> Iterator[Path]:
    path = root.joinpath(*dotted.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            yield file


@cache
def imported_sources(file: Path, root: Path = ROOT) -> frozenset[Path]:
    """Our own files that ``file`` imports by absolute name, type-only imports included."""
    found: set[Path] = set()
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            continue
        for name in names:
            if name.split(".")[0] in PACKAGES:
                found.update(_files_of(name, root))
    return frozenset(found)


@cache
def source_fingerprint(file: Path, root: Path = ROOT) -> str:
    """Hex digest of ``file`` and of all that it reaches through imports of our own packages."""
    reached = {file}
    waiting = [file]
    while waiting:
        fresh = imported_sources(waiting.pop(), root) - reached
        reached |= fresh
        waiting.extend(fresh)
    digest = hashlib.sha256()
    for path in sorted(reached):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder(file: Path) -> Path:
    """Where the compiled kernels of this version of ``file`` are kept."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "micron-bench" / f"kernels-{source_fingerprint(file)}"


def kernel(function: _Function) -> _Function:
    """Compile ``function``; the pure-Python twin stays reachable as ``.py_func``.

    Division by zero gives inf or nan as in numpy instead of raising, so that a bad sample becomes a
    flagged sample and not an exception in the middle of a tick.
    """
    if "NUMBA_CACHE_DIR" not in os.environ:
        folder = cache_folder(Path(function.__code__.co_filename).resolve())
        numba_config.CACHE_DIR = str(folder)  # pyright: ignore[reportAttributeAccessIssue]
    return cast(_Function, numba.njit(cache=True, error_model="numpy")(function))
