"""Unit symbols, prefixes, products, and conversions against the definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tools.mismatch.units import UnitError, convert, convert_difference, parse, same_dimension


@pytest.mark.parametrize(
    ("value", "unit", "to", "expected"),
    [
        (1.5, "mV", "V", 1.5e-3),
        (2.0, "um", "m", 2e-6),
        (1.0, "kip", "klbf", 1.0),
        (2.0, "µm", "um", 2.0),
        (180.0, "deg/s", "rad/s", math.pi),
        (60.0, "rpm", "rad/s", 2 * math.pi),
        (1.0, "g", "m/s^2", 9.80665),
        (250.0, "mg", "g", 0.25),
        (9.80665, "m/s2", "g", 1.0),
        (0.5, "G", "uT", 50.0),
        (480.0, "mG", "uT", 48.0),
        (0.05, "mT", "gauss", 0.5),
        (25.0, "degC", "degC", 25.0),
        (298.15, "K", "degC", 25.0),
        (77.0, "degF", "degC", 25.0),
        (3.0, "mN m", "N m", 3e-3),
        (3.0, "Nm", "N m", 3.0),
        (3.0, "N*m", "Nm", 3.0),
        (0.1, "um/V", "m/V", 1e-7),
        (4.0, "m s^-2", "m/s²", 4.0),
        (1.0, "rev", "deg", 360.0),
        (12.0, "%", "1", 0.12),
        (1.0, "h", "s", 3600.0),
        (6.0, "l/min", "m^3/s", 1e-4),
        (250.0, "mL", "l", 0.25),
        (2.5, "Ah", "C", 9000.0),
        (1.0, "kWh", "J", 3.6e6),
        (10.0, "uF", "s/ohm", 1e-5),
        (8.0, "mH", "ohm s", 8e-3),
        (1.0, "psi", "Pa", 4.4482216152605 / 0.0254**2),
        (1.2, "barg", "bar", 1.2),
        (80.0, "mbarg", "kPa", 8.0),
        (3.0, "ft", "in", 36.0),
        (2.0, "g/l", "kg/m^3", 2.0),
        (2.0, "mg/l", "g/m^3", 2.0),
        (1.0, "g/cm^3", "kg/m^3", 1000.0),
        (58.44, "g/mol", "kg/mol", 0.05844),
        (3.0, "gram/s", "kg/s", 3e-3),
        (0.3, "V/g", "V s^2/m", 0.3 / 9.80665),
        (1.0, "g^2/Hz", "m^2/s^3", 9.80665**2),
        (5.0, "mmol/l", "mol/m^3", 5.0),
    ],
)
def test_conversions(value: float, unit: str, to: str, expected: float) -> None:
    assert convert(np.array([value]), unit, to)[0] == pytest.approx(expected, rel=1e-12)


def test_a_difference_has_no_offset() -> None:
    assert convert_difference(1.8, "degF", "degC") == pytest.approx(1.0)
    assert convert_difference(0.1, "K", "degC") == pytest.approx(0.1)


@pytest.mark.parametrize("unit", ["furlong", "xV", "V//m", "m^x", "kkg"])
def test_unknown_units_are_named(unit: str) -> None:
    with pytest.raises(UnitError, match="unit"):
        parse(unit)


@pytest.mark.parametrize(("a", "b"), [("V", "A"), ("rad/s", "Hz"), ("N", "N m"), ("kg", "g"), ("deg", "degC")])
def test_dimensions_do_not_mix(a: str, b: str) -> None:
    assert not same_dimension(a, b)
    with pytest.raises(UnitError, match="dimension"):
        convert(np.ones(1), a, b)
