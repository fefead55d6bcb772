"""Hours of the closed loop in virtual time: what grows, what drifts, what is not counted.

Two forms: with all buses, drivers, supervision and guardian (about as fast as life), and without wires, tens of times
faster, for a whole shift. Both are scored by eighths of the run.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from firmware_py.app import run_in_process
from firmware_py.frame import QUATERNION, TICK
from firmware_py.run_request import RunRequest
from hal.arrays import Array
from hal.bench import OpenBench, load_bench
from hal.clock import VirtualClock
from sim_devices.plant.kernel import TRUTH
from tools.closed_loop.simulate import simulate

EIGHTHS = 8
PARTS = 8
"""Number of parts of an eighth, whose scatter says how much an eighth varies by chance."""
SETTLE_S = 5.0
BLOCK = 200  # ticks in which a mean is taken out: two periods of tremor
GROWTH_MB = 2.0
DRIFT = 0.25  # of the median part of the tremor that is left
CHANCE = 4.0  # standard errors of an eighth that a drift exceeds: of eight, one in 2000 does by chance
MARKS_NS = {"2^31": 2**31, "2^32": 2**32, "2^53": 2**53}
AT = {name: slice(at, at + n) for name, at, n in TRUTH}


@dataclass(frozen=True)
class LongRun:
    """``left_um``, ``tremor_um`` (8,): rms by eighths; ``tilt_mrad`` (8,) or None where the run does not say.
    ``memory_MB`` (8,): resident at the end of each eighth. ``scatter``: standard error of the part that is left in an
    eighth, relative to the median, from parts of eighths. ``marks``: those of bench time that the run crossed."""

    wires: bool
    seconds: float
    start_ns: int
    cpu_s: float
    left_um: list[float]
    tremor_um: list[float]
    tilt_mrad: list[float] | None
    memory_MB: list[float]
    scatter: float
    marks: list[str]
    counters: dict[str, Any]
    ended: str

    @property
    def growth_MB(self) -> float:
        """Return the growth from the end of the first eighth, when everything has been used once."""
        return max(self.memory_MB) - self.memory_MB[0]

    @property
    def drift(self) -> float:
        """Largest departure of the part that is left from its median, relative to it."""
        part = [left / tremor for left, tremor in zip(self.left_um, self.tremor_um, strict=True) if tremor > 0.0]
        middle = float(np.median(part)) if part else 1.0
        return max((abs(p - middle) / middle for p in part), default=0.0)

    def problems(self) -> list[str]:
        """Return what a run must not show, in words."""
        found: list[str] = []
        if self.growth_MB > GROWTH_MB:
            found.append(f"memory grew by {self.growth_MB:.1f} MB")
        if self.drift > max(DRIFT, CHANCE * self.scatter):
            found.append(f"what is left of the tremor varied by {100 * self.drift:.0f} %")
        if empty := sum(tremor == 0.0 for tremor in self.tremor_um):
            found.append(f"nothing was seen in {empty} of {EIGHTHS} eighths")
        if self.ended != "run finished":
            found.append(f"it ended with: {self.ended}")
        return found + [f"{name}: {value}" for name, value in self.counters.items() if name in MUST_BE_ZERO and value]

    def as_dict(self) -> dict[str, Any]:
        return {
            "format": 1,
            **{name: getattr(self, name) for name in self.__dataclass_fields__},
            "growth_MB": self.growth_MB,
            "drift": self.drift,
            "problems": self.problems(),
        }


MUST_BE_ZERO = (
    "samples not accounted for",
    "samples lost",
    "ticks skipped",
    "gaps in the tick count",
    "values that are not finite",
    "noticed",
)


def resident_MB() -> float:
    """Return the memory of this process after the allocator has released free memory, which comes in megabytes."""
    with contextlib.suppress(AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def up(quaternions: Array) -> Array:
    """(n, 3) the world's z axis in the body frame, of (n, 4) quaternions body to world (docs/references.md)."""
    w, x, y, z = quaternions.T
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=1)


