"""Keeps filters designed by scipy.signal on disk, because importing it takes longer than the rest of a start.

The first start on a machine calls scipy; later ones read the same bits from a file named by what was asked and by the
version of scipy. A file that cannot be read or written costs time, never the design.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import numpy as np

from hal.arrays import AnyArray
from hal.compiled import user_cache


def design(function: str, *arguments: Any, **options: Any) -> tuple[AnyArray, ...]:
    """Return what ``scipy.signal.FUNCTION`` returns, as a tuple of arrays. Arguments: numbers, strings, arrays."""
    plain = [_plain(argument) for argument in arguments], {name: _plain(value) for name, value in options.items()}
    asked = json.dumps([function, _scipy_version(), *plain], sort_keys=True)
    file = user_cache() / "designs" / f"{hashlib.sha256(asked.encode()).hexdigest()[:24]}.json"
    known = _read(file, asked)
    if known is not None:
        return known
    found: Any = getattr(importlib.import_module("scipy.signal"), function)(*arguments, **options)
    parts = cast("tuple[Any, ...]", found) if isinstance(found, tuple) else (found,)
    arrays: tuple[AnyArray, ...] = tuple(np.asarray(part) for part in parts)
    _write(file, asked, arrays)
    return arrays


@cache
def _scipy_version() -> str:
    """Looked up once: the file that it comes from takes longer to parse than a design to read."""
    return version("scipy")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | list | tuple):
        numbers: Any = np.asarray(cast("Any", value))
        if np.iscomplexobj(numbers):
            return {"real": numbers.real.tolist(), "imag": numbers.imag.tolist()}
        return numbers.tolist()
    return value


def _read(file: Path, asked: str) -> tuple[AnyArray, ...] | None:
    try:
        table = json.loads(file.read_text())
        if table["asked"] != asked:
            return None
        return tuple(_array(part) for part in table["arrays"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _array(part: dict[str, Any]) -> AnyArray:
    real = np.array(part["real"], dtype=np.float64).reshape(part["shape"])
    if part["imag"] is None:
        return real
    whole = real.astype(np.complex128)
    whole.imag = np.array(part["imag"]).reshape(part["shape"])
    return whole


def _write(file: Path, asked: str, arrays: tuple[AnyArray, ...]) -> None:
    parts = [
        {
            "shape": array.shape,
            "real": np.real(array).ravel().tolist(),
            "imag": np.imag(array).ravel().tolist() if np.iscomplexobj(array) else None,
        }
        for array in arrays
    ]
    beside = file.with_name(f"{file.name}.{os.getpid()}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text(json.dumps({"asked": asked, "arrays": parts}))
        beside.replace(file)
    except OSError:
        with suppress(OSError):
            beside.unlink()
