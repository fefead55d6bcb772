"""Equations as data: parsed from text or traced from a Python function; anything else is refused."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest

from tools.guest.equations import Builder, EquationError, trace
from tools.mismatch.twins.native import code_of, run_code
from tools.mismatch.twins.program import parse


@numba.njit
def run(address, registers):
    run_code(address, registers)


def value_of(text: str, **values: float) -> float:
    builder = Builder(tuple(values))
    program = builder.program(parse(builder, {"wanted": text}, ["wanted"]))
    address, registers, results = code_of(program)
    registers[: len(values)] = [*values.values()]
    run(address, registers)
    return float(registers[results[0]])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a + 2*b - a/b", lambda a, b: a + 2 * b - a / b),
        ("-a**2 + abs(b)**0.5", lambda a, b: -(a**2) + abs(b) ** 0.5),
        ("sqrt(max(b, 0)) if a < b else exp(-a)", lambda a, b: math.sqrt(max(b, 0)) if a < b else math.exp(-a)),
        ("where(a >= b, tanh(a), sign(b) * pi)", lambda a, b: math.tanh(a) if a >= b else math.pi),
        ("clip(a, -0.5, 0.5) + atan2(a, b)", lambda a, b: min(max(a, -0.5), 0.5) + math.atan2(a, b)),
        ("min(a, b) * sin(a) - max(a, b) * cos(b)", lambda a, b: min(a, b) * math.sin(a) - max(a, b) * math.cos(b)),
    ],
)
@pytest.mark.parametrize(("a", "b"), [(0.3, 1.7), (2.5, 1.1)])
def test_an_equation_says_what_python_would(text: str, expected, a: float, b: float) -> None:
    assert value_of(text, a=a, b=b) == pytest.approx(expected(a, b), rel=1e-14)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')", "a.real", "[a][0]", "(lambda: a)()", "open('x')", "a if", "c + 1", "1e999",
        "sqrt(a, a)", "a @ a", "f'{a}'", "a and a", "a == 1", "a[0]", "'text'", "wanted + 1",
    ],
)  # fmt: skip
def test_nothing_but_arithmetic_is_an_equation(text: str) -> None:
    with pytest.raises(EquationError, match=r"wanted|finite"):
        value_of(text, a=1.0)


def test_an_equation_that_never_ends_is_refused() -> None:
    with pytest.raises(EquationError, match=r"nested too deeply|cannot be read"):
        value_of("(" * 3000 + "a" + ")" * 3000, a=1.0)


def test_a_python_function_becomes_the_same_equations() -> None:
    def derivatives(t, states, inputs, parameters):
        drag = np.where(states["v"] > 0, parameters["c"] * states["v"] ** 2, -np.abs(states["v"]))
        return {"x": states["v"], "v": (inputs["u"] - np.clip(drag, -5, 5)) / 2 + np.sqrt(np.square(t))}

    names = ("t", "x", "v", "u", "c")
    builder = Builder(names)
    found = trace(builder, derivatives, {"states": ("x", "v"), "inputs": ("u",), "parameters": ("c",)})
    program = builder.program([found["x"], found["v"]])
    for values in ((1.0, 0.5, 1.5, 2.0, 0.3), (2.0, 0.5, -1.5, 2.0, 0.3)):
        address, registers, _ = code_of(program)
        registers[: len(names)] = values
        run(address, registers)
        t, x, v, u, c = values
        expected = derivatives(t, {"x": x, "v": v}, {"u": u}, {"c": c})
        assert [registers[i] for i in program.results] == pytest.approx([expected["x"], expected["v"]], rel=1e-14)


def test_a_function_that_branches_on_a_state_says_how_to_write_it() -> None:
    def derivatives(t, states, inputs, parameters):
        return {"x": 1.0 if states["x"] > 0 else 2.0}

    groups = {"states": ("x",), "inputs": (), "parameters": ()}
    with pytest.raises(EquationError, match=r"numpy\.where"):
        trace(Builder(("t", "x")), derivatives, groups)


@pytest.mark.parametrize(
    ("derivatives", "message"),
    [
        (lambda t, s, u, p: {"x": s["y"]}, r"asks for 'y'.*states: x; inputs: none; parameters: none"),
        (lambda t, s, u, p: {"x": s[0]}, r"asks for 0.*states: x"),
        (lambda t, s, u, p: {"x": math.tanh(s["x"])}, r"in place of math and scipy use numpy's"),
        (lambda t, s: {"x": s["x"]}, r"derivatives\(t, states, inputs, parameters\)"),
        (lambda t, s, u, p: [s["x"]], r"must return \{'x': \.\.\.\}, got list"),
    ],
)
def test_a_function_that_cannot_be_traced_says_what_to_write(derivatives, message: str) -> None:
    with pytest.raises(EquationError, match=message):
        trace(Builder(("t", "x")), derivatives, {"states": ("x",), "inputs": (), "parameters": ()})


def test_a_caret_is_no_power() -> None:
    with pytest.raises(EquationError, match=r"write a power as \*\*"):
        value_of("a^2", a=1.0)
