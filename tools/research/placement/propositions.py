"""The propositions of Latt 2011 sec. 2.1 as checks on pairs of axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tools.research.placement.configurations import Placement

PARALLEL = np.cos(np.radians(2.0))


@dataclass(frozen=True)
class PairCheck:
    """Judges a pair of parallel axes: ``text`` says what it senses and which rule it breaks, if any."""

    first: int
    second: int
    separation_mm: float
    keeps_first: bool
    keeps_second: bool
    text: str


def check_pairs(placement: Placement) -> list[PairCheck]:
    """Every pair of parallel axes against proposition (i), separation as large as any pair of this direction has, and
    (ii), both in one plane perpendicular to a principal axis."""
    n = len(placement.axes)
    pairs = []
    for i in range(n):
        for j in range(i + 1, n):
            s = placement.axes[i]
            if abs(s @ placement.axes[j]) < PARALLEL:
                continue
            apart = placement.positions[j] - placement.positions[i]
            across = apart - (apart @ s) * s
            distance = float(np.linalg.norm(across))
            if distance < 1e-6:
                continue
            pairs.append((i, j, distance, np.cross(across / distance, s)))
    checks = []
    for i, j, distance, normal in pairs:
        largest = max(d for a, b, d, _ in pairs if abs(placement.axes[a] @ placement.axes[i]) > PARALLEL)
        first = distance > 0.999 * largest
        principal = int(np.argmax(np.abs(normal)))
        offset = 1e3 * float(np.sqrt(max(0.0, 1.0 - normal[principal] ** 2))) * distance
        second = offset < 0.05 * 1e3 * distance
        text = f"axes {i + 1} and {j + 1}, {1e3 * distance:.1f} mm apart, sense alpha_{'xyz'[principal]}"
        if not first:
            text += f"; breaks proposition i because another pair of this direction is {1e3 * largest:.1f} mm apart"
        if not second:
            others = [f"alpha_{'xyz'[k]}" for k in range(3) if k != principal and abs(normal[k]) > 0.05]
            text += (
                f"; breaks proposition ii because the plane of the two is {offset:.1f} mm off the one perpendicular to "
                f"{'xyz'[principal]}, so {' and '.join(others)} must be known"
            )
        checks.append(PairCheck(i + 1, j + 1, 1e3 * distance, first, second, text))
    return checks


def verdicts(placement: Placement) -> list[str]:
    """Return the results of ``check_pairs``, a line per pair, or a line that says that there is no pair."""
    checks = check_pairs(placement)
    if not checks:
        return [f"{placement.name}: no two axes are parallel, so the propositions of Latt 2011 say nothing of it"]
    return [f"{placement.name}: {check.text}" for check in checks]
