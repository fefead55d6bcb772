"""Variance, propositions and optimisation of placements, against Latt 2011 and against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from tools.errors import InputError
from tools.research.placement import optimise as optimise_module
from tools.research.placement.configurations import cube_004, micron_000, micron_004, micron_004_turned, proposed_004
from tools.research.placement.optimise import cost_and_gradient, optimise, weakest_direction, weight_matrix
from tools.research.placement.propositions import check_pairs
from tools.research.placement.space import load_space, space_latt
from tools.research.placement.variance import (
    angular_noise,
    motion_covariance,
    point_noise,
    rate_covariance_linear,
    rate_covariance_unscented,
)


def test_the_cube_is_that_of_the_formula() -> None:
    """Latt 2011 (45): alpha = (...) / (sqrt(2) d1), exact for the geometry of erratum 129."""
    cube, alpha, force = cube_004(), np.array([0.3, -0.8, 1.1]), np.array([2.0, -1.0, 9.0])
    a1, a2, a3, a4, a5, a6 = np.sum(cube.axes * (force + np.cross(alpha, cube.positions)), axis=1)
    found = np.array([a1 - a2 + a5 - a6, -a1 + a3 - a4 - a6, a2 - a3 - a4 + a5]) / (np.sqrt(2.0) * 0.026)
    np.testing.assert_allclose(found, alpha, atol=1e-12)


def test_linear_variance_is_that_of_drawn_noise() -> None:
    rng = np.random.default_rng(0)
    placement = micron_000()
    design = np.hstack([placement.axes, np.cross(placement.positions, placement.axes)])
    drawn = np.linalg.solve(design, 0.01 * rng.standard_normal((6, 20_000)))
    np.testing.assert_allclose(np.cov(drawn), motion_covariance(placement, 0.01), rtol=0.1, atol=2e-3)


def test_both_propagations_agree_at_rest() -> None:
    placement = micron_000()
    linear = rate_covariance_linear(placement, 0.022, 1e-3)
    np.testing.assert_allclose(rate_covariance_unscented(placement, 0.022, 1e-3), linear, rtol=1e-3, atol=1e-9)


def test_noise_grows_with_the_distance_from_the_front_sensor() -> None:
    placement = micron_000()
    near, far = (point_noise(placement, 0.02205, np.array([0.0, 0.0, z]))[0] for z in (0.116, 0.155))
    assert near == pytest.approx(0.02205, rel=1e-3)
    assert far > near


def test_the_gradient_is_that_of_finite_differences() -> None:
    rng = np.random.default_rng(4)
    positions, axes = rng.normal(0.0, 0.05, (6, 3)), rng.standard_normal((6, 3))
    root = rng.standard_normal((6, 6))
    weight = root @ root.T
    _, by_r, by_s = cost_and_gradient(positions, axes, weight)
    for target, gradient, h in ((positions, by_r, 1e-7), (axes, by_s, 1e-6)):
        for index in np.ndindex(target.shape):
            kept = target[index]
            target[index] = kept + h
            up = cost_and_gradient(positions, axes, weight)[0]
            target[index] = kept - h
            down = cost_and_gradient(positions, axes, weight)[0]
            target[index] = kept
            assert (up - down) / (2 * h) == pytest.approx(gradient[index], rel=2e-3, abs=1e-3 * np.abs(gradient).max())


def test_three_packages_in_the_papers_space(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimise_module, "DRAWS", 60)
    monkeypatch.setattr(optimise_module, "REFINED", 3)
    space = space_latt()
    best = optimise(space)
    assert best.noise[3] == pytest.approx(0.4073, abs=5e-5)  # another program's optimum with the same limits
    assert weakest_direction(best.placement.axes)[0] >= space.least_translation
    _, tip = weight_matrix(space)
    reach = cost_and_gradient(best.placement.positions, best.placement.axes, tip)[0]
    assert space.noise_m_s2 * np.sqrt(reach) <= space.largest_force_noise_m_s2
    assert np.linalg.matrix_rank(motion_covariance(best.placement, 0.01)) == 6
    low, high = np.array([-0.013, -0.013, 0.0]), np.array([0.013, 0.013, 0.130])
    assert np.all(best.placement.positions >= low - 1e-9)
    assert np.all(best.placement.positions <= high + 1e-9)
    for a, b in zip(best.placement.axes[::2], best.placement.axes[1::2], strict=True):
        assert a @ b == pytest.approx(0.0, abs=1e-9)
    assert angular_noise(micron_004(), 0.01)[3] > angular_noise(proposed_004(), 0.01)[3]
    assert angular_noise(proposed_004(), 0.01)[3] > angular_noise(micron_004_turned(), 0.01)[3] > best.noise[3]


def test_without_a_limit_translation_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """That is why there is one: the angular noise hardly falls, and a direction is seen by a third of an axis."""
    monkeypatch.setattr(optimise_module, "DRAWS", 40)
    monkeypatch.setattr(optimise_module, "REFINED", 1)
    free = optimise(space_latt().model_copy(update={"least_translation": 0.0}))
    assert 0.40 < free.noise[3] < 0.4073
    assert weakest_direction(free.placement.axes)[0] < 0.35


def test_limits_that_no_placement_keeps_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimise_module, "DRAWS", 2)
    monkeypatch.setattr(optimise_module, "REFINED", 1)
    tight = space_latt().model_copy(update={"largest_force_noise_m_s2": 1e-3})
    with pytest.raises(ValueError, match=r"no placement in this space keeps the force at the tip to 0\.001"):
        optimise(tight)


def test_the_propositions_are_named() -> None:
    text = "\n".join(check.text for check in check_pairs(micron_004()))
    assert "breaks proposition ii because the plane of the two is" in text
    fine = [check for check in check_pairs(proposed_004()) if check.keeps_first and check.keeps_second]
    assert any("alpha_y" in check.text for check in fine)


def test_a_space_with_too_few_axes_is_refused(tmp_path) -> None:
    file = tmp_path / "space.toml"
    file.write_text('format = 1\npackages = 2\n[[box]]\nname = "a"\nlow_mm = [0, 0, 0]\nhigh_mm = [1, 1, 1]\n')
    with pytest.raises(InputError, match="six degrees of freedom need six"):
        load_space(file)
