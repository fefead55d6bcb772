"""Finds the states from which a run of equations starts, where measured samples set them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel
from sim_devices.physics.effect import Array
from tools.mismatch.twins.base import Run
from tools.mismatch.twins.memo import Start

Samples = NDArray[np.int64]
Go = Callable[[Array, Samples, Samples, Array, Array], Array]
"""Runs from start states (stretches, s) over stretches (first samples and those behind the last) of signals (n, m) and
times (n,); returns states (n, s)."""
Read = Callable[[Array, Array, Array], Array]
"""Returns the outputs (n, q) of states (n, s), signals (n, m) and times (n,)."""

WORTH_RENEWING = 0.99
"""Square of the misses that another step of the start states would leave, as a share of the present one, below which
they and their sensitivities are sought anew."""


STATE_STEP = 1e-4
"""Step of a start state, over its typical size, of which its slopes are taken."""
LEAST_SHOWN = 3e-4  # least singular value of a fitted combination of start states, relative to the largest

Edges = list[tuple[int, int]]
"""First row of each stretch, and the row behind its last."""


def edges_of(rows: NDArray[np.int64], stretches: int) -> Edges:
    """Return the edges of stretches, of which ``rows`` gives that of each row, in order."""
    first = np.searchsorted(rows, np.arange(stretches)).tolist()
    return list(zip(first, [*first[1:], rows.size], strict=True))


@kernel
def normal_sums(slopes, missed, first):
    """Return the sums of squares and products of slopes (rows, q, s) and misses (rows, q) from each ``first`` row to
    the next: (k, s, s), (k, s) and (k,)."""
    rows, q, s = slopes.shape
    gram = np.zeros((first.size, s, s))
    cross = np.zeros((first.size, s))
    squares = np.zeros(first.size)
    for k in range(first.size):
        stop = first[k + 1] if k + 1 < first.size else rows
        for r in range(first[k], stop):
            for o in range(q):
                e = missed[r, o]
                squares[k] += e * e
                for i in range(s):
                    v = slopes[r, o, i]
                    cross[k, i] += v * e
                    for j in range(i + 1):
                        gram[k, i, j] += v * slopes[r, o, j]
        for i in range(s):
            for j in range(i):
                gram[k, j, i] = gram[k, i, j]
    return gram, cross, squares


def start_step(slopes: Array, missed: Array, edges: Edges) -> tuple[Array, Array]:
    """Return the Gauss-Newton step (stretches, s) of start states and the squares (stretches,) that it should leave.

    ``slopes`` (rows, q, s) of the negative of ``missed`` (rows, q). What the samples do not determine is not moved.
    """
    gram, cross, squares = normal_sums(
        np.ascontiguousarray(slopes), np.ascontiguousarray(missed), np.array([a for a, _ in edges], np.int64)
    )
    whole = np.isfinite(np.sum(gram, axis=(1, 2)) + np.sum(cross, axis=1))
    size, ways = np.linalg.eigh(np.where(whole[:, None, None], gram, 0.0))
    determined = size > LEAST_SHOWN**2 * size[:, -1:]
    along = np.einsum("kji,kj->ki", ways, np.where(whole[:, None], cross, 0.0))
    turn = np.einsum("kij,kj->ki", ways, np.where(determined, along / np.where(determined, size, 1.0), 0.0))
    left = squares - 2.0 * np.einsum("ki,ki->k", turn, cross) + np.einsum("ki,kij,kj->k", turn, gram, turn)
    return turn, np.maximum(left, 0.0)


def slopes_of(x0: Array, missed: Array, misses: Callable[[Array], Array], typical: Array) -> Array:
    """Return the slopes (rows, q, s) of the negative of ``missed`` (rows, q) by each state at the start."""
    ways = STATE_STEP * typical * np.eye(x0.shape[1])
    return np.stack([(missed - misses(x0 + way)) / STATE_STEP for way in ways], axis=-1)


HALVINGS = 4
"""Largest number of times that a step of start states is halved until it improves them."""
WORTH_HALVING = 0.9
"""Largest square of the misses that a step foretells, as a share of the present one, for which it is halved."""


@np.errstate(over="ignore", invalid="ignore")  # a trial that runs away is no better
def meet_start(
    x0: Array,
    misses: Callable[[Array], Array],
    edges: Edges,
    typical: Array,
    limits: tuple[Array, Array],
    rounds: int = 3,
) -> Array:
    """Fit start states (stretches, s) that minimise ``misses`` (rows, q), from ``x0`` on.

    ``typical`` (s,): size of each state. ``rounds`` of Gauss-Newton are made.
    """
    first = [a for a, _ in edges]
    of = np.repeat(np.arange(len(edges)), [b - a for a, b in edges])

    def together(e: Array) -> Array:
        return np.add.reduceat(e, first, axis=0)

    best = misses(x0)
    for _ in range(rounds):
        turn, foretold = start_step(slopes_of(x0, best, misses, typical), best, edges)
        was = now = together(np.sum(best**2, axis=1))
        behind = np.ones(was.size, np.bool_)
        for h in range(1 + HALVINGS):
            moved = np.clip(x0 + typical * np.where(behind, 0.5**h, 0.0)[:, None] * turn, *limits)
            after = misses(moved)
            reached = together(np.sum(after**2, axis=1))
            better = behind & (reached < was)
            x0 = np.where(better[:, None], moved, x0)
            best = np.where(better[of][:, None], after, best)
            now = np.where(better, reached, now)
            # where a body sticks, a step may lead to another place of rest; elsewhere a whole one is right
            behind &= ~better & (foretold < WORTH_HALVING * was)
            if not np.any(behind):
                break
        # linear equations need a single step
        if not np.any((now < 0.999 * was) & (now > foretold + 0.001 * was)):
            break
    return x0


@dataclass(frozen=True, eq=False)
class StartSearch:
    """Finds the start states of every stretch of a run, and runs from them.

    ``seen``: the samples that set them; ``whole``: True if these are spread over the stretches, and not the first of
    each. ``weight`` (q,) of the outputs; ``typical`` (s,): size of each state; ``limits``, lowest and highest (s,).
    """

    run: Run
    signals: Array
    starts: Samples
    ends: Samples
    seen: Samples
    whole: bool
    outputs: tuple[str, ...]
    weight: Array
    typical: Array
    limits: tuple[Array, Array]
    go: Go
    read: Read

    @cached_property
    def stretches(self) -> tuple[Samples, Edges]:
        """Return the stretches that have samples which set their start, and the edges of these in ``seen``."""
        used, rows = np.unique(np.searchsorted(self.starts, self.seen, side="right") - 1, return_inverse=True)
        return used, edges_of(rows, used.size)

    @cached_property
    def measured(self) -> Array:
        """Return what was measured (n, q)."""
        return np.column_stack([self.run.measured[o] for o in self.outputs])

    def behind_paths(self, y: Array, at: Samples) -> Array:
        """Return what is measured (m, q) of outputs ``y`` (m, q) at the samples ``at``."""
        if not self.run.paths:
            return y
        return np.stack([self.run.behind_path(o, y[:, i], at) for i, o in enumerate(self.outputs)], axis=1)

    def missed(self, x: Array) -> Array:
        """Return what a run (n, s) leaves of the samples that set its start, weighted, (rows, q)."""
        # what is measured behind effects depends on all that was before
        at = np.arange(self.run.reach(self.seen)) if self.run.paths else self.seen
        readings = self.read(x[at], self.signals[at], self.run.t[at])
        behind = self.behind_paths(readings, at)[self.seen] if self.run.paths else readings
        return (self.measured[self.seen] - behind) * self.weight

    def from_states(self, x0: Array) -> Array:
        """Return the run (n, s) from start states (stretches, s)."""
        return self.go(x0, self.starts, self.ends, self.signals, self.run.t)

    def moved(self, start: Start, missed: Array) -> Array:
        """Return start states (stretches, s) by one step along the sensitivities of ``start``, from which a run left
        ``missed`` (rows, q)."""
        used, edges = self.stretches
        turn = np.zeros(start.x0.shape)
        turn[used], _ = start_step(start.slopes, missed, edges)
        return np.clip(start.x0 + self.typical * turn, *self.limits)

    def beside(self, start: Start, x: Array) -> Array:
        """Return the run (n, s) from the start states that suit it, to first order of the run ``x`` from ``start``."""
        turn = (self.moved(start, self.missed(x)) - start.x0) / self.typical
        return x + np.einsum("nij,nj->ni", start.states, np.repeat(turn, self.ends - self.starts, axis=0))

    def from_nearest(self) -> Array | None:
        """Return the run beside the one that began the search; None if there is none."""
        nearby = self.run.nearby
        start = nearby.of_stretches.get(self.starts.tobytes()) if nearby is not None else None
        return self.beside(start, self.from_states(start.x0)) if start is not None else None

    def from_earlier(self) -> Array | None:
        """Return the run from the states of an earlier place of the search, moved by one step.

        None if there is no such place, or if another step would be worth taking.
        """
        nearby = self.run.nearby
        start = nearby.earlier.get(self.starts.tobytes()) if nearby is not None else None
        if nearby is None or start is None:
            return None
        x0 = self.moved(start, self.missed(self.from_states(start.x0)))
        x = self.from_states(x0)
        missed, (_, edges) = self.missed(x), self.stretches
        _, foretold = start_step(start.slopes, missed, edges)
        was = np.array([np.sum(missed[a:b] ** 2) for a, b in edges])
        if not np.all(foretold >= WORTH_RENEWING * was):
            return None
        nearby.of_stretches[self.starts.tobytes()] = Start(x0, start.states, start.slopes)
        return x

    def anew(self, x0: Array, slopes: Array) -> Array:
        """Return the run from states that are sought from ``x0`` (stretches, s) on.

        ``slopes`` (q, s) of the outputs by the states. A run that has drifted away does not determine the start of the
        next stretch in a position-dependent force, so each begins where its first sample was read.
        """
        run, starts, ends, used = self.run, self.starts, self.ends, self.stretches[0]
        gap = self.measured[starts] - self.read(x0, self.signals[starts], run.t[starts])
        x0 = x0 + gap @ np.linalg.pinv(slopes * self.typical, rcond=LEAST_SHOWN).T * self.typical
        x0 = self._met_alone(x0)
        tried: list[tuple[Array, Array]] = []

        def misses(some: Array) -> Array:
            start = x0.copy()
            start[used] = some
            x = self.from_states(start)
            tried.append((some, x))
            return self.missed(x)

        if self.whole:
            # then all permitted samples count: the first ones are noisy, and an effect behind may hide the state there
            found = meet_start(x0[used], misses, self.stretches[1], self.typical, self.limits, rounds=1)
            # each stretch starts anew, and has been run from the state that was found
            out = tried[0][1].copy()
            for k, i in enumerate(used):
                x = next(x for some, x in tried if np.array_equal(some[k], found[k], equal_nan=True))
                out[starts[i] : ends[i]] = x[starts[i] : ends[i]]
            x0[used] = found
        else:
            out = self.from_states(x0)
        if run.nearby is None or not np.all(np.isfinite(out)):
            return out
        if not self.whole:
            tried.append((x0[used], out))
            slopes_of(x0[used], self.missed(out), misses, self.typical)
        # the runs of the round beside which the states were found; one more beside these tells little else
        begin, turned = tried[0][1], [x for _, x in tried[1 : 1 + self.typical.size]]
        states = np.stack([(x - begin) / STATE_STEP for x in turned], axis=-1)
        of_states = np.stack([(self.missed(begin) - self.missed(x)) / STATE_STEP for x in turned], axis=-1)
        if not np.all(np.isfinite(of_states)):
            return out
        start = Start(x0, states, of_states)
        run.nearby.of_stretches[starts.tobytes()] = start
        return self.beside(start, out)

    def _met_alone(self, x0: Array) -> Array:
        """Return start states (stretches, s) that meet the first samples of each stretch, simulated alone."""
        run, stop = self.run, np.asarray(np.minimum(self.starts + self.run.start_window, self.ends), np.int64)
        first = np.concatenate([np.arange(a, b) for a, b in zip(self.starts, stop, strict=True)])
        after = np.cumsum(stop - self.starts)
        before = after - (stop - self.starts)
        signals, times = np.ascontiguousarray(self.signals[first]), run.t[first]

        def misses(x0: Array) -> Array:
            readings = self.read(self.go(x0, before, after, signals, times), signals, times)
            return (self.measured[first] - self.behind_paths(readings, first)) * self.weight

        windows = list(zip(before.tolist(), after.tolist(), strict=True))
        return meet_start(x0, misses, windows, self.typical, self.limits)
