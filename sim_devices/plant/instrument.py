"""The physical instrument in a hand: demands in, voltages and truth out. Time starts at 0 ns and never goes back."""

from __future__ import annotations

import math
from collections import deque
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from sim_devices.config import EmulationConfig
from sim_devices.plant.body_motion import BodyMotion
from sim_devices.plant.hand import Hand
from sim_devices.plant.kernel import (
    NOISES,
    SLOW_NOISES,
    STEP_NS,
    STEPS_PER_MS,
    TRUTH,
    TRUTH_COLUMNS,
    advance,
    begin,
    outputs_later,
    truth_row,
)
from sim_devices.plant.more_axes import MoreAxes
from sim_devices.plant.stack_twin import StackTwins, move_tips
from sim_devices.plant.streams import stream
from sim_devices.plant.unit import build_unit, plant_arrays

BLOCK_MS = 16
_BLOCK_STEPS = BLOCK_MS * STEPS_PER_MS
_CHUNK_ROWS = 256 * BLOCK_MS


class Instrument:
    """Simulates one instrument in one hand for one run.

    ``unit`` (default ``seed``) draws the physical instrument, ``seed`` its noise; ``hand`` must be fresh.
    ``quiet`` leaves all sensor, DAQ and room noise out (a twin for arrays); ``twins`` move in place of the stacks (in
    ``truth``, not in ``truth_row``). Steps are 1/8 ms: between steps demands
    count from their own instant on, and outputs follow their RC filters. Truth is recorded each millisecond, the
    first row at 0.
    """

    def __init__(
        self,
        config: EmulationConfig,
        seed: int,
        hand: Hand,
        *,
        unit: int | None = None,
        quiet: bool = False,
        twins: StackTwins | None = None,
    ) -> None:
        self.unit = build_unit(config, seed if unit is None else unit)
        self._plant, self._state = plant_arrays(config, self.unit, hand.frame)
        self._hand, self._quiet, self._twins = hand, quiet, twins
        self._supply_V = float(self._plant[0]["supply_V"])
        self._tip_m = np.array(config.instrument.tip_mm) * 1e-3
        self._rng = stream(seed, "instrument.noise")
        self._nodes, self._parts = np.zeros((BLOCK_MS + 1, 18)), np.zeros((BLOCK_MS, 6))
        self._noise, self._slow = np.zeros((_BLOCK_STEPS, NOISES)), np.zeros((BLOCK_MS, SLOW_NOISES))
        self._block = self._nodes, self._parts, self._noise, self._slow
        self._part = np.zeros(6)
        keep = None if config.truth_s is None else 1 + math.ceil(config.truth_s * 1000 / _CHUNK_ROWS)
        self._chunks: deque[Array] = deque(maxlen=keep)
        self._forgotten = 0  # rows
        self._chunk, self._row = np.zeros((_CHUNK_ROWS, TRUTH_COLUMNS)), 1
        hand.start(self._nodes[-1], self._part)
        begin(self._plant, self._state, self._nodes[-1], self._part, self._chunk[0])
        self._more = MoreAxes(config.more_axes, config.sensors, seed) if config.more_axes else None
        self._steps, self._in_block = 0, _BLOCK_STEPS
        self._t_ns = 0
        s = self._state[0]
        self._demand_V, self._demand_fix_V = s["demand_V"], s["demand_fix_V"]
        self._daq_V, self._magnetometer_V = s["daq_V"], s["magnetometer_V"]
        self._stack_V = s["channel"]["stack_V"]

    @property
    def now_ns(self) -> int:
        """Return the plant time in ns that the simulation has reached."""
        return self._t_ns

    def advance_to(self, t_ns: int) -> None:
        """Let the world run to ``t_ns``; a time in the past does nothing."""
        if t_ns <= self._t_ns:
            return
        self._t_ns = t_ns
        steps = t_ns // STEP_NS - self._steps
        while steps > 0:
            if self._in_block == _BLOCK_STEPS:
                self._next_block()
            stop = min(self._in_block + steps, _BLOCK_STEPS)
            steps -= stop - self._in_block
            self._steps += stop - self._in_block
            self._row = advance(
                self._plant,
                self._state,
                self._block,
                (self._in_block, stop),
                self._chunk,
                self._row,
            )
            self._in_block = stop

    def set_demand_V(self, channel: int, volts: float, t_ns: int) -> None:
        """Amplifier ``channel`` (0, 1, 2) is asked for ``volts`` from ``t_ns`` on (from now, if that has passed).

        Not limited here: the amplifier limits itself.
        """
        self.advance_to(t_ns)
        left = ((self._steps + 1) * STEP_NS - max(t_ns, self._steps * STEP_NS)) / STEP_NS
        # the running step sees the mean of its demands
        self._demand_fix_V[channel] += (1.0 - left) * (self._demand_V[channel] - volts)
        self._demand_V[channel] = volts
        if self._twins is not None:
            self._twins.demand(channel, volts, max(t_ns, self._steps * STEP_NS))

    @property
    def analog_V(self) -> Array:
        """Return the volts (8,) at the DAQ inputs now: a1x, a1z, a2y, a2z, a3x, a3y, supply / 2, TMP36. Changes as time
        goes on."""
        self._now()
        return self._daq_V if self._more is None else self._more.volts(self._daq_V, self.motion(), self._t_ns)

    @property
    def magnetometer_V(self) -> Array:
        """Return the HMC-2003 outputs (3,) in V now. They change as time goes on."""
        self._now()
        return self._magnetometer_V

    @property
    def stack_V(self) -> Array:
        """(3,) at the terminals of the stacks at the last step."""
        return self._stack_V

    def strap(self, pulse: Literal["set", "reset"]) -> None:
        """A pulse on the magnetometer's set/reset strap: ``reset`` turns the sign of its sensitivity."""
        if pulse not in ("set", "reset"):
            raise ValueError(f"strap pulse {pulse!r}: it is 'set' or 'reset'")
        self._state[0]["strap"] = 1.0 if pulse == "set" else -1.0
        outputs_later(self._plant, self._state, 0.0)

    def sag_supply(self, part: float) -> None:
        """Scale the sensors' supply to ``part`` of its original value from the next step on (fault hook)."""
        self._plant[0]["supply_V"] = self._supply_V * part

    def hush(self) -> None:
        """Switch all noise off from now on. The hand continues."""
        self._quiet = True
        self._noise[:] = 0.0
        self._slow[:] = 0.0

    def motion(self) -> BodyMotion:
        """Return the motion of the body at the last step.

        The specific force is that at the neutral tip (``InstrumentConfig.tip_mm``)."""
        p, s = self._plant[0], self._state[0]
        attitude = s["attitude"].copy()
        force = (s["pose"][12:15] + np.array([0.0, 0.0, p["gravity"]])) @ attitude
        rate, alpha = s["rate"].copy(), s["angular_acceleration"].copy()
        field_uT = p["field_G"] * 100.0
        return BodyMotion(attitude, rate, force, alpha, self._tip_m, field_uT, float(s["temperature_C"]))

    @property
    def clipped(self) -> NDArray[np.int64]:
        """(6,) steps of 1/8 ms in which an accelerometer was out of range."""
        return self._state[0]["clipped"].copy()

    def truth_row(self) -> dict[str, Array]:
        """Return the truth at the last step by the names and units of ``truth``; intended and tremor are those of the
        last millisecond."""
        row = np.zeros(TRUTH_COLUMNS)
        part = self._parts[(self._in_block // STEPS_PER_MS) - 1] if self._in_block >= STEPS_PER_MS else self._part
        truth_row(self._plant[0], self._state[0], part, row)
        return {name: row[at : at + n] for name, at, n in TRUTH}

    def truth(self) -> dict[str, NDArray]:
        """Return columns with one row per millisecond: ``t_ns`` (n,) int64, ``tip_m`` (n, 3) and so on
        (kernel.TRUTH)."""
        rows = np.concatenate([*self._chunks, self._chunk[: self._row]])
        numbers = self._forgotten + np.arange(len(rows), dtype=np.int64)
        columns: dict[str, NDArray] = {"t_ns": numbers * 1_000_000}
        for name, at, n in TRUTH:
            columns[name] = rows[:, at] if n == 1 else rows[:, at : at + n]
        if self._twins is not None:
            strokes = self._twins.strokes_m(columns["t_ns"], columns["temperature_C"])
            columns["tip_m"] = np.empty((len(rows), 3))
            attitude, rigid = (np.ascontiguousarray(columns[k]) for k in ("quaternion", "tip_rigid_m"))
            move_tips(self._plant, strokes, attitude, rigid, columns["tip_m"])
            columns["stroke_m"] = strokes + self._plant[0]["channel"]["reference_m"]
        return columns

    def _now(self) -> None:
        """Bring the voltages from the last step to the present instant."""
        later_ns = self._t_ns - self._steps * STEP_NS
        if later_ns:
            outputs_later(self._plant, self._state, later_ns * 1e-9)

    def _next_block(self) -> None:
        if self._row + BLOCK_MS > _CHUNK_ROWS:
            if len(self._chunks) == self._chunks.maxlen:
                self._forgotten += len(self._chunks[0])
                if self._twins is not None:
                    self._twins.forget(self._forgotten * 1_000_000)
            self._chunks.append(self._chunk[: self._row])
            self._chunk, self._row = np.zeros((_CHUNK_ROWS, TRUTH_COLUMNS)), 0
        self._nodes[0] = self._nodes[-1]
        self._part[:] = self._parts[-1] if self._steps else self._part
        self._hand.fill(self._nodes[1:], self._parts)
        if not self._quiet:
            self._rng.standard_normal(out=self._noise)
            self._rng.standard_normal(out=self._slow)
        self._in_block = 0
