"""Checks each input of a scan for physically impossible counts, before the motion that they indicate is used.

Six axes and six unknowns leave no parity while the instrument moves (erratum 15). Three facts remain: a sensor
behind its 15.2 Hz filter cannot jump, it is never without noise, and it stays off the rails. In addition, the slow
parts of axes that point the same way at two places must agree, because turning hands do not accelerate for long.
Natural figures (three hands, nine runs of 15 s): second differences reach 2.8 mV; parallel axes never differ by more
than 5 times their spread plus 0.07 m/s^2 (z: 0.016). A hand hardly turns the instrument about its own axis: what the
two long pairs (x and y, 116 mm apart) say of the other turns explains the difference of the short one (z, 20 mm) to its
noise (nine runs of 56 s:
0.0095 m/s^2 rms whatever the hand, never beyond 0.043; with the turns 0.030 and 0.146 in a rough hand).
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Annotated, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from firmware_py.frame import ACCELEROMETER, LAYOUT
from firmware_py.records import Records, attributes, field, new, record
from hal.arrays import Array, IntArray
from hal.compiled import kernel
from hal.validation import StrictTable

SENSORS = 6
PAIRS = ((0, 4, "x"), (1, 3, "z"), (2, 5, "y"))
"""Pairs of indices into AXES whose sensors point along one body axis: 1x and 3x, 1z and 2z, 2y and 3y."""


Rail = Annotated[float, Field(ge=-10.0, le=10.0)]
Step = Annotated[float, Field(ge=0.001, le=50.0)]


class PlausibilityLimits(StrictTable):
    """Sets limits that no healthy sensor exceeds. ``jump_V`` is per tick; a step of 1 g gives 0.09 V behind the filter.

    ``outlier_V`` limits the second difference of an accelerometer's readings, ``magnetometer_outlier_V`` that of the
    magnetometer's (10 ms apart), ``supply_step_V`` the change of the supply's reading from tick to tick; a reading
    beyond these three is noticed only.
    ``pair_m_s2``: parallel axes may not differ by more than this on average over ``pair_s``. A sudden difference,
    relative to their mean over ``pair_memory_s``, is noticed from ``pair_step_m_s2`` on (x and y: 1.3 rad/s^2 over the
    distance of the two; z: 6 rad/s^2 about the instrument) plus PAIR_SPREADS times their spread.
    """

    jump_V: float = Field(default=0.03, ge=0.001, le=5.0)
    rail_V: tuple[Rail, Rail] = (0.4, 4.6)
    stuck_ticks: int = Field(default=20, ge=5, le=10_000)
    pair_m_s2: float = Field(default=0.6, ge=0.01, le=50.0)
    pair_s: float = Field(default=0.1, ge=0.02, le=10.0)
    outlier_V: float = Field(default=0.005, ge=0.0005, le=5.0)
    supply_step_V: float = Field(default=0.004, ge=0.0005, le=5.0)
    magnetometer_outlier_V: float = Field(default=0.01, ge=0.0005, le=5.0)
    pair_step_m_s2: tuple[Step, Step, Step] = (0.15, 0.03, 0.15)
    pair_memory_s: float = Field(default=5.0, ge=0.1, le=1000.0)

    @model_validator(mode="after")
    def _rails_in_order(self) -> PlausibilityLimits:
        if not self.rail_V[0] < self.rail_V[1]:
            raise ValueError(f"rail_V = {list(self.rail_V)}: the first value must be the smaller one")
        return self


NO_SLOPE = 1 << 40
TICK_S = 0.001
SPREAD_S = 1.0
PAIR_SPREADS = 6.0
TOGETHER_V = 0.0008
"""Second difference from which an input counts as stepping together with others. A supply that sags by 1 % bends every
axis by 1 to 2 mV within two scans; noise bends each its own way, by 0.4 mV rms."""
TOGETHER_TICKS = 100
SQUARE = 0.5  # smallest sine of the angle between two levers that can be solved for
PAIR_PLACES = np.array([(i, j) for i, j, _ in PAIRS])


class Implausible(IntEnum):
    """Names the fault of an input."""

    NONE = 0
    RAIL = 1
    JUMP = 2
    STUCK = 3


WORDS = {
    Implausible.RAIL: "is at the end of its range; broken wire or short circuit",
    Implausible.JUMP: "jumped faster than its filter allows; "
    "loose contact, crossed wires, a damaged transfer or a blow",
    Implausible.STUCK: "has repeated one reading {n} times; the sensor or the converter is stuck",
}


@record
class CheckState:
    """The checks' memory of ``n`` inputs and of the pairs of axes."""

    tick: int = field("1")  # last one that was checked, -1 before the first
    looks: int = field("1")  # how often pairs were checked
    counts: IntArray = field("counts", "n")  # of this scan, in the order of the inputs
    last: IntArray = field("counts", "n")
    same: IntArray = field("1", "n")  # how often ``last`` has come in a row, -1 before the first scan
    slope: IntArray = field("counts", "n")  # last change or NO_SLOPE
    odd: IntArray = field("1", "n")  # readings out of line: a second difference beyond ``outlier``, a supply's step
    together: int = field("1")  # scans since all but three of the noisy inputs bent the same way at once
    window: Array = field("m/s^2", "window", 3)  # ring of the pairs' last differences
    sums: Array = field("m/s^2", 3)  # of the window
    usual: Array = field("m/s^2", 3)  # slow mean of the differences
    spread: Array = field("m/s^2", 3)  # slow mean of their distance from ``usual``


