"""Represents differential equations as data: derivatives, outputs, the forces inside them, their linearisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import Acting, Array
from sim_devices.physics.forces import FLOW
from tools.guest.equations import Program
from tools.mismatch.twins.affine import is_affine
from tools.mismatch.twins.feedback import Rows
from tools.mismatch.twins.native import Code, code_of
from tools.mismatch.twins.ode_run import JOINT, SWAY, Drive, Packed, rates_of, run_equations, run_readings

STATE_STEP = 1e-4
"""Step of a start state, over its typical size, of which its slopes are taken."""
LEAST_SHOWN = 3e-4  # least singular value of a fitted combination of start states, relative to the largest


@dataclass(frozen=True)
class Place:
    """Describes a place at which a force or flow may act.

    ``position``, ``velocity`` and ``target`` are indices of states; for a storage (a level, a current, a temperature)
    all three are that state. ``name`` is the state whose derivative the force is added to.
    """

    name: str
    kind: Acting
    position: int
    velocity: int
    target: int
    unit: str
    """Unit of the position, or of the stored quantity."""
    pairs: tuple[float, ...] = ()
    """Pairs of a storage (``flows.PAIRS``), or the registers of a parameter and of what it may follow: a signal, a
    state, or the direction of a state. Of a joint: position, velocity and target of its other side, the ratio b of
    x_1 - b x_2, and the typical size and speed of that."""


@dataclass(frozen=True)
class Inside:
    """Packs forces and flows of a run for the compiled loop (``ode_run.run_equations``)."""

    place: NDArray[np.int64]
    """Indices (p, 4) of the states that hold position and velocity, of the one whose derivative the force is added to,
    and 1 if any force there is smooth."""
    rows: tuple[Rows, ...]
    flows: Array
    sway: Array
    joints: Array
    """Rows (k, JOINT), see there."""
    fastest_per_s: float = 0.0

    @cached_property
    def packed(self) -> Packed:
        """Return the forces of all places, one behind the other, as the compiled loop takes them."""
        rows = self.rows

        def join(parts: list[Array]) -> Array:
            return np.concatenate(parts) if parts else np.zeros(0)

        return Packed(
            self.place,
            join([r.friction for r in rows]),
            join([r.spring for r in rows]),
            join([r.cogging for r in rows]),
            np.array([r.thresholds.size for r in rows], np.int64),
            join([r.thresholds for r in rows]),
            join([r.memory for r in rows]),
            self.flows,
            self.sway,
            self.joints,
        )


NO_SWAY = np.zeros((0, SWAY))
NOTHING = Inside(np.zeros((0, 4), np.int64), (), np.zeros((0, FLOW)), NO_SWAY, np.zeros((0, JOINT)))


class Equations(Protocol):
    """Defines the derivatives and outputs of a model, independent of how they are computed."""

    @property
    def affine(self) -> bool:
        """Return True if the derivatives are affine in states and signals and do not depend on time."""
        ...

    @property
    def reads_affine(self) -> bool:
        """Return the same of the outputs."""
        ...

    def states(self, x0: Array, drive: Drive, values: Array, inside: Inside, limits: tuple[Array, Array]) -> Array:
        """Return the states (n, s) of a free run; ``values`` are the parameters, ``limits`` those of each state."""
        ...

    def readings(self, x: Array, u: Array, t: Array, values: Array, sway: Array = NO_SWAY) -> Array:
        """Return the outputs (n, q); ``sway``: rows of the parameters that follow a signal (``Inside``)."""
        ...

    def rates(self, x: Array, u: Array, values: Array) -> Array:
        """Return the derivatives (s,) at time zero, without forces."""
        ...

    def rates_along(self, x: Array, u: Array, t: Array, values: Array) -> Array:
        """Return the derivatives (n, s) at states (n, s), signals (n, m) and times (n,), without forces."""
        ...


@dataclass(frozen=True)
class Programs:
    """Runs equations that are data (``program.py``), as machine code within a loop that is compiled once for all."""

    rates_program: Program
    outputs: Program
    at: int
    """Index of the register of the first parameter."""

    @property
    def affine(self) -> bool:
        """See Equations."""
        return is_affine(self.rates_program, self.at - 1)

    @property
    def reads_affine(self) -> bool:
        """See Equations."""
        return is_affine(self.outputs, self.at - 1)

    def states(self, x0: Array, drive: Drive, values: Array, inside: Inside, limits: tuple[Array, Array]) -> Array:
        """See Equations."""
        return run_equations(self._set(self.rates_program, values), drive, inside.packed, x0, limits)

    def readings(self, x: Array, u: Array, t: Array, values: Array, sway: Array = NO_SWAY) -> Array:
        """See Equations."""
        return run_readings(self._set(self.outputs, values), x, u, t, sway)

    def rates(self, x: Array, u: Array, values: Array) -> Array:
        """See Equations."""
        return rates_of(self._set(self.rates_program, values), x, u)

    def rates_along(self, x: Array, u: Array, t: Array, values: Array) -> Array:
        """See Equations."""
        return run_readings(self._set(self.rates_program, values), x, u, t, NO_SWAY)

    def _set(self, program: Program, values: Array) -> Code:
        code = code_of(program)
        code.registers[self.at : self.at + values.size] = values
        return code


@dataclass(frozen=True)
class State:
    """Describes a state: its unit, its start (a guess that the recording improves), and its limits."""

    name: str
    unit: str
    start: float = 0.0
    lowest: float = -np.inf
    highest: float = np.inf


@dataclass(frozen=True)
class Linearised:
    """Holds ``x' = a x + b u``, ``y = c x + d u`` about the mean of a run, in the order of states, signals, outputs."""

    a: Array
    b: Array
    c: Array
    d: Array


