"""Runs a linear plant with forces inside it, and finds the states from which such a run starts.

With forces the response is no linear function of the start state, so the state is found by running: the engineer's own,
one that the measured samples of a window set, or one to which a periodic run returns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hal.arrays import IntArray
from sim_devices.physics.effect import Array
from tools.mismatch.twins.base import Run
from tools.mismatch.twins.feedback import Body, Rows, run_feedback
from tools.mismatch.twins.linear import run_states, start_state

MOST_SHOTS = 12
REPEATS = 1e-9
"""Change of a state over a period, relative to the largest state, below which it repeats."""
NEARLY = 1e-3
"""Change of a state over a period, relative to the largest state, that is accepted when shooting ends early."""


@dataclass(frozen=True)
class ForcedRun:
    """Holds all that a run needs but its start state.

    ``u`` (n,): the input of the plant; ``rows``: the row (s,) of every output; ``extra``: what is added to every output
    (n,); ``forces``: None where nothing acts inside the plant. ``blocks``: see ``Plant.blocks``.
    """

    run: Run
    body: Body
    forces: Rows | None
    u: Array
    rows: dict[str, Array]
    extra: Mapping[str, Array]
    blocks: tuple[tuple[int, int], ...]

    @property
    def starts(self) -> IntArray:
        """Return the first sample of each stretch."""
        return np.array(self.run.starts, np.int64)

    @property
    def ends(self) -> IntArray:
        """Return the last sample + 1 of each stretch."""
        return np.array((*self.run.starts[1:], self.run.t.size), np.int64)

    @property
    def order(self) -> int:
        """Return the number of states."""
        return self.body.ad.shape[0]

    @property
    def full(self) -> Array:
        """Return the transition (s, s) over one sample."""
        return np.linalg.matrix_power(self.body.ad, self.body.sub)

    def states(self, x0: Array, drive: Array, first: IntArray, stop: IntArray) -> Array:
        """Return states (n, s) from start states x0 (starts, s), with an input drive (n,)."""
        if self.forces is None:
            return run_states(self.body.ad, self.body.g0, self.body.g1, drive, x0, first)
        return run_feedback(self.body, self.forces, drive, x0, first, stop)

    def outputs(self, x0: Array) -> dict[str, Array]:
        """Return every output (n,) of the whole run from start states x0 (starts, s)."""
        x = self.states(x0, self.u, self.starts, self.ends)
        return {o: x @ row + self.extra[o] for o, row in self.rows.items()}

    def begin_by_setting(self) -> Array:
        """Return the start state (1, s) that fits all samples which may set it."""
        ss = start_state(self.full, self.rows, self.run, blocks=self.blocks)
        x0 = np.zeros((1, self.order))
        for _ in range(2):
            x = self.states(x0, self.u, self.starts, self.ends)
            every = np.arange(self.run.t.size)
            read = {o: self.run.behind_path(o, self.extra[o] + x @ row, every) for o, row in self.rows.items()}
            missed = {o: self.run.measured[o] - y for o, y in read.items()}
            x0 = x0 + ss.states(missed)
        return x0

    def begin_by_period(self, x0: Array) -> Array | None:
        """Return start states (starts, s) to which the run returns after its period; None where there are none."""
        over_period = np.linalg.matrix_power(self.full, self.run.period)
        return shot_to_repeat(self.states, over_period, x0, self.u, self.starts, self.run.period)

    def begin_by_windows(self, x0: Array) -> Array:
        """Return start states (starts, s) that fit the first samples of each stretch, from a first guess ``x0``.

        The windows that set the state are simulated alone, one after the other.
        """
        run, starts = self.run, self.starts
        ss = start_state(self.full, self.rows, replace(run, setting=None), whole=False)
        stop = np.asarray(np.minimum(starts + run.start_window, self.ends), np.int64)
        seen = np.concatenate([np.arange(a, b) for a, b in zip(starts, stop, strict=True)])
        after = np.cumsum(stop - starts)
        before = after - (stop - starts)
        part = np.ascontiguousarray(self.u[seen])
        need = {o: np.zeros(int(stop.max())) for o in self.rows}
        for _ in range(1 if self.forces is None else 3):
            x = self.states(x0, part, before, after)
            for o, row in self.rows.items():
                need[o][seen] = run.measured[o][seen] - run.behind_path(o, self.extra[o][seen] + x @ row, seen)
            x0 = x0 + ss.states(need)
        return x0


Go = Callable[[Array, Array, IntArray, IntArray], Array]


def shot_to_repeat(go: Go, full: Array, x0: Array, u: Array, starts: IntArray, period: int) -> Array | None:
    """Find start states (starts, s) to which a run returns after ``period`` samples, by shooting from ``x0``.

    ``go(x0, u, starts, stops)`` returns states (n, s); ``full`` (s, s) is the linear plant over a period, which
    approximates the Jacobian. Returns None without convergence: for an integrating plant, or a memory that does not
    repeat.
    """
    stop = np.asarray((np.arange(starts.size) + 1) * (period + 1), np.int64)
    part = np.concatenate([u[a : a + period + 1] for a in starts])
    system = np.eye(full.shape[0]) - full
    if np.linalg.cond(system) > 1e10:
        return None
    away = np.inf
    for _ in range(MOST_SHOTS):
        x = go(x0, part, stop - (period + 1), stop)
        size = max(float(np.max(np.abs(x))), 1e-300)
        change = x[stop - 1] - x0
        away = float(np.max(np.abs(change))) / size
        if not np.isfinite(away) or away <= REPEATS:
            break
        x0 = x0 + np.linalg.solve(system, change.T).T
    return x0 if away <= NEARLY else None
