"""A fault strikes in every phase of a run, at an instant that is drawn from the seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tools.research.faults.fault import Expected, Fault, How, InWorld


@dataclass(frozen=True)
class Stop:
    """The operator ends the run, so that the outputs ramp to neutral."""


@dataclass(frozen=True)
class Phase:
    """The phase begins between ``from_s`` and ``to_s`` of bench time, and the fault strikes up to ``within_s`` later.

    ``prelude`` is what begins the phase. ``works``: the outputs follow commands when the fault strikes, so that the
    tip's distance from the same run without the fault is the fault's doing. ``longer_s``: faults are watched for so
    much longer, until the outputs work or are refused.
    """

    name: str
    from_s: float
    to_s: float
    prelude: How | Stop | None = None
    within_s: float = 0.0
    works: bool = False
    longer_s: float = 0.0

    def instants_ns(self, seed: int) -> tuple[int, int]:
        """Return the instants of the prelude and of the fault: the same for all faults of a seed."""
        begin, later = np.random.default_rng([seed, *self.name.encode()]).random(2)
        begin_s = self.from_s + (self.to_s - self.from_s) * float(begin)
        return round(begin_s * 1e9), round((begin_s + self.within_s * float(later)) * 1e9)


SELF_TEST = Phase("self-test", 0.02, 0.5, longer_s=1.0)
LEARNING = Phase("learning", 0.8, 2.0, works=True)
STEADY = Phase("steady", 2.0, 12.0, works=True)
HOLD = Phase("hold", 2.0, 3.0, prelude=InWorld("overflow", "daq"), within_s=0.2, longer_s=0.4)
RAMP = Phase("ramp", 2.0, 3.0, prelude=Stop(), within_s=0.018)
START = Phase("start", 0.0, 0.0)
"""The fault is there before the devices are opened."""
PHASES = (SELF_TEST, LEARNING, STEADY, HOLD, RAMP)

ALSO: dict[Expected, frozenset[str]] = {
    "harmless": frozenset({"none"}),
    "cannot be seen": frozenset({"none", "noticed"}),
    "holds": frozenset({"resumes"}),  # a fault that comes and goes may let the outputs resume until it comes again
}
QUIET = frozenset({"none", "noticed", "resumes", "holds", "refused"})


def accepted_answers(fault: Fault, phase: str) -> frozenset[str]:
    """The answers of the instrument to ``fault`` in the phase of this name that are as expected.

    Where the outputs do not work yet, or rest, a fault that latches a running loop must not end in outputs that work;
    any other may be met with less than in a running loop. In the ramp of a run that ends nothing more is decided.
    """
    expected = fault.expected
    if expected == "any" or phase == RAMP.name:
        return QUIET | {"safe state"}
    usual = frozenset({str(expected)}) | ALSO.get(expected, frozenset())
    if fault.is_pair:
        usual |= {"holds"}  # the other fault may keep the outputs at neutral, and nothing is decided there
    if phase == SELF_TEST.name:
        if expected == "cannot be seen":
            usual |= {"safe state"}  # the self-test looks closer than the loop can
        return usual | ({"refused"} if expected == "safe state" else QUIET)
    if phase == HOLD.name:
        return usual | ({"holds"} if expected == "safe state" else QUIET)
    return usual
