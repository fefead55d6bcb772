"""Reads and writes the kernel's files below a root, which is ``/`` or a copy of another machine's tree."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Tree:
    """Holds the ``root`` of /dev, /proc and /sys. Names are relative to it."""

    root: Path = Path("/")

    def read(self, name: str) -> str | None:
        """Return the text of a file without the space around it, None where it is not there or cannot be read."""
        try:
            return (self.root / name).read_text(encoding="ascii", errors="replace").strip()
        except OSError:
            return None

    def write(self, name: str, text: str) -> None:
        """Write a file that is there. Raises ``OSError`` if it is not, or may not be written."""
        with open(os.open(self.root / name, os.O_WRONLY | os.O_TRUNC), "w", encoding="ascii") as file:
            file.write(text)

    def names(self, pattern: str) -> list[str]:
        """Return the names that match a pattern of ``Path.glob``, numbers in order."""
        found = [str(path.relative_to(self.root)) for path in self.root.glob(pattern)]
        return sorted(found, key=lambda name: [int(part) if part.isdigit() else part for part in _parts(name)])

    def is_there(self, name: str) -> bool:
        """Return True if the name exists."""
        return (self.root / name).exists()

    def may_write(self, name: str) -> bool:
        """Return True if this process may write the file."""
        return os.access(self.root / name, os.W_OK)

    def above(self, name: str, wanted: str) -> str | None:
        """Return the nearest folder at or above the place that ``name`` links to which has a file ``wanted``."""
        root = self.root.resolve()
        place = (self.root / name).resolve()
        while place != root and root in place.parents:
            if (place / wanted).exists():
                return str(place.relative_to(root))
            place = place.parent
        return None


MACHINE = Tree()
"""The machine that this program runs on."""


def _parts(name: str) -> list[str]:
    """Split into runs of digits and the rest, which alternate."""
    parts, digits = [""], False
    for letter in name:
        if letter.isdigit() != digits:
            digits = not digits
            parts.append("")
        parts[-1] += letter
    return parts


DMA_LATENCY = "dev/cpu_dma_latency"
_S32 = struct.Struct("=i")


def read_latency_limit_us(tree: Tree) -> int | None:
    """Return the wake-up latency, us, that all programs together allow the processors' idle states, None where the
    kernel has no such limit or does not let us read it. Source: Linux, Documentation/power/pm_qos_interface.rst."""
    try:
        with open(tree.root / DMA_LATENCY, "rb") as file:
            data = file.read(_S32.size)
    except OSError:
        return None
    return _S32.unpack(data)[0] if len(data) == _S32.size else None


def hold_latency_limit(tree: Tree, limit_us: int) -> Callable[[], None]:
    """Ask the kernel for idle states that end within ``limit_us``, 0 for none at all. The request lasts until the
    returned function is called or the process ends, however it ends. Raises ``OSError`` where that is not permitted."""
    descriptor = os.open(tree.root / DMA_LATENCY, os.O_WRONLY | os.O_CLOEXEC)
    try:
        os.write(descriptor, _S32.pack(limit_us))
    except OSError:
        os.close(descriptor)
        raise
    return lambda: os.close(descriptor)
