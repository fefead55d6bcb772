"""Runs a corrected twin beside the firmware of the page: one watch per run, and the last minute as a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.frame import LAYOUT
from firmware_py.layouts import layout_of
from hal.bench import BenchFile
from tools.bench.firmware import Choice
from tools.bench.history import History
from tools.errors import InputError

if TYPE_CHECKING:
    from tools.mismatch.watch.frame import LiveTwin
    from tools.mismatch.watch.live import LiveWatch, Settings

LAST_S = 60.0
"""Length of the recording that the button of the page diagnoses."""


class TwinWatch:
    """Holds the watch of a session. Without ``settings`` every call does nothing."""

    def __init__(self, settings: Settings | None) -> None:
        self._settings = settings
        self._twin: LiveTwin | None = None
        self._live: LiveWatch | None = None
        self._problem = ""
        self._is_own_world = False

    def begin(self, bench: BenchFile, choice: Choice) -> None:
        """Open the twin for the next run; takes a second the first time. A twin that does not fit is told on the
        page."""
        if self._settings is None:
            return
        from tools.errors import RecordingError
        from tools.mismatch.watch.frame import World, open_twin
        from tools.mismatch.watch.live import LiveWatch

        self._problem, self._is_own_world = "", choice.seed is None and choice.hand_file is None
        try:
            if layout_of(bench.description) is not LAYOUT:
                raise InputError("it belongs to the first instrument, and this bench is of another one")
            world = World(choice.seed, choice.hand_file, choice.hand_scale)
            self._twin = open_twin(self._settings.twin, bench, LAYOUT.scalar_names(), world)
        except (InputError, RecordingError) as error:
            self._problem = str(error)
            return
        self._live = LiveWatch(self._twin, self._settings, is_patient=False)

    def take(self, status: dict[str, Any], rows: NDArray[np.float64]) -> None:
        """Pass new rows on, from the first status of a run on."""
        if self._live is None:
            return
        if not self._live.has_begun and "now_ns" in status:
            self._live.begin_at(status["now_ns"] * 1e-9 - status["t_s"])
        if self._live.has_begun:
            self._live.push(rows)

    def end(self) -> None:
        """The run ended: no more rows come."""
        if self._live is not None:
            self._live.close()
            self._live = None

    def state(self) -> dict[str, Any] | None:
        """Return JSON values for the page, None where nothing is watched."""
        if self._live is not None:
            return self._live.state().to_json()
        return {"phase": "failed", "why": self._problem} if self._problem else None

    def alerts(self) -> list[tuple[str, str]]:
        """Return what the page says above all views: the first channel that left the twin."""
        if self._problem:
            return [("warn", f"The twin does not watch: {self._problem}")]
        if self._live is None:
            return []
        watching = self._live.state()
        if watching.phase == "failed":
            return [("warn", f"The twin does not watch: {watching.why}")]
        if not watching.alarms:
            return []
        first = watching.alarms[0]
        return [("warn", f"Reality leaves the twin: {first.channel}, since about {first.onset_s:.1f} s of the run.")]

    def write_last_minute(self, history: History, folder: Path) -> Path:
        """Write the newest ``LAST_S`` of the twin's channels as a recording. InputError where that cannot be."""
        from tools.mismatch.watch.last import write_recording

        twin = self._twin
        if self._settings is None or twin is None or self._live is None:
            raise InputError("no twin watches: start with micron bench --watch TWIN.toml, and start the firmware")
        if twin.needs_bench_time and not self._is_own_world:
            raise InputError("the run has a --seed or --hand of its own, which a recording for the engine cannot say")
        names = LAYOUT.scalar_names()
        columns = list(dict.fromkeys(twin.template.column.values()))
        t_s, values = history.newest(np.array([names.index(c) for c in columns], dtype=np.intp), LAST_S)
        write_recording(folder, self._settings.twin, twin, t_s, dict(zip(columns, values, strict=True)))
        return folder
