"""Judges a run with a fault: the detection, the response, and its cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.research.faults.phases import STEADY, Phase

LO_V, HI_V, NEUTRAL_V = 0.0, 100.0, 50.0
RAMP_MS = 21.0  # 20 steps, and the tick in which it was decided
SLEW_V_PER_MS = 20.0
MOVED_M = 5e-6
ENDED_WELL = ("run finished", "stopped by the operator")


@dataclass(frozen=True)
class Seen:
    """Holds the records of both sides of a run.

    They are the outcome of the firmware; the path of the tip, demands at the amplifier (t_ns, channel, volts) and scans
    taken from the world; and if a fault that strikes at random did. ``wire_ns``: longest time from a command's way into
    the port until it is a demand, if it is not waited for."""

    strike_ns: int
    outcome: dict[str, Any]
    t_ns: NDArray[np.int64]
    tip_m: NDArray[np.float64]
    demands: list[tuple[int, int, float]]
    scans: int
    happened: bool = True
    wire_ns: int = 0


@dataclass(frozen=True)
class Observation:
    """Times in ms from the strike; ``None``: did not happen.

    ``held_ms``: the first hold began, 0 if the outputs held already and went on to; ``resumed``: the last one ended and
    the outputs moved again.
    ``rough``: demands at the amplifier beyond its range, faster than the slew limit, or anything but the ramp and
    neutral in a hold, commands left out that were on the wire when it began. ``false_neutral``: a channel was not
    neutral 21 ms after the decision, or later when the report says that it was. ``uncounted``: scans of the device that
    the firmware cannot account for.
    ``lost``: scans that the firmware reports as lost.
    ``phase``: of the run, when the fault struck (``phases.py``).
    ``happened``: the fault did something; one that strikes at random may not have, while it was watched.
    ``astray_um``: largest distance of the tip from the same run without the fault, until the decision; ``moved_ms``:
    when it passed 5 um; neither is judged where the outputs did not work when the fault struck.
    """

    fault: str
    point: str
    seed: int
    refused: bool
    tripped_ms: float | None
    noticed_ms: float | None
    noticed: str
    neutral_ms: float | None
    message: str
    confirmed: bool
    rough: int
    false_neutral: bool
    uncounted: int
    astray_um: float
    moved_ms: float | None
    lost: int = 0
    held_ms: float | None = None
    resumed: bool = False
    phase: str = "steady"
    happened: bool = True

    @classmethod
    def refusal(cls, fault: str, point: str, seed: int, message: str, phase: str) -> Observation:
        """The bench could not be opened, and nothing moved."""
        return cls(fault, point, seed, True, None, None, "", None, message, True, 0, False, 0, 0.0, None, phase=phase)

    @property
    def answer(self) -> str:
        """Return what the instrument did."""
        if self.refused:
            return "refused"
        if self.tripped_ms is not None:
            return "safe state"
        if self.held_ms is not None:
            return "resumes" if self.resumed else "holds"
        return "noticed" if self.noticed_ms is not None else "none"

    @property
    def held_on(self) -> bool:
        """The outputs held when the fault struck, for another cause, and went on to."""
        return self.held_ms == 0.0 and self.tripped_ms is None

    @property
    def known_by(self) -> str:
        """Return what was said first."""
        decided = [t for t in (self.tripped_ms, self.held_ms) if t is not None]
        if self.noticed_ms is not None and (not decided or self.noticed_ms < min(decided)):
            return self.noticed
        return self.message if (self.refused or decided) and not self.held_on else ""

    @property
    def detect_ms(self) -> float | None:
        """Return the time of the first sign of the fault."""
        times = [t for t in (self.tripped_ms, self.held_ms, self.noticed_ms) if t is not None]
        return min(times) if times else None


def judge(
    fault: str,
    point: str,
    seed: int,
    seen: Seen,
    reference_m: NDArray[np.float64],
    tip_m: NDArray[np.float64] | None = None,
    phase: Phase = STEADY,
    usual: Mapping[str, int] | None = None,
) -> Observation:
    """Judge one run. ``reference_m`` (n, 3): the tip in the same run without the fault, row k at k ms. ``tip_m``: it is
    compared with that instead of the tip that was seen: for faults that redraw the noise both are of runs without
    noise. ``usual``: what the run without the fault noticed, and when; a fault that has not struck is not credited with
    it."""
    outcome = seen.outcome
    safe = outcome["safe_state"]
    reason = str(safe["reason"])
    tripped = not reason.startswith(ENDED_WELL)
    ended_ns = int(outcome["safe_ns"])
    all_holds = outcome.get("holds", ())
    holds = [hold for hold in all_holds if hold["t_ns"] >= seen.strike_ns]
    held_on = bool(all_holds) and not holds and not all_holds[-1]["resumed"]
    decided_ns = holds[0]["t_ns"] if holds else ended_ns
    confirmed = bool(safe["reached"])
    noticed = {what: t_ns for what, t_ns in outcome["noticed"].items() if t_ns >= seen.strike_ns}
    if not seen.happened and usual:
        noticed = {what: t_ns for what, t_ns in noticed.items() if usual.get(what) != t_ns}
    first = min(noticed, key=noticed.__getitem__) if noticed else ""
    path_m = seen.tip_m if tip_m is None else tip_m
    n = min(len(seen.tip_m), len(path_m), len(reference_m))
    away_m = np.linalg.norm(path_m[:n] - reference_m[:n], axis=1)
    t_ns = seen.t_ns[:n]
    before = (t_ns >= seen.strike_ns) & (t_ns <= decided_ns)
    moved = np.flatnonzero(before & (away_m > MOVED_M))
    first_end_ns = decided_ns + round(holds[0]["length_s"] * 1e9) if holds and holds[0]["resumed"] else None
    neutral = neutral_ms(seen.demands, decided_ns, first_end_ns) if confirmed else None
    told_ms = (holds[0].get("neutral_ms") if holds else safe.get("late_ms")) or 0.0
    samples = outcome["samples"]
    counted = samples["received"] + samples["lost"] + samples["unread"] + 1  # and the one under way
    return Observation(
        fault=fault,
        point=point,
        seed=seed,
        refused=outcome["armed_ns"] is None,
        tripped_ms=(ended_ns - seen.strike_ns) * 1e-6 if tripped else None,
        noticed_ms=(noticed[first] - seen.strike_ns) * 1e-6 if noticed else None,
        noticed=first,
        neutral_ms=neutral,
        message=reason if tripped or not holds else str(holds[0]["cause"]),
        confirmed=confirmed,
        rough=rough_demands(seen.demands)
        + sum(
            driven_in_hold(seen.demands, hold["t_ns"] + seen.wire_ns, hold["t_ns"] + hold["length_s"] * 1e9)
            for hold in all_holds
        ),
        false_neutral=confirmed and (neutral is None or neutral > max(RAMP_MS, 1.0 + told_ms)),
        uncounted=max(0, seen.scans - counted),
        astray_um=1e6 * float(away_m[before].max(initial=0.0)) if phase.works else 0.0,
        moved_ms=float(t_ns[moved[0]] - seen.strike_ns) * 1e-6 if moved.size and phase.works else None,
        lost=int(samples["lost"]),
        held_ms=(decided_ns - seen.strike_ns) * 1e-6 if holds else 0.0 if held_on else None,
        resumed=bool(holds and holds[-1]["resumed"]),
        phase=phase.name,
        happened=seen.happened,
    )


def driven_in_hold(demands: list[tuple[int, int, float]], begin_ns: float, end_ns: float) -> int:
    """Demands in a hold that are farther from neutral than the one before: neither its ramp nor neutral."""
    count = 0
    before_V: dict[int, float] = {}
    for t_ns, channel, volts in demands:
        if begin_ns < t_ns < end_ns and channel in before_V:
            count += abs(volts - NEUTRAL_V) > abs(before_V[channel] - NEUTRAL_V) + 1e-9
        before_V[channel] = volts
    return count


def neutral_ms(demands: list[tuple[int, int, float]], decided_ns: int, until_ns: int | None = None) -> float | None:
    """Return the time from the decision to the last change of a demand before ``until_ns``; ``None`` if one is not
    neutral then."""
    last_ns = decided_ns
    volts_of: dict[int, float] = {}
    for t_ns, channel, volts in demands:
        if until_ns is not None and t_ns >= until_ns:
            break
        if volts != volts_of.get(channel):
            last_ns = max(last_ns, t_ns)
        volts_of[channel] = volts
    if any(abs(volts - NEUTRAL_V) > 0.01 for volts in volts_of.values()):
        return None
    return (last_ns - decided_ns) * 1e-6


def rough_demands(demands: list[tuple[int, int, float]]) -> int:
    """Demands beyond the range or faster than the slew limit (after a pause at most five ticks' worth)."""
    count = 0
    previous: dict[int, tuple[int, float]] = {}
    for t_ns, channel, volts in demands:
        count += not LO_V <= volts <= HI_V
        if channel in previous:
            earlier_ns, before_V = previous[channel]
            gap_ms = min(5.0, max(1.0, (t_ns - earlier_ns) * 1e-6))
            count += abs(volts - before_V) > SLEW_V_PER_MS * gap_ms * 1.01
        previous[channel] = (t_ns, volts)
    return count
