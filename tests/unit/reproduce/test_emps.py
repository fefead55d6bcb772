"""The regression of a drive finds the constants of a drive that was integrated here."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest

from tools.research.reproduce.emps import Drive, regressed


@pytest.mark.parametrize("difference", [0.0, -30.0])
def test_the_constants_of_a_drive_are_found(difference: float) -> None:
    """A force that the equation of motion gives for a smooth course, closed form."""
    rate_hz = 1000.0
    t = np.arange(20_000) / rate_hz
    x = 0.1 * np.sin(2.0 * t) + 0.02 * np.sin(4.6 * t)
    v = 0.2 * np.cos(2.0 * t) + 0.092 * np.cos(4.6 * t)
    a = -0.4 * np.sin(2.0 * t) - 0.4232 * np.sin(4.6 * t)
    true = Drive(95.0, 200.0, 20.0, -3.0, difference)
    force = true.mass_kg * a + true.viscous_N_s_m * v + true.coulomb_N * np.sign(v) + true.offset_N
    force = force + difference * np.abs(v)
    found = regressed(force, x, rate_hz, differs=True)
    # the filter rounds the steps of dry friction
    np.testing.assert_allclose(astuple(found), astuple(true), rtol=0.02, atol=0.5)