@dataclass
class Eighths:
    """Sums over equal parts of a run of ``seconds``: what is left of the tremor, the tremor, error of the tilt."""

    seconds: float
    sums: Array = field(default_factory=lambda: np.zeros((EIGHTHS, PARTS, 4)))
    memory_MB: Array = field(default_factory=lambda: np.zeros(EIGHTHS))

    def add(self, t_s: float, left_m: Array, tremor_m: Array, tilt_rad: Array | None = None) -> None:
        """``left_m``, ``tremor_m`` (n, 3): of the tip, about ``t_s`` after the start; their mean is taken out."""
        at = min(EIGHTHS * PARTS - 1, int(t_s / self.seconds * EIGHTHS * PARTS))
        self.memory_MB[at // PARTS] = resident_MB()
        if t_s < SETTLE_S:
            return
        self.sums[at // PARTS, at % PARTS] += (
            len(left_m),
            np.sum((left_m - left_m.mean(0)) ** 2),
            np.sum((tremor_m - tremor_m.mean(0)) ** 2),
            0.0 if tilt_rad is None else np.sum(tilt_rad**2),
        )

    def rms(self, column: int, factor: float) -> list[float]:
        sums = self.sums.sum(axis=1)
        return (factor * np.sqrt(sums[:, column] / np.maximum(sums[:, 0], 1.0))).tolist()

    @property
    def scatter(self) -> float:
        """Return the standard error of the part of the tremor that is left in an eighth, relative to the median.

        It is 0 where no eighth has two parts that were seen: then nothing is excused.
        """
        left, tremor = self.sums[..., 1], self.sums[..., 2]
        parts = [np.sqrt(a[b > 0.0] / b[b > 0.0]) for a, b in zip(left, tremor, strict=True)]
        errors = [float(np.var(p, ddof=1)) / p.size for p in parts if p.size > 1]
        return math.sqrt(sum(errors) / len(errors)) / float(np.median(np.concatenate(parts))) if errors else 0.0


def with_wires(
    bench: Path, seconds: float, *, start_ns: int = 0, on_time: Callable[[float], None] = lambda _: None
) -> LongRun:
    """The whole instrument on its buses for ``seconds`` from ``start_ns`` on the bench clock."""
    eighths, opened, began_s = Eighths(seconds), list[OpenBench](), time.process_time()

    def look(status: dict[str, Any]) -> None:
        t_s = float(status["t_s"])
        clock = cast(VirtualClock, opened[0].clock)
        truth = cast(Any, opened[0].world).world.truth(clock.now_ns())
        last = {name: truth[name][-BLOCK:] for name in ("tip_m", "tip_rigid_m", "intended_m")}
        if len(last["tip_m"]) == BLOCK:
            eighths.add(t_s, last["tip_m"] - last["intended_m"], last["tip_rigid_m"] - last["intended_m"])
        on_time(t_s)

    request = RunRequest(bench, seconds, pace="virtual", truth_s=2.0, clock_start_ns=start_ns)
    outcome, truth = run_in_process(request, look, on_open=opened.append)
    assert truth is not None
    samples, ticks = outcome["samples"], outcome["ticks"]
    return LongRun(
        wires=True,
        seconds=seconds,
        start_ns=start_ns,
        cpu_s=time.process_time() - began_s,
        left_um=eighths.rms(1, 1e6),
        tremor_um=eighths.rms(2, 1e6),
        tilt_mrad=None,
        memory_MB=eighths.memory_MB.tolist(),
        scatter=eighths.scatter,
        marks=[name for name, ns in MARKS_NS.items() if start_ns < ns < int(truth["t_ns"][-1])],
        counters={
            "samples received": samples["received"],
            "samples lost": samples["lost"],
            "samples not accounted for": samples["expected"] - samples["received"] - samples["lost"],
            "ticks run": ticks["run"],
            "ticks skipped": ticks["skipped"],
            "commands sent": outcome["commands"]["sent"],
            "noticed": len(outcome["noticed"]),
        },
        ended=str(outcome["safe_state"]["reason"]),
    )


def without_wires(bench: Path, seconds: float, *, on_time: Callable[[float], None] = lambda _: None) -> LongRun:
    """Plant and firmware in one compiled loop for ``seconds``; bytes, buses and supervision are not in it."""
    eighths, began_s = Eighths(seconds), time.process_time()
    counted = {"ticks run": 0, "gaps in the tick count": 0, "values that are not finite": 0}

    def see(truth: Array, frames: Array) -> None:
        n, done = len(frames), counted["ticks run"]
        counted["gaps in the tick count"] += int(np.sum(frames[:, TICK] != np.arange(done, done + n)))
        counted["values that are not finite"] += int(np.sum(~np.isfinite(frames)))
        counted["ticks run"] += n
        left_m, tremor_m = (truth[:, AT[name]] - truth[:, AT["intended_m"]] for name in ("tip_m", "tip_rigid_m"))
        tilt = np.cross(up(frames[:, QUATERNION : QUATERNION + 4]), up(truth[:, AT["quaternion"]]))
        eighths.add(done * 1e-3, left_m, tremor_m, tilt)

    run = simulate(load_bench(bench), seconds, on_block=see, on_time=on_time)
    return LongRun(
        wires=False,
        seconds=seconds,
        start_ns=0,
        cpu_s=time.process_time() - began_s,
        left_um=eighths.rms(1, 1e6),
        tremor_um=eighths.rms(2, 1e6),
        tilt_mrad=eighths.rms(3, 1e3),
        memory_MB=eighths.memory_MB.tolist(),
        scatter=eighths.scatter,
        marks=[],  # the compiled loop counts ticks, and has no clock that could wrap
        counters={**counted, "commands clipped": run.clipped},
        ended="run finished",
    )
