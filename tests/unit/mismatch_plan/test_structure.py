"""The structural analysis against matrices that faultdiagnosistoolbox 0.12.5 gives for its own examples."""

from __future__ import annotations

import numpy as np

from tools.mismatch.plan.structure import Structure, groups, isolability, overdetermined, splitting_sensors


def structure(relations: list[str], faults: dict[str, int]) -> Structure:
    """Equations as lists of unknowns; the toolbox' causality "mixed" is the plain bipartite graph."""
    equations = {f"e{i + 1}": frozenset(r.split()) for i, r in enumerate(relations)}
    return Structure(equations, {f: f"e{e}" for f, e in faults.items()})


THREE_TANK = structure(
    [
        "p1 p2 q1", "p2 p3 q2", "p3 q3", "q0 q1 dp1", "q1 q2 dp2", "q2 q3 dp3", "p1", "q2", "q0", "dp1 p1", "dp2 p2",
        "dp3 p3",
    ],
    {"fV1": 1, "fV2": 2, "fV3": 3, "fT1": 4, "fT2": 5, "fT3": 6},
)  # fmt: skip
MOTOR = structure(
    ["I dI w", "Tm I", "dw T w", "T Tm Tl", "I", "w", "T", "dI I", "dw w"], {"fR": 1, "fi": 5, "fw": 6, "fT": 7}
)
INDUCTION = structure(
    [
        "la w qa", "lb w qb", "ia la dia qb", "ib lb dib qa", "ia la dla qb", "ib lb dlb qa", "ia ib la lb w dw Tl",
        "ia dia", "ib dib", "la dla", "lb dlb", "w dw", "ia", "ib", "w",
    ],
    {"fa": 13, "fb": 14},
)  # fmt: skip


def test_three_tanks_as_published():
    """Valve 2, valve 3 and tank 3 cannot be told apart (Frisk, Krysander and Jung 2017)."""
    wanted = np.eye(6, dtype=bool)
    for i in (1, 2, 5):
        wanted[i, [1, 2, 5]] = True
    np.testing.assert_array_equal(isolability(THREE_TANK), wanted)
    assert ("fV2", "fV3", "fT3") in groups(THREE_TANK)


def test_electric_motor_as_published():
    wanted = np.eye(4, dtype=bool)
    wanted[:2, :2] = True
    np.testing.assert_array_equal(isolability(MOTOR), wanted)


def test_induction_motor_as_published():
    np.testing.assert_array_equal(isolability(INDUCTION), np.eye(2, dtype=bool))


def test_a_fault_outside_the_overdetermined_part_cannot_be_detected():
    bare = structure(["x u", "x", "y"], {"f": 1, "g": 3})
    assert overdetermined(bare) == set()
    assert isolability(bare).all()


def test_a_sensor_splits_what_structure_could_not():
    helps = splitting_sensors(THREE_TANK)[("fV2", "fV3", "fT3")]
    assert "p3" in helps
    assert "q0" not in helps