@record
class CheckParams:
    """The limits. Only the first ``noisy`` inputs can be stuck."""

    order: IntArray = field("1", "n")  # places in a scan of the inputs
    noisy: int = field("1")
    jump: int = field("counts")
    outlier: int = field("counts")
    supply_step: int = field("counts")
    low: int = field("counts")
    high: int = field("counts")
    stuck: int = field("1")
    together: int = field("counts")  # second difference from which an input bends
    places: IntArray = field("1", 3, 2)
    mix: Array = field("1", 3, 3)  # see ``turns_of_pairs``
    pair_step: Array = field("m/s^2", 3)
    pair_limit: float = field("m/s^2")
    pair_memory: float = field("1")
    spread_memory: float = field("1")


@kernel
def check_counts(tick: int, state: CheckState, params: CheckParams) -> int:
    """Check the ``counts`` of scan ``tick``. Return 16 * channel + Implausible of the first impossible input, else
    0."""
    counts, last, same, slope, odd, noisy = state.counts, state.last, state.same, state.slope, state.odd, params.noisy
    steps = tick - state.tick if state.tick >= 0 else 1  # ticks since the last scan that was seen
    state.tick = tick
    found, up, down = 0, 0, 0
    state.together += steps
    first = same[0] < 0
    for i in range(len(counts)):
        c = counts[i]
        if first:
            same[i] = 0
        elif c == last[i]:
            same[i] += 1
        else:
            same[i] = 0
        if found == 0:
            if c <= params.low or c >= params.high:
                found = 16 * i + 1
            elif not first and abs(c - last[i]) > params.jump * steps:
                found = 16 * i + 2
            elif i < noisy and same[i] >= params.stuck:
                found = 16 * i + 3
        if first or steps != 1:
            slope[i] = NO_SLOPE
        else:
            change = c - last[i]
            if i < noisy:
                odd[i] += slope[i] != NO_SLOPE and abs(change - slope[i]) > params.outlier
                up += slope[i] != NO_SLOPE and change - slope[i] > params.together
                down += slope[i] != NO_SLOPE and slope[i] - change > params.together
            elif i == noisy:
                odd[i] += abs(change) > params.supply_step
            slope[i] = change
        last[i] = c
    if max(up, down) >= noisy - 3:
        state.together = 0
    return found