def linearise(equations: Equations, x: Array, u: Array, typical: Array, values: Array) -> Linearised:
    """Linearise right-hand side and outputs by central differences about ``x`` (s,) and ``u`` (m,)."""
    step = 1e-5 * typical
    width = 1e-5 * np.maximum(np.abs(u), 1e-3)
    move = np.concatenate([step, width])
    around = np.concatenate([x, u])
    at = np.concatenate([around + np.diag(move), around - np.diag(move)])
    s = x.size
    f = rates_at(equations, at[:, :s], at[:, s:], values)
    y = equations.readings(np.ascontiguousarray(at[:, :s]), np.ascontiguousarray(at[:, s:]), np.zeros(len(at)), values)
    half = move.size
    slope = (f[:half] - f[half:]).T / (2 * move)
    # rounding errors after cancellation
    slope[np.abs(slope) < 1e-9 * np.max(np.abs(f), axis=0)[:, None] / move] = 0.0
    reading = (y[:half] - y[half:]).T / (2 * move)
    return Linearised(slope[:, :s], slope[:, s:], np.ascontiguousarray(reading[:, :s]), reading[:, s:])


def rates_at(equations: Equations, x: Array, u: Array, values: Array) -> Array:
    """Return the derivatives (k, s) at states (k, s) and signals (k, m), at time zero."""
    return equations.rates_along(np.ascontiguousarray(x), np.ascontiguousarray(u), np.zeros(x.shape[0]), values)


Edges = list[tuple[int, int]]
"""First row of each stretch, and the row behind its last."""


def edges_of(rows: NDArray[np.int64], stretches: int) -> Edges:
    """Return the edges of stretches, of which ``rows`` gives that of each row, in order."""
    first = np.searchsorted(rows, np.arange(stretches)).tolist()
    return list(zip(first, [*first[1:], rows.size], strict=True))


def start_step(slopes: Array, missed: Array, edges: Edges) -> tuple[Array, Array]:
    """Return the Gauss-Newton step (stretches, s) of start states and the squares (stretches,) that it should leave.

    ``slopes`` (rows, q, s) of the negative of ``missed`` (rows, q). What the samples do not determine is not moved.
    """
    s = slopes.shape[2]
    columns = [(slopes[a:b].reshape(-1, s), missed[a:b].reshape(-1)) for a, b in edges]
    gram = np.stack([c.T @ c for c, _ in columns])
    cross = np.stack([c.T @ y for c, y in columns])
    whole = np.isfinite(np.sum(gram, axis=(1, 2)) + np.sum(cross, axis=1))
    size, ways = np.linalg.eigh(np.where(whole[:, None, None], gram, 0.0))
    determined = size > LEAST_SHOWN**2 * size[:, -1:]
    along = np.einsum("kji,kj->ki", ways, np.where(whole[:, None], cross, 0.0))
    turn = np.einsum("kij,kj->ki", ways, np.where(determined, along / np.where(determined, size, 1.0), 0.0))
    return turn, np.array([np.sum((y - c @ step) ** 2) for (c, y), step in zip(columns, turn, strict=True)])


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
