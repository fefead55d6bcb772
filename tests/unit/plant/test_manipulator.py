"""Forward kinematics against the constraint equations, solved numerically without our formulas."""

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from sim_devices.config import ManipulatorConfig
from sim_devices.plant.manipulator import manipulator_unit, rotation, tip_displacement

R_MM, SHAFT_MM = 5.0, 40.0


def constraint_solution_mm(z_mm):
    """Tip displacement of the star whose balls lie in their planes (Ang 2004 (6.13) with errata no. 59) at heights
    z."""
    angle = np.radians([0.0, 120.0, 240.0])
    balls = R_MM * np.stack([np.cos(angle), np.sin(angle), np.zeros(3)], axis=1)

    def residual(x):
        b = x[:3] + Rotation.from_rotvec(x[3:]).apply(balls)
        planes = [b[0, 1], b[1, 1] + math.sqrt(3.0) * b[1, 0], b[2, 1] - math.sqrt(3.0) * b[2, 0]]
        return np.concatenate([planes, b[:, 2] - z_mm])

    found = root(residual, np.zeros(6), tol=1e-15)
    assert np.abs(residual(found.x)).max() < 1e-14
    tip = found.x[:3] + Rotation.from_rotvec(found.x[3:]).apply([0.0, 0.0, SHAFT_MM])
    return tip - [0.0, 0.0, SHAFT_MM]


def displacement_mm(z_mm, function=tip_displacement):
    out = np.empty(3)
    function(np.asarray(z_mm), R_MM, SHAFT_MM, out)
    return out


@pytest.mark.parametrize(
    "z_mm",
    [(0.06, -0.06, -0.06), (-0.06, 0.06, -0.01), (0.03, 0.05, 0.06), (0.0, 0.06, -0.06), (0.4, -0.3, 0.2)],
)
def test_tip_against_the_constraint_equations(z_mm):
    assert np.abs(displacement_mm(z_mm) - constraint_solution_mm(np.array(z_mm))).max() < 1e-12


def test_compiled_and_python_agree():
    z = (0.05, -0.02, 0.01)
    assert np.array_equal(displacement_mm(z), displacement_mm(z, tip_displacement.py_func))


def test_workspace_of_table_6_1():
    """> 1000, > 1000, > 100 um of total travel with 15 um stacks and levers of 8."""
    config = ManipulatorConfig()
    half_mm = 15e-3 * config.lever_gain / 2.0
    out = np.empty((8, 3))
    for n, corner in enumerate(itertools.product((-half_mm, half_mm), repeat=3)):
        tip_displacement(np.array(corner), config.circle_mm, config.shaft_mm, out[n])
    travel_um = np.ptp(out, axis=0) * 1e3
    assert travel_um[0] > 1000.0
    assert travel_um[1] > 1000.0
    assert travel_um[2] > 100.0
    assert travel_um == pytest.approx([1280.0, 1108.5, 122.6], abs=3.0)


def test_levers_differ_between_axes_and_not_between_calls():
    unit = manipulator_unit(ManipulatorConfig(), 5)
    assert np.array_equal(unit.lever, manipulator_unit(ManipulatorConfig(), 5).lever)
    assert np.ptp(unit.lever) > 0.0
    assert np.abs(unit.lever / 8.0 - 1.0).max() < 0.1
    assert np.ptp(unit.rest_m) > 0.0
    assert np.allclose(unit.mount @ unit.mount.T, np.eye(3), atol=1e-15)


def test_rotation_is_that_of_its_vector():
    turn = np.array([0.01, -0.02, 0.03])
    assert np.allclose(rotation(turn), Rotation.from_rotvec(turn).as_matrix(), atol=1e-15)
    assert np.array_equal(rotation(np.zeros(3)), np.eye(3))
