"""Text that ``micron run`` shows before and while it runs: the bench, and one line that moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.designs import design
from hal.bench import BenchFile, OpenBench
from hal.clock import Pace, VirtualClock
from sim_devices.lockstep_world import LockstepWorld
from tools.reports.figures import TREMOR_BAND_HZ

LOOK_NS = 10_000_000
"""Time between two looks at the tip: 100 Hz shows a tremor of 12 Hz."""
WINDOW_S = 1.0
"""Time constant of the rms that is shown."""

PACES: Mapping[Pace, str] = {
    "paced": "emulated time, one second per second; same result on every machine",
    "virtual": "emulated time, as fast as possible; same result on every machine",
    "realtime": "the wall clock; a 1 kHz loop in processes of its own",
}


def opening_lines(bench: BenchFile, seconds: float, pace: Pace, hand: str | None, seed: int | None) -> list[str]:
    """Describe the run that is about to start, in lines of at most 80 columns."""
    description = bench.description
    emulated, n_buses = len(description.emulated_buses()), len(description.bus)
    devices = "emulated devices" if emulated == n_buses else "real devices" if not emulated else "mixed devices"
    shown_seed = description.emulation.get("seed", 1) if seed is None else seed
    lines = [f"bench: {description.name}, {devices} on {', '.join(description.bus)}"]
    if emulated:
        lines.append(f"hand:  {hand or 'synthetic'}, seed {shown_seed}")
    lines.append(f"run:   {seconds:g} s after the self-test")
    lines.append(f"pace:  {PACES[pace]}")
    return [line if len(line) <= 80 else line[:79] + "…" for line in lines]


class TipWatch:
    """Tremor of the tip without and with compensation while an emulated bench runs, from the physical truth.

    ``attach`` it to a bench that is opened in emulated time; anywhere else it stays silent. It only looks: the world
    is not advanced and no result changes.
    """

    def __init__(self) -> None:
        rate_hz = 1e9 / LOOK_NS
        # scipy itself would cost every run a second at its start
        (self._sos,) = design("butter", 2, TREMOR_BAND_HZ, btype="bandpass", fs=rate_hz, output="sos")
        self._memory: NDArray[np.float64] | None = None
        self._power = np.zeros(2)
        self._forget = LOOK_NS * 1e-9 / WINDOW_S
        self._n = 0

    def attach(self, opened: OpenBench) -> None:
        """Look at the tip of ``opened`` every ``LOOK_NS`` of its time."""
        world, clock = opened.world, opened.clock
        if not isinstance(world, LockstepWorld) or not isinstance(clock, VirtualClock):
            return

        def look(t_ns: int) -> None:
            row = world.world.plant.truth_row()
            if "tip_rigid_m" not in row:  # an endoscope has no tip that trembles
                return
            self.add(np.concatenate([row["tip_rigid_m"], row["tip_m"]]))
            clock.at(t_ns + LOOK_NS, look)

        clock.at(clock.now_ns() + LOOK_NS, look)

    def add(self, tips_m: NDArray[np.float64]) -> None:
        """Add one sample (6,): the tip with the manipulator at rest, and the tip, in m."""
        if self._memory is None:
            self._memory = self._at_rest(tips_m)
        through = tips_m
        for (b0, b1, b2, _, a1, a2), memory in zip(self._sos, self._memory, strict=True):
            out = b0 * through + memory[0]
            memory[0] = b1 * through - a1 * out + memory[1]
            memory[1] = b2 * through - a2 * out
            through = out
        power = 1e12 * np.array([np.sum(through[:3] ** 2), np.sum(through[3:] ** 2)])
        self._n += 1
        self._power += max(self._forget, 1.0 / self._n) * (power - self._power)

    def _at_rest(self, tips_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the memory (sections, 2, 6) of the band-pass for a tip that was always at ``tips_m``."""
        memory, through = np.zeros((len(self._sos), 2, len(tips_m))), tips_m
        for (b0, b1, b2, _, a1, a2), kept in zip(self._sos, memory, strict=True):
            out = (b0 + b1 + b2) / (1.0 + a1 + a2) * through
            kept[1] = b2 * through - a2 * out
            kept[0] = b1 * through - a1 * out + kept[1]
            through = out
        return memory

    def rms_um(self) -> tuple[float, float] | None:
        """Return the tremor without and with compensation over about the last second, in um, or None before the
        first."""
        if self._n * LOOK_NS < WINDOW_S * 1e9:
            return None
        without, with_ = np.sqrt(self._power)
        return float(without), float(with_)


def live_line(status: Mapping[str, Any], seconds: float, watch: TipWatch) -> str:
    """Return one line of at most 80 columns: time, state, tremor without and with compensation, holds, time left."""
    t_s = status["t_s"]
    if hold := status.get("hold"):
        key = "Enter resumes" if hold["rearm"] == "operator" else ""
        return f"{t_s:6.1f} s  {key or 'holds'}: {hold['cause']}"[:80]
    tip = watch.rms_um()
    if tip is not None:
        tremor = f"tremor {tip[0]:5.1f} um without, {tip[1]:5.1f} with"
    else:
        tremor = f"tremor estimated {float(np.linalg.norm(status['amplitude_um'])):5.1f} um"
    holds = f"  holds {status['holds']}" if "holds" in status else ""
    lost = f"  LOST {status['lost']}" if status["lost"] else ""
    left_s = max(0.0, seconds - t_s)
    return f"{t_s:6.1f} s  {status['state']:<9} {tremor}{holds}{lost}  {left_s:.0f} s left"[:80]
