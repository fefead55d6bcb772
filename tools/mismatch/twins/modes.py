"""Splits a linear plant into modes (pairs of complex poles, real poles) and groups them into companion forms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hal.arrays import ComplexArray
from sim_devices.physics.effect import Array


def typical_size(roots: ComplexArray, span: float) -> float:
    """Return the typical size of some roots; companion states are scaled by its powers to be of one size."""
    sizes = np.abs(roots)
    sizes = sizes[sizes > 1e-9 * (sizes.max() if sizes.size else 1.0)]
    return float(np.exp(np.mean(np.log(sizes)))) if sizes.size else 1.0 / span


@dataclass(frozen=True)
class Mode:
    """Describes a mode in continuous terms: a ``pair`` of complex poles, a ``real`` one, or a ``fixed`` pole.

    A pole is ``fixed`` if it integrates or has no continuous equivalent; ``value`` is then that of s or z.
    """

    kind: Literal["pair", "real", "fixed"]
    value: complex

    @property
    def order(self) -> int:
        """Return the number of poles."""
        return 2 if self.kind == "pair" else 1


def modes_of(poles: ComplexArray, discrete: bool, dt: float) -> list[Mode]:
    """Return the modes of a set of poles that is closed under conjugation."""
    modes: list[Mode] = []
    size = max(float(np.max(np.abs(poles))), 1e-300) if poles.size else 1.0
    for p in poles:
        z = complex(p)
        if discrete:
            if z.imag < -1e-12:
                continue
            if z.imag <= 1e-12 and (z.real <= 0 or abs(z.real - 1) < 1e-9):
                modes.append(Mode("fixed", complex(z.real)))
                continue
            c = complex(np.log(z)) / dt
            modes.append(Mode("pair", c) if z.imag > 1e-12 else Mode("real", complex(c.real)))
            continue
        if z.imag < -1e-9 * size:
            continue
        if abs(z) < 1e-9 * size:
            modes.append(Mode("fixed", 0j))
        else:
            modes.append(Mode("pair", z) if z.imag > 1e-9 * size else Mode("real", complex(z.real)))
    return modes


def roots_of_mode(mode: Mode, discrete: bool, dt: float) -> ComplexArray:
    """Return the poles of a mode in s, or in z - 1 for a discrete twin.

    With the delta operator (G. C. Goodwin et al.) companion states stay distinct at any sampling rate.
    """
    if mode.kind == "fixed":
        return np.array([mode.value - (1.0 if discrete else 0.0)])
    both = np.array([mode.value, mode.value.conjugate()] if mode.kind == "pair" else [mode.value], np.complex128)
    return np.expm1(both * dt) if discrete else both


def companion(roots: ComplexArray, omega: float, discrete: bool) -> tuple[Array, Array]:
    """Return companion form (s, s) and input (s,) of roots of s or z - 1, states scaled by powers of ``omega``."""
    s = roots.size
    if s == 2:
        den = np.array([1.0, -float(np.sum(roots).real), float(np.prod(roots).real)])
    else:
        den = np.real(np.poly(roots))
    a = np.zeros((s, s))
    a[:-1, 1:] = omega * np.eye(s - 1)
    a[-1, :] = -den[:0:-1] / (omega ** np.arange(s - 1, -1, -1.0))
    b = np.zeros(s)
    b[-1] = omega
    return (a + np.eye(s) if discrete else a), b


SMALL = 4
"""Largest number of modes of a plant that is always one chain; its numerators keep the engineer's zeros."""
SPREAD = 1e3
"""Ratio of the sizes of poles above which even a plant of ``SMALL`` modes is not one chain."""
ALIKE = 0.98
"""Correlation of the impulse responses of two modes above which their residues are not identifiable separately."""
MOST_CHAINED = 6  # poles


def chains_of(modes: Sequence[Mode], dt: float) -> list[list[int]]:
    """Group the modes that share a companion form: all of a small plant, else those too similar for partial fractions.

    Partial fractions stay well conditioned at any order if poles are separated; companion forms do if poles are few
    and of similar size.
    """
    sizes = [abs(x.value) for x in modes if x.kind != "fixed"]
    narrow = not sizes or max(sizes) < SPREAD * min(sizes)
    if sum(x.order for x in modes) <= SMALL and narrow:
        return [list(range(len(modes)))] if modes else []
    chains: list[list[int]] = []
    order = sorted(range(len(modes)), key=lambda i: (modes[i].kind == "fixed", abs(modes[i].value)))
    for i in order:
        near = [c for c in chains if any(_alike(modes[i], modes[j]) > ALIKE for j in c)]
        room = next((c for c in near if sum(modes[j].order for j in c) + modes[i].order <= MOST_CHAINED), None)
        if room is None:
            chains.append([i])
        else:
            room.append(i)
    return [sorted(c) for c in chains]


def _alike(a: Mode, b: Mode) -> float:
    """Return the correlation of two decays; fixed poles count as fully correlated."""
    if "fixed" in (a.kind, b.kind):
        return 1.0 if a.kind == b.kind else 0.0
    p, q = a.value, b.value
    least = 1e-6 * max(abs(p), abs(q), 1e-300)
    decay = max(abs(p.real), least), max(abs(q.real), least)
    return float(2 * np.sqrt(decay[0] * decay[1]) / abs(complex(sum(decay), p.imag - q.imag)))
