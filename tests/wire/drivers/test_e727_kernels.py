"""The E-727's commands, byte for byte those of Python's own formatting, which rounds correctly."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.piezo.e727_kernels import TEXT_BYTES, encode, put_decimal


def written(value: float) -> str:
    text = np.zeros(TEXT_BYTES, np.uint8)
    return bytes(text[: put_decimal(text, 0, value)]).decode()


@settings(deadline=None)
@given(st.floats(-1e14, 1e14))
@example(0.03125)  # ties: to even
@example(0.09375)
@example(99.99995)  # a carry through all digits
@example(99.99994999999999)
@example(-0.0)
@example(-0.00001)
@example(5e-324)
@example(0.00005)
def test_a_value_is_written_as_python_writes_it(value: float) -> None:
    assert written(value) == f"{value:.4f}"


@settings(deadline=None)
@given(st.integers(-1_000_000, 1_000_000), st.integers(-3, 3))
def test_values_beside_a_tie(steps: int, off: int) -> None:
    """Half a step of the last decimal, and its neighbours among the floats."""
    value = (steps + 0.5) * 1e-4
    for _ in range(abs(off)):
        value = float(np.nextafter(value, np.inf if off > 0 else -np.inf))
    assert written(value) == f"{value:.4f}"


@settings(deadline=None)
@given(st.lists(st.floats(-200.0, 200.0), min_size=3, max_size=3), st.booleans(), st.sampled_from([1.0, 0.15]))
def test_a_command_is_the_manuals(values: list[float], servo: bool, per_V: float) -> None:
    text = np.zeros(TEXT_BYTES, np.uint8)
    n = encode(text, servo, np.array(values), per_V)
    a, b, c = (value * per_V for value in values)
    assert bytes(text[:n]).decode() == f"{'MOV' if servo else 'SVA'} 1 {a:.4f} 2 {b:.4f} 3 {c:.4f}\n"
