"""Runs equations that are affine in their states and signals by exact steps, which cost a tenth of integrated ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel
from sim_devices.physics.effect import Array
from tools.guest.equations import ADD, ATAN2, DIV, LEQ, LESS, MAX, MIN, MUL, NEG, PICK, POW, SUB, Program
from tools.mismatch.twins.linear import discretise

CONSTANT, AFFINE, CURVED = 0, 1, 2
"""How a register depends on the states and signals."""
ARGUMENTS = {**dict.fromkeys((MUL, DIV, POW, ATAN2, MIN, MAX, LESS, LEQ), 2), PICK: 3}
"""Number of arguments of an operation that has more than one."""


def is_affine(program: Program, variables: int) -> bool:
    """Return True if the results are affine in the states and signals and do not depend on time.

    Registers 1 to ``variables`` hold states and signals, register 0 the time; all others are constants.
    """
    kind = [CURVED] + [AFFINE] * variables + [CONSTANT] * (program.registers.size - variables - 1)
    for code, to, a, b, c in program.operations.tolist():
        left, right = kind[a], kind[b]
        if code in (ADD, SUB):
            kind[to] = max(left, right)
        elif code == NEG:
            kind[to] = left
        elif code == MUL and CONSTANT in (left, right):
            kind[to] = max(left, right)
        elif code == DIV and right == CONSTANT:
            kind[to] = left
        else:
            used = [kind[i] for i in (a, b, c)[: ARGUMENTS.get(code, 1)]]
            kind[to] = CURVED if max(used) else CONSTANT
    return all(kind[r] != CURVED for r in program.results.tolist())


@dataclass(frozen=True)
class Steps:
    """Holds ``x[k] = ad x[k-1] + g0 u[k-1] + g1 u[k] + offset``: ad (s, s), g0 and g1 (s, m), offset (s,)."""

    ad: Array
    g0: Array
    g1: Array
    offset: Array

    def run(self, x0: Array, u: Array, starts: NDArray[np.int64], stop: NDArray[np.int64]) -> Array:
        """Return the states (n, s) of stretches from ``starts`` to ``stop``, from ``x0`` (starts, s); zero elsewhere.

        ``u``: signals (n, m).
        """
        pushed = np.empty((u.shape[0], self.offset.size))
        pushed[0] = 0.0
        pushed[1:] = u[:-1] @ self.g0.T + u[1:] @ self.g1.T + self.offset
        return run_pushed(self.ad, pushed, x0, starts, stop)


def exact_steps(
    rates: Callable[[Array, Array], Array], typical: Array, signals: Array, dt: float, held: NDArray[np.bool_]
) -> Steps:
    """Return the exact steps of affine derivatives ``rates(x, u)`` (s,) for signals that are ``held`` (m,) or straight.

    ``typical`` (s,) and ``signals`` (m,): sizes of states and signals.
    """
    s, m = typical.size, signals.size
    size = np.concatenate([typical, np.abs(signals)])
    size = np.where(size > 0.0, size, 1.0)
    own = size[:s]
    slope = np.stack([0.5 * (rates(d[:s], d[s:]) - rates(-d[:s], -d[s:])) for d in np.diag(size)], axis=1)
    # states and signals in units of their sizes; the last signal is the constant one
    a = slope[:, :s] / own[:, None]
    b = np.column_stack([slope[:, s:], rates(np.zeros(s), np.zeros(m))]) / own[:, None]
    each = [discretise(a, column, dt, "zero" if h else "linear") for column, h in zip(b.T, (*held, True), strict=True)]
    before = np.stack([d.g0 for d in each], axis=1) * own[:, None]
    after = np.stack([d.g1 for d in each], axis=1) * own[:, None]
    ad = each[0].ad * own[:, None] / own
    return Steps(ad, before[:, :m] / size[s:], after[:, :m] / size[s:], before[:, m] + after[:, m])


@kernel
def run_pushed(ad, pushed, x0, starts, stop):
    """Return states (n, s) of ``x[k] = ad x[k-1] + pushed[k]`` from ``x0`` at each start until its ``stop``."""
    n, s = pushed.shape
    out = np.zeros((n, s))
    for i in range(starts.size):
        a = starts[i]
        for j in range(s):
            out[a, j] = x0[i, j]
        for k in range(a + 1, stop[i]):
            for j in range(s):
                v = pushed[k, j]
                for q in range(s):
                    v += ad[j, q] * out[k - 1, q]
                out[k, j] = v
    return out


__all__: Sequence[str] = ["Steps", "exact_steps", "is_affine", "run_pushed"]
