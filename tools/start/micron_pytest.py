"""The pytest plugin ``micron``: emulated devices in the tests of other projects, in virtual time.

It costs nothing until a fixture is used: what the fixtures need is imported by them. A project that has packages
``tools`` or ``hal`` of its own keeps them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from micron_start import put_ours_first

if TYPE_CHECKING:
    from tools.emulate.virtual import VirtualBench


@pytest.fixture
def micron_bench() -> Iterator[Callable[[str | Path], VirtualBench]]:
    """Open a bench in virtual time: ``micron_bench("imus")`` by the name of one that ships, or by its path."""
    opened: list[VirtualBench] = []

    def open_one(bench: str | Path) -> VirtualBench:
        put_ours_first()
        from tools.emulate.virtual import open_named

        opened.append(open_named(bench))
        return opened[-1]

    yield open_one
    for one in opened:
        one.close()


@pytest.fixture
def emulated() -> Iterator[Callable[..., VirtualBench]]:
    """Emulate one part alone: ``emulated("ad5696r", address=0x0C)``; further keywords are keys of its bench entry."""
    opened: list[VirtualBench] = []

    def open_one(part: str, **options: Any) -> VirtualBench:
        put_ours_first()
        from tools.emulate.virtual import open_part

        opened.append(open_part(part, **options))
        return opened[-1]

    yield open_one
    for one in opened:
        one.close()


@pytest.fixture
def stimulus() -> Callable[..., None]:
    """Put a constant or a column at an input: ``stimulus(bench, "imu.ax", 1.5)``, or ``values, rate_hz=1000``."""

    def put(bench: VirtualBench, channel: str, values: Any, rate_hz: float | None = None) -> None:
        bench.put(channel, values, rate_hz)

    return put


@pytest.fixture
def truth() -> Callable[..., dict[str, float]]:
    """Read what parts sense and put out: ``truth(bench, "ad5696r")``, or all of it without a name."""

    def read(bench: VirtualBench, name: str = "") -> dict[str, float]:
        return bench.read(name)

    return read