def turns_of_pairs(positions_m: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3, 3) combinations of the pairs' differences to watch. Each pair is watched as it is, but from the
    pair with the shortest lever the turns across the instrument that the other two measure are subtracted.
    ``positions_m``, ``axes`` (6, 3): order of AXES.

    A difference is (r_i - r_j) x s . alpha (docs/references.md); alpha along z, the instrument, is taken for 0.
    """
    mix = np.eye(len(PAIRS))
    lever = np.array([np.cross(positions_m[i] - positions_m[j], axes[i])[:2] for i, j, _ in PAIRS])
    short = int(np.linalg.norm(lever, axis=1).argmin())
    long = [k for k in range(len(PAIRS)) if k != short]
    if abs(np.linalg.det(lever[long])) > SQUARE * float(np.linalg.norm(lever[long], axis=1).prod()):
        weights = cast("NDArray[np.float64]", np.linalg.solve(lever[long].T, lever[short]))
        if float(np.abs(weights).max()) < 1.0:  # else the others' noise is more than is gained
            mix[short, long] = -weights
    return mix


@kernel
def check_pairs(frame: Array, state: CheckState, params: CheckParams) -> int:
    """Return the number (from 1) of a pair that disagrees permanently, minus the number of a pair that has come apart
    suddenly, else 0."""
    window, sums, usual, spread, looks = state.window, state.sums, state.usual, state.spread, state.looks
    places, mix = params.places, params.mix
    state.looks += 1
    n = window.shape[0]
    row = looks % n
    found = 0
    for k in range(len(places)):
        apart = 0.0
        for m in range(len(places)):
            apart += mix[k, m] * (frame[ACCELEROMETER + places[m, 0]] - frame[ACCELEROMETER + places[m, 1]])
        sums[k] += apart - window[row, k]
        window[row, k] = apart
        if looks < n:
            usual[k] = sums[k] / (looks + 1)
            continue
        off = abs(apart - usual[k])
        if abs(sums[k]) > params.pair_limit * n:
            if found <= 0:
                found = k + 1
        elif found == 0 and looks > 4 * n and off > params.pair_step[k] + PAIR_SPREADS * spread[k]:
            found = -(k + 1)
        usual[k] += (apart - usual[k]) * params.pair_memory
        spread[k] += (off - spread[k]) * params.spread_memory
    return found


class CheckMemory(NamedTuple):
    """Holds what compiled code checks with, each a one-element array."""

    state: Records[CheckState]
    params: Records[CheckParams]


@kernel
def check_scan(row: NDArray[np.int16], tick: int, memory: CheckMemory) -> int:
    """Run ``check_counts`` on scan ``tick``, whose counts are ``row``, as ``ScanCheck.scan`` does."""
    state, params = memory.state[0], memory.params[0]
    for i in range(len(params.order)):
        state.counts[i] = row[params.order[i]]
    return check_counts(tick, state, params)


@kernel
def check_frame(frame: Array, memory: CheckMemory) -> int:
    """Run ``check_pairs`` on ``frame``, as ``ScanCheck.pairs`` does."""
    return check_pairs(frame, memory.state[0], memory.params[0])


class ScanCheck:
    """Checks every scan before it is used.

    ``columns``: places in a scan of the ``sensors`` accelerometer axes (AXES order), then of the supply and the
    temperature where they are wired; ``labels`` names them for people; ``mix``: see ``turns_of_pairs``.
    """

    def __init__(
        self,
        limits: PlausibilityLimits,
        lsb_V: float,
        columns: Sequence[int],
        labels: Sequence[str],
        *,
        sensors: int = SENSORS,
        mix: NDArray[np.float64] | None = None,
    ) -> None:
        self.channel = -1
        """Index of the input that the last finding is about, -1 before."""
        self._ignored: list[int] = []
        self._sensors = sensors
        self._supply = sensors if len(columns) > sensors else None
        self.limits = limits
        self._labels = tuple(labels)
        n = len(columns)
        self._seen_total = 0

        def counts(volts: float) -> int:
            return round(volts / lsb_V)

        sizes = {"n": n, "window": max(2, round(limits.pair_s / TICK_S))}
        self.memory = CheckMemory(
            new(CheckState, sizes, tick=-1, same=np.full(n, -1), slope=np.full(n, NO_SLOPE), together=NO_SLOPE),
            new(
                CheckParams,
                order=np.array(columns, dtype=np.int64),
                noisy=sensors,
                jump=counts(limits.jump_V),
                outlier=counts(limits.outlier_V),
                supply_step=counts(limits.supply_step_V),
                low=counts(limits.rail_V[0]),
                high=counts(limits.rail_V[1]),
                stuck=limits.stuck_ticks,
                together=counts(TOGETHER_V),
                places=PAIR_PLACES,
                mix=np.eye(len(PAIRS)) if mix is None else mix,
                pair_step=limits.pair_step_m_s2,
                pair_limit=limits.pair_m_s2,
                pair_memory=TICK_S / limits.pair_memory_s,
                spread_memory=TICK_S / SPREAD_S,
            ),
        )
        self._record, self._limits = self.memory.state[0], self.memory.params[0]
        self._state: CheckState = attributes(self.memory.state)[0]
        self._counts, self._last, self._odd = self._state.counts, self._state.last, self._state.odd
        self._order, self._jump = self.memory.params["order"][0], counts(limits.jump_V)
        self._middle = (counts(limits.rail_V[0]) + counts(limits.rail_V[1])) // 2
        self._pair_code = 0
        self._load_kernels()

    def _load_kernels(self) -> None:
        """Compile or load the kernels before the first scan arrives. The state does not change."""
        state = cast("Records[CheckState]", np.array(self.memory.state))
        check_counts(0, state[0], self._limits)
        check_pairs(np.zeros(LAYOUT.size), state[0], self._limits)

    def scan(self, row: NDArray[np.int16], tick: int) -> str:
        """Check the counts of scan ``tick``. Return an empty string, or a message that says what is wrong."""
        counts, last = self._counts, self._last
        counts[:] = row[self._order]
        for channel in self._ignored:
            counts[channel] = self._quiet(tick)
        supply = self._supply
        supply_before = 0 if supply is None else int(last[supply])
        found = check_counts(tick, self._record, self._limits)
        if not found:
            return ""
        channel, finding = divmod(found, 16)
        self.channel = channel
        if supply is not None and supply_before and abs(int(counts[supply]) - supply_before) > self._jump // 2:
            # the sensors are ratiometric: all of them follow their supply
            return f"{self._labels[supply]} jumped; check the sensors' supply, its wire and the DAQ's line"
        return f"{self._labels[channel]} {WORDS[Implausible(finding)].format(n=self.limits.stuck_ticks)}"

    def ignore(self, channel: int) -> None:
        """Treat ``channel`` as healthy from now on, whatever it reads."""
        self._ignored.append(channel)
        self._last[channel], self._state.slope[channel] = self._quiet(self._state.tick), NO_SLOPE

    def _quiet(self, tick: int) -> int:
        return self._middle + tick % 2

    @property
    def stepped_together(self) -> bool:
        """True if, within the last ``TOGETHER_TICKS``, nearly all axes bent the same way at once, as they do when their
        supply steps."""
        return bool(self._state.together <= TOGETHER_TICKS)

    def odd(self) -> str:
        """Return a message about an input that was out of line since the last call, or an empty string. Such a reading
        does not end a run."""
        if self._pair_code:
            i, j, axis = PAIRS[self._pair_code - 1]
            self._pair_code = 0
            return f"{self._labels[i]} and {self._labels[j]} came apart along {axis}"
        total = int(self._odd.sum())
        if total == self._seen_total:
            return ""
        self._seen_total = total
        worst = int(self._odd.argmax())
        if worst == self._supply:
            return f"{self._labels[worst]} stepped"
        return f"{self._labels[worst]} read a value out of line with its neighbours"

    def pairs(self, frame: NDArray[np.float64]) -> str:
        """Check the difference of parallel axes, every tick. Return an empty string, or a message that names two axes
        that disagree permanently; ``odd`` reports sudden differences.

        The mean over 0.1 s leaves out most of a tremor. A difference that has lasted for seconds comes from
        calibration, or was there before; a new difference is a drift or a blow.
        """
        return self.judge_pairs(check_pairs(frame, self._record, self._limits))

    def judge_pairs(self, found: int) -> str:
        """Return the message of what ``check_pairs`` found, as ``pairs`` does."""
        if found == 0:
            return ""
        if found < 0:
            self._pair_code = -found
            return ""
        i, j, axis = PAIRS[found - 1]
        apart = self._state.sums[found - 1] / len(self._state.window)
        return (
            f"{self._labels[i]} and {self._labels[j]} disagree by {apart:.2f} m/s^2 along {axis}: "
            "one of them has drifted or is calibrated wrongly"
        )
