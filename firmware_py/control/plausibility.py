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
from pydantic import BaseModel, ConfigDict, Field, model_validator

from firmware_py.frame import ACCELEROMETER, LAYOUT
from hal.compiled import kernel

SENSORS = 6
PAIRS = ((0, 4, "x"), (1, 3, "z"), (2, 5, "y"))
"""Pairs of indices into AXES whose sensors point along one body axis: 1x and 3x, 1z and 2z, 2y and 3y."""


Rail = Annotated[float, Field(ge=-10.0, le=10.0)]
Step = Annotated[float, Field(ge=0.001, le=50.0)]


class PlausibilityLimits(BaseModel):
    """Sets limits that no healthy sensor exceeds. ``jump_V`` is per tick; a step of 1 g gives 0.09 V behind the filter.

    ``outlier_V`` limits the second difference of an accelerometer's readings, ``magnetometer_outlier_V`` that of the
    magnetometer's (10 ms apart), ``supply_step_V`` the change of the supply's reading from tick to tick; a reading
    beyond these three is noticed only.
    ``pair_m_s2``: parallel axes may not differ by more than this on average over ``pair_s``. A sudden difference,
    relative to their mean over ``pair_memory_s``, is noticed from ``pair_step_m_s2`` on (x and y: 1.3 rad/s^2 over the
    distance of the two; z: 6 rad/s^2 about the instrument) plus PAIR_SPREADS times their spread.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

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


@kernel
def check_counts(
    counts: NDArray[np.int16],
    noisy: int,
    last: NDArray[np.int64],
    same: NDArray[np.int64],
    slope: NDArray[np.int64],
    odd: NDArray[np.int64],
    together: NDArray[np.int64],
    steps: int,
    jump: int,
    outlier: int,
    supply_step: int,
    lo: int,
    hi: int,
    stuck: int,
) -> int:
    """Return 16 * channel + Implausible of the first impossible input, else 0. Only the first ``noisy`` can be stuck.

    ``last``, ``same`` (n,) are the state: the last counts (``same[0] < 0`` before the first scan) and how often they
    have come in a row. ``steps``: ticks since the last scan that was seen. ``slope`` (n,): last change or NO_SLOPE.
    ``odd`` (n,) counts readings out of line: a second difference beyond ``outlier``, a step of the supply.
    ``together`` (2,): scans since all but three of the noisy inputs bent the same way at once; how many counts that is.
    """
    found, up, down = 0, 0, 0
    together[0] += steps
    first = same[0] < 0
    for i in range(len(counts)):
        c = np.int64(counts[i])
        if first:
            same[i] = 0
        elif c == last[i]:
            same[i] += 1
        else:
            same[i] = 0
        if found == 0:
            if c <= lo or c >= hi:
                found = 16 * i + 1
            elif not first and abs(c - last[i]) > jump * steps:
                found = 16 * i + 2
            elif i < noisy and same[i] >= stuck:
                found = 16 * i + 3
        if first or steps != 1:
            slope[i] = NO_SLOPE
        else:
            change = c - last[i]
            if i < noisy:
                odd[i] += slope[i] != NO_SLOPE and abs(change - slope[i]) > outlier
                up += slope[i] != NO_SLOPE and change - slope[i] > together[1]
                down += slope[i] != NO_SLOPE and slope[i] - change > together[1]
            elif i == noisy:
                odd[i] += abs(change) > supply_step
            slope[i] = change
        last[i] = c
    if max(up, down) >= noisy - 3:
        together[0] = 0
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
def check_pairs(
    frame: NDArray[np.float64],
    places: NDArray[np.int64],
    mix: NDArray[np.float64],
    looks: int,
    window: NDArray[np.float64],
    sums: NDArray[np.float64],
    usual: NDArray[np.float64],
    spread: NDArray[np.float64],
    step: NDArray[np.float64],
    limit: float,
    memory: float,
    spread_memory: float,
) -> int:
    """Return the number (from 1) of a pair that disagrees permanently, minus the number of a pair that has come apart
    suddenly, else 0."""
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
        if abs(sums[k]) > limit * n:
            if found <= 0:
                found = k + 1
        elif found == 0 and looks > 4 * n and off > step[k] + PAIR_SPREADS * spread[k]:
            found = -(k + 1)
        usual[k] += (apart - usual[k]) * memory
        spread[k] += (off - spread[k]) * spread_memory
    return found


class PairState(NamedTuple):
    """Holds the state of ``check_pairs``. ``window`` (n, 3): ring of the last differences; ``sums`` (3,): their sums;
    ``usual`` and ``spread`` (3,): slow means of the differences and of their distance from ``usual``."""

    window: NDArray[np.float64]
    sums: NDArray[np.float64]
    usual: NDArray[np.float64]
    spread: NDArray[np.float64]


TICK, LOOKS = range(2)
"""Places in ``CheckMemory.words``: last tick that was checked, -1 before the first; how often pairs were checked."""


class CheckMemory(NamedTuple):
    """Holds all that ``check_scan`` and ``check_frame`` need. ``order``: places in a scan of the inputs; ``counts``:
    their last counts; ``limits``: the last six arguments of ``check_counts``; ``pair_limits``: those of
    ``check_pairs``."""

    words: NDArray[np.int64]
    order: NDArray[np.int64]
    counts: NDArray[np.int16]
    last: NDArray[np.int64]
    same: NDArray[np.int64]
    slope: NDArray[np.int64]
    odd: NDArray[np.int64]
    together: NDArray[np.int64]
    limits: NDArray[np.int64]
    noisy: NDArray[np.int64]
    pairs: PairState
    places: NDArray[np.int64]
    mix: NDArray[np.float64]
    pair_step: NDArray[np.float64]
    pair_limits: NDArray[np.float64]


@kernel
def steps_since(words: NDArray[np.int64], tick: int) -> int:
    """Note that scan ``tick`` is checked. Return the ticks since the one before, 1 for the first."""
    steps = tick - words[TICK] if words[TICK] >= 0 else 1
    words[TICK] = tick
    return steps


@kernel
def check_scan(memory: CheckMemory, row: NDArray[np.int16], tick: int) -> int:
    """Run ``check_counts`` on scan ``tick``, whose counts are ``row``, as ``ScanCheck.scan`` does."""
    m, limits = memory, memory.limits
    for i in range(len(m.order)):
        m.counts[i] = row[m.order[i]]
    return check_counts(
        m.counts, m.noisy[0], m.last, m.same, m.slope, m.odd, m.together, steps_since(m.words, tick), limits[0],
        limits[1], limits[2], limits[3], limits[4], limits[5],
    )  # fmt: skip


@kernel
def check_frame(memory: CheckMemory, frame: NDArray[np.float64]) -> int:
    """Run ``check_pairs`` on ``frame``, as ``ScanCheck.pairs`` does."""
    m, p = memory, memory.pairs
    m.words[LOOKS] += 1
    return check_pairs(
        frame, m.places, m.mix, m.words[LOOKS] - 1, p.window, p.sums, p.usual, p.spread, m.pair_step, m.pair_limits[0],
        m.pair_limits[1], m.pair_limits[2],
    )  # fmt: skip


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
        volts = (limits.jump_V, limits.outlier_V, limits.supply_step_V, *limits.rail_V)
        self.memory = CheckMemory(
            np.array([-1, 0]), np.array(columns, dtype=np.int64), np.zeros(n, dtype=np.int16),
            np.zeros(n, dtype=np.int64), np.full(n, -1, dtype=np.int64), np.full(n, NO_SLOPE),
            np.zeros(n, dtype=np.int64), np.array([NO_SLOPE, round(TOGETHER_V / lsb_V)]),
            np.array([*(round(v / lsb_V) for v in volts), limits.stuck_ticks]), np.array([sensors]),
            PairState(
                np.zeros((max(2, round(limits.pair_s / TICK_S)), len(PAIRS))), *(np.zeros(len(PAIRS)) for _ in range(3))
            ),
            PAIR_PLACES, np.eye(len(PAIRS)) if mix is None else mix, np.array(limits.pair_step_m_s2),
            np.array([limits.pair_m_s2, TICK_S / limits.pair_memory_s, TICK_S / SPREAD_S]),
        )  # fmt: skip
        # handed over one by one, because a tuple of arrays costs each call 10 us
        self._limits, self._pair_limits = self.memory.limits.tolist(), self.memory.pair_limits.tolist()
        self._pair_code = 0
        self._load_kernels()

    def _load_kernels(self) -> None:
        """Compile or load the kernels before the first scan arrives. The state does not change."""
        m = self.memory
        last, same, slope, odd = (state.copy() for state in (m.last, m.same, m.slope, m.odd))
        steps_since(m.words.copy(), 0)
        check_counts(m.counts, self._sensors, last, same, slope, odd, m.together.copy(), 1, *self._limits)
        window, sums, usual, spread = (state.copy() for state in m.pairs)
        frame = np.zeros(LAYOUT.size)
        check_pairs(frame, m.places, m.mix, 0, window, sums, usual, spread, m.pair_step, *self._pair_limits)

    def scan(self, row: NDArray[np.int16], tick: int) -> str:
        """Check the counts of scan ``tick``. Return an empty string, or a message that says what is wrong."""
        memory = self.memory
        np.take(row, memory.order, out=memory.counts)
        for channel in self._ignored:
            memory.counts[channel] = self._quiet(tick)
        supply = self._supply
        supply_before = 0 if supply is None else int(memory.last[supply])
        found = check_counts(
            memory.counts, self._sensors, memory.last, memory.same, memory.slope, memory.odd, memory.together,
            steps_since(memory.words, tick), *self._limits,
        )  # fmt: skip
        if not found:
            return ""
        channel, finding = divmod(found, 16)
        self.channel = channel
        jump = self._limits[0]
        if supply is not None and supply_before and abs(int(memory.counts[supply]) - supply_before) > jump // 2:
            # the sensors are ratiometric: all of them follow their supply
            return f"{self._labels[supply]} jumped; check the sensors' supply, its wire and the DAQ's line"
        return f"{self._labels[channel]} {WORDS[Implausible(finding)].format(n=self.limits.stuck_ticks)}"

    def ignore(self, channel: int) -> None:
        """Treat ``channel`` as healthy from now on, whatever it reads."""
        self._ignored.append(channel)
        memory = self.memory
        memory.last[channel], memory.slope[channel] = self._quiet(int(memory.words[TICK])), NO_SLOPE

    def _quiet(self, tick: int) -> int:
        return (self._limits[3] + self._limits[4]) // 2 + tick % 2

    @property
    def stepped_together(self) -> bool:
        """True if, within the last ``TOGETHER_TICKS``, nearly all axes bent the same way at once, as they do when their
        supply steps."""
        return bool(self.memory.together[0] <= TOGETHER_TICKS)

    def odd(self) -> str:
        """Return a message about an input that was out of line since the last call, or an empty string. Such a reading
        does not end a run."""
        if self._pair_code:
            i, j, axis = PAIRS[self._pair_code - 1]
            self._pair_code = 0
            return f"{self._labels[i]} and {self._labels[j]} came apart along {axis}"
        total = int(self.memory.odd.sum())
        if total == self._seen_total:
            return ""
        self._seen_total = total
        worst = int(self.memory.odd.argmax())
        if worst == self._supply:
            return f"{self._labels[worst]} stepped"
        return f"{self._labels[worst]} read a value out of line with its neighbours"

    def pairs(self, frame: NDArray[np.float64]) -> str:
        """Check the difference of parallel axes, every tick. Return an empty string, or a message that names two axes
        that disagree permanently; ``odd`` reports sudden differences.

        The mean over 0.1 s leaves out most of a tremor. A difference that has lasted for seconds comes from
        calibration, or was there before; a new difference is a drift or a blow.
        """
        m, p = self.memory, self.memory.pairs
        looks = int(m.words[LOOKS])
        m.words[LOOKS] = looks + 1
        return self.judge_pairs(
            check_pairs(
                frame, m.places, m.mix, looks, p.window, p.sums, p.usual, p.spread, m.pair_step, *self._pair_limits
            )
        )

    def judge_pairs(self, found: int) -> str:
        """Return the message of what ``check_pairs`` found, as ``pairs`` does."""
        if found == 0:
            return ""
        if found < 0:
            self._pair_code = -found
            return ""
        i, j, axis = PAIRS[found - 1]
        pairs = self.memory.pairs
        apart = pairs.sums[found - 1] / len(pairs.window)
        return (
            f"{self._labels[i]} and {self._labels[j]} disagree by {apart:.2f} m/s^2 along {axis}: "
            "one of them has drifted or is calibrated wrongly"
        )
