"""Reads a TOML file of unknown origin: its size and depth are bounded, and every number in it is finite."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

from hal.errors import BenchError

LARGEST_BYTES = 1 << 20
"""No bench or calibration file is longer; a device file such as /dev/zero has no end."""
DEEPEST = 20
LARGEST_INTEGER = (1 << 63) - 1  # TOML 1.0: 64 bits, signed


def read_text(path: Path, advice: str) -> str:
    """Return the text of a regular file of at most ``LARGEST_BYTES``. Otherwise raise ``BenchError`` with
    ``advice``."""
    try:
        if not path.is_file():
            what = "it is no regular file" if path.exists() else "it is not there"
            raise BenchError(f"{path}: cannot be read ({what}); {advice}")
        with path.open("rb") as file:
            data = file.read(LARGEST_BYTES + 1)
        if len(data) > LARGEST_BYTES:
            raise BenchError(f"{path}: cannot be read (longer than {LARGEST_BYTES} bytes); {advice}")
        return data.decode("utf-8-sig")
    except (OSError, ValueError) as error:  # ValueError: no UTF-8, or a zero byte in the name
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise BenchError(f"{str(path)!r}: cannot be read ({why}); {advice}") from error


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Return the table of ``text``. Raises ``BenchError`` when it is nested too deeply or a number is not finite.

    Raises ``tomllib.TOMLDecodeError`` when it is no TOML, because the caller knows what the file should be."""
    try:
        table = tomllib.loads(text)
        problems = [f"{where}: [{key}] {why}" for key, why in _no_numbers(table, ())]
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError as error:
        raise BenchError(f"{where}: not valid: tables or lists within one another more than {DEEPEST} deep") from error
    except ValueError as error:  # an integer of thousands of digits
        raise BenchError(f"{where}: not valid: {error}") from error
    if problems:
        raise BenchError("\n".join(problems[:5]))
    return table


def _no_numbers(value: Any, at: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    if len(at) > DEEPEST:
        raise RecursionError
    if isinstance(value, dict):
        for key, item in cast(dict[str, Any], value).items():
            yield from _no_numbers(item, (*at, key))
    elif isinstance(value, list):
        for k, item in enumerate(cast(list[Any], value)):
            yield from _no_numbers(item, (*at, str(k)))
    elif isinstance(value, float) and not math.isfinite(value):
        yield ".".join(at), f"{value} is not a finite number"
    elif isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        yield ".".join(at), "is larger than the 64 bits of a TOML integer"
