"""Compile kernels with numba and cache them on disk under a fingerprint of every source that a kernel can see.

Numba's own cache looks only at the file that a function is written in; a kernel that calls another file's
kernel, or folds in its constants, would be served stale after an edit there. The fingerprint here covers the
module and all of our modules that it imports, directly or not: an edit compiles anew what it can reach and
nothing else. The cache knows no path: every clone and work tree of a user shares it. Import this module only
where kernels are: it pulls in numba.
"""

from __future__ import annotations

import ast
import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config as numba_config
from numba.core.caching import UserProvidedCacheLocator

from hal.compile_notice import CompileNotice

_Function = TypeVar("_Function", bound=Callable[..., Any])

CompileNotice().listen()

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("hal", "drivers", "sim_devices", "firmware_py", "tools")


def _files_of(dotted: str, root: Path) -> Iterator[Path]:
    path = root.joinpath(*dotted.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            yield file


def _when_imported(body: Sequence[ast.stmt]) -> Iterator[ast.stmt]:
    """The statements that run when a module is imported, without those for type checkers alone."""
    for node in body:
        if isinstance(node, ast.If):
            if not (isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"):
                yield from _when_imported(node.body)
            yield from _when_imported(node.orelse)
        elif isinstance(node, ast.Try):
            for part in (node.body, node.orelse, node.finalbody, *(handler.body for handler in node.handlers)):
                yield from _when_imported(part)
        else:
            yield node


@cache
def imported_sources(file: Path, root: Path = ROOT) -> frozenset[Path]:
    """Return the files of our own packages that ``file`` imports by absolute name when it is imported itself.

    An import within a function is not seen, and need not be: no kernel can use one.
    """
    sources: set[Path] = set()
    for node in _when_imported(ast.parse(file.read_bytes()).body):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            continue
        for name in names:
            if name.split(".")[0] in PACKAGES:
                sources.update(_files_of(name, root))
    return frozenset(sources)


@cache
def source_fingerprint(file: Path, root: Path = ROOT) -> str:
    """Return a hex digest of ``file`` and of every file that it imports, directly or not, from our own packages."""
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


def user_cache() -> Path:
    """Return the folder of this user's compiled kernels and filter designs, which all clones share."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "micron-bench"


def cache_folder(file: Path) -> Path:
    """Return the folder of the compiled kernels of this version of ``file``."""
    return user_cache() / f"kernels-{source_fingerprint(file)}"


class AnyClone(UserProvidedCacheLocator):
    """Names a cached file by its place in this tree, not by where the tree lies; its content is in the folder."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        return ".".join(Path(py_file).resolve().relative_to(ROOT).parent.parts)


def kernel(function: _Function) -> _Function:
    """Compile ``function``; the pure-Python twin stays reachable as ``.py_func``.

    Division by zero gives inf or nan as in numpy instead of raising, so that a bad sample becomes a
    flagged sample and not an exception in the middle of a tick.
    """
    return _compiled(function, nogil=False)


def inlined_kernel(function: _Function) -> _Function:
    """Compile ``function`` into each kernel that calls it, not by itself: for what lies between a large kernel and its
    only caller, because every level of calls optimizes all that is below it anew."""
    return _compiled(function, nogil=False, inline="always")


def thread_kernel(function: _Function) -> _Function:
    """Compile ``function`` as ``kernel`` does, and release the GIL while it runs: for loops that a thread enters once.

    A call of some microseconds must not use it: beside a busy Python thread each call would wait milliseconds for the
    GIL.
    """
    return _compiled(function, nogil=True)


def _compiled(function: _Function, nogil: bool, inline: str = "never") -> _Function:
    options: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": nogil, "inline": inline}
    file = Path(function.__code__.co_filename).resolve()
    if "NUMBA_CACHE_DIR" in os.environ or not file.is_relative_to(ROOT):
        return cast(_Function, numba.njit(**options)(function))
    config = cast(Any, numba_config)
    previous = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES
    config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = str(cache_folder(file)), f"{__name__}.AnyClone"
    try:
        return cast(_Function, numba.njit(**options)(function))
    finally:
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = previous
