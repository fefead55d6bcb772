"""Compiles ``i2c_shim.c``, which shows emulated I2C buses to unmodified programs as ``/dev/i2c-N`` (``LD_PRELOAD``)."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

from hal.compiled import user_cache
from hal.errors import BenchError

SOURCE = Path(__file__).with_suffix(".c")
COMPILE_S = 60.0


def build_shim() -> Path:
    """Return the compiled shim; the first call compiles it and later ones find it in the user's cache.

    Raises ``BenchError`` where there is no C compiler or no Linux.
    """
    if sys.platform != "linux":
        raise BenchError("programs see emulated I2C buses as /dev/i2c-N on Linux only; use the socket from Python")
    digest = hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:16]
    library = user_cache() / f"i2c_shim-{os.uname().machine}-{digest}.so"
    if library.exists():
        return library
    compiler = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise BenchError(
            "no C compiler, which /dev/i2c-N for unmodified programs needs once; install one (Debian and Ubuntu: "
            "apt install gcc libc6-dev), or use the bus's socket from Python"
        )
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        made = Path(folder) / library.name
        command = [compiler, "-O2", "-shared", "-fPIC", "-o", str(made), str(SOURCE), "-ldl", "-lpthread"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=COMPILE_S, check=False)
        if done.returncode:
            raise BenchError(
                f"{SOURCE.name} does not compile with {compiler}: {(done.stderr.strip() or 'no message')[-300:]}; "
                "on Debian and Ubuntu the headers are in libc6-dev"
            )
        made.replace(library)  # two first calls at once do not disturb each other
    return library


def number_buses(names: Iterable[str]) -> dict[str, int]:
    """Return the N of ``/dev/i2c-N`` for each bus: the number at the end of its name, if no other bus has the same
    one, else the lowest free one."""
    numbers: dict[str, int] = {}
    waiting: list[str] = []
    for name in names:
        digits = re.search(r"(\d{1,4})$", name)
        if digits and int(digits[1]) not in numbers.values():
            numbers[name] = int(digits[1])
        else:
            waiting.append(name)
    for name in waiting:
        numbers[name] = next(n for n in range(len(numbers) + 1) if n not in numbers.values())
    return numbers
