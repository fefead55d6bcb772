"""Represents differential equations as data: derivatives, outputs, their linearisation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sim_devices.physics.effect import Array
from tools.guest.equations import Program
from tools.mismatch.twins.affine import is_affine
from tools.mismatch.twins.native import Code, code_of
from tools.mismatch.twins.ode_inside import NO_SWAY, Inside
from tools.mismatch.twins.ode_run import Drive, rates_of, run_equations, run_readings


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
