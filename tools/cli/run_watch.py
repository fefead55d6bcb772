"""Implements ``--watch`` of ``micron run`` and ``micron bench``: what it needs is checked before anything starts."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from firmware_py.endoscope.wiring import is_endoscope
from hal.bench import BenchFile
from tools.cli.mismatch_watch import check_rate
from tools.errors import InputError

if TYPE_CHECKING:
    from tools.mismatch.watch.frame import World
    from tools.mismatch.watch.live import Settings, Watching

REFERENCE_S = 300.0
"""Default length of the reference: a wander that it does not show raises alarms."""
SHORTEST_S, LONGEST_S = 15.0, 3600.0

WatchOption = Annotated[
    Path | None,
    typer.Option(
        metavar="TWIN.toml", help="Corrected twin that runs beside the instrument; you are told when reality leaves it."
    ),
]
ReferenceOption = Annotated[
    float | None,
    typer.Option(
        metavar="S", help=f"With --watch: length of the first part, in which the twin is good; default {REFERENCE_S:g}."
    ),
]
RateOption = Annotated[
    float | None,
    typer.Option(metavar="R", help="With --watch: false alarms per hour, of all channels together; default 0.01."),
]


def watch_settings(
    file: BenchFile, twin: Path | None, reference_s: float | None, rate: float | None, seconds: float | None = None
) -> Settings | None:
    """Return the request, None where nothing is to be watched. ``seconds``: length of the run, if it ends.

    InputError for options without ``--watch``, or figures that leave nothing to watch.
    """
    if twin is None:
        for name, value in (("--watch-reference", reference_s), ("--false-alarms-per-hour", rate)):
            if value is not None:
                raise InputError(f"{name} belongs to --watch TWIN.toml; give both or neither")
        return None
    if is_endoscope(file.description):
        raise InputError("--watch belongs to the instrument; the frame of an endoscope bench has no twin")
    from tools.mismatch.watch.live import Settings
    from tools.mismatch.watch.offline import PER_HOUR

    rate = PER_HOUR if rate is None else rate
    check_rate(rate)
    wanted_s = REFERENCE_S if reference_s is None else reference_s
    if not SHORTEST_S <= wanted_s <= LONGEST_S:
        raise InputError(f"--watch-reference {wanted_s:g}: must be {SHORTEST_S:g} to {LONGEST_S:g} s")
    if seconds is not None and seconds <= wanted_s:
        raise InputError(
            f"--seconds {seconds:g}: the first {wanted_s:g} s are the reference of --watch, and nothing would be left; "
            f"run longer, or give --watch-reference from {SHORTEST_S:g} s on"
        )
    return Settings(twin, wanted_s, rate)


def check_twin(settings: Settings, file: BenchFile) -> None:
    """Raise InputError or RecordingError for a twin that cannot run beside the bench."""
    from firmware_py.frame import LAYOUT
    from tools.mismatch.watch.frame import World, open_twin

    open_twin(settings.twin, file, LAYOUT.scalar_names(), World())


class RunWatch:
    """Holds the memory in which a run shows its rows, and the watch that reads it."""

    def __init__(self, settings: Settings, file: BenchFile, world: World, *, is_patient: bool) -> None:
        """``is_patient``: the run may wait for the watch, because no time of the bench passes meanwhile."""
        from firmware_py.frame import LAYOUT
        from firmware_py.live.memory import LiveMemory
        from tools.mismatch.watch.frame import open_twin
        from tools.mismatch.watch.live import LiveWatch

        twin = open_twin(settings.twin, file, LAYOUT.scalar_names(), world)
        self._watch = LiveWatch(twin, settings, is_patient=is_patient)
        self._memory = LiveMemory.create(LAYOUT.size)
        self._control, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.fds = (os.dup(self._memory.fd), other.detach())
        """Descriptors of the firmware's end of the link, which belong to the firmware."""
        self._row = 0

    def look(self, status: Mapping[str, Any]) -> None:
        """Take the rows that are new at a status of the run."""
        if "now_ns" in status and not self._watch.has_begun:
            self._watch.begin_at(status["now_ns"] * 1e-9 - status["t_s"])
        if self._watch.has_begun:
            rows = self._memory.read(self._row)
            self._row = rows.first + len(rows.values)
            self._watch.push(rows.values)

    def close(self) -> Watching:
        """Take the last rows, end, and return what was found."""
        self.look({})
        found = self._watch.close()
        self._memory.close()
        self._control.close()
        return found
