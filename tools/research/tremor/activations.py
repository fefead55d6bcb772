"""Provides the transfer functions of the cascade network's hidden units (Ang 2004, 5.3.2), and their slopes."""

from __future__ import annotations

from math import cos, exp, sin, sqrt, tanh

from hal.compiled import kernel

KINDS = ("sigmoid", "gaussian", "sine", "bessel")
SIGMOID, GAUSSIAN, SINE, BESSEL = range(4)


@kernel
def bessel_j0(x: float) -> float:
    """Return the Bessel function J0, accurate to 5e-8 (Abramowitz and Stegun 9.4.1, 9.4.3)."""
    a = abs(x)
    if a <= 3.0:
        t = (a / 3.0) ** 2
        return 1.0 + t * (
            -2.2499997 + t * (1.2656208 + t * (-0.3163866 + t * (0.0444479 + t * (-0.0039444 + t * 0.0002100))))
        )
    t = 3.0 / a
    f = 0.79788456 + t * (
        -0.00000077 + t * (-0.00552740 + t * (-0.00009512 + t * (0.00137237 + t * (-0.00072805 + t * 0.00014476))))
    )
    angle = (
        a
        - 0.78539816
        + t
        * (-0.04166397 + t * (-0.00003954 + t * (0.00262573 + t * (-0.00054125 + t * (-0.00029333 + t * 0.00013558)))))
    )
    return f * cos(angle) / sqrt(a)


@kernel
def bessel_j1(x: float) -> float:
    """Return the Bessel function J1, accurate to 1e-7 (Abramowitz and Stegun 9.4.4, 9.4.6). The slope of J0 is -J1."""
    a = abs(x)
    if a <= 3.0:
        t = (a / 3.0) ** 2
        return x * (
            0.5
            + t
            * (
                -0.56249985
                + t * (0.21093573 + t * (-0.03954289 + t * (0.00443319 + t * (-0.00031761 + t * 0.00001109))))
            )
        )
    t = 3.0 / a
    f = 0.79788456 + t * (
        0.00000156 + t * (0.01659667 + t * (0.00017105 + t * (-0.00249511 + t * (0.00113653 - t * 0.00020033))))
    )
    angle = (
        a
        - 2.35619449
        + t * (0.12499612 + t * (0.00005650 + t * (-0.00637879 + t * (0.00074348 + t * (0.00079824 - t * 0.00029166)))))
    )
    value = f * cos(angle) / sqrt(a)
    return value if x > 0.0 else -value


@kernel
def activation(kind: int, s: float) -> float:
    """Return the output of a hidden unit with net input ``s``. The sigmoid is the symmetric one."""
    if kind == SIGMOID:
        return tanh(s)
    if kind == GAUSSIAN:
        return exp(-0.5 * s * s)
    if kind == SINE:
        return sin(s)
    return bessel_j0(s)


@kernel
def slope(kind: int, s: float) -> float:
    """Return the derivative of ``activation`` with respect to ``s``."""
    if kind == SIGMOID:
        t = tanh(s)
        return 1.0 - t * t
    if kind == GAUSSIAN:
        return -s * exp(-0.5 * s * s)
    if kind == SINE:
        return cos(s)
    return -bessel_j1(s)
