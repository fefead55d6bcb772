"""Equations as data: parsed from text or traced from a Python function; anything else is refused."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest

from tools.guest.equations import Builder, EquationError, builder_of, trace
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


NUMBERS = (-math.inf, -2.5, -0.0, 0.0, 0.3, 2.0, math.inf, math.nan)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a / b", np.divide), ("a * b", np.multiply), ("a ** b", np.power), ("atan2(a, b)", np.arctan2),
        ("sqrt(a)", lambda a, b: np.sqrt(a)), ("exp(a)", lambda a, b: np.exp(a)), ("log(a)", lambda a, b: np.log(a)),
        ("tan(a)", lambda a, b: np.tan(a)), ("tanh(a)", lambda a, b: np.tanh(a)), ("abs(a)", lambda a, b: np.abs(a)),
        ("a ** 2", lambda a, b: a * a), ("-a", lambda a, b: -a), ("arctan(a)", lambda a, b: np.arctan(a)),
        # of a number and none: the first one, as Python's own have it
        ("min(a, b)", lambda a, b: min(a, b)), ("max(a, b)", lambda a, b: max(a, b)),
        ("sign(a)", lambda a, b: 1.0 if a > 0 else -1.0 if a < 0 else 0.0),
        ("a if a < b else b", lambda a, b: a if a < b else b), ("where(a, b, 7)", lambda a, b: b if a != 0 else 7.0),
        ("a if a >= b else 3", lambda a, b: a if a >= b else 3.0),
    ],
)  # fmt: skip
def test_machine_code_treats_every_number_as_numpy_does(text: str, expected) -> None:
    for a in map(np.float64, NUMBERS):
        for b in map(np.float64, NUMBERS):
            with np.errstate(all="ignore"):
                right = expected(a, b)
            assert value_of(text, a=a, b=b) == pytest.approx(right, rel=1e-14, abs=0, nan_ok=True), (a, b)


def test_a_program_of_another_process_has_no_number_in_the_place_of_a_variable() -> None:
    builder, found = builder_of(("a",), [[0, 2, 0, 1, 0]], np.array([9.0, 4.0, 0.0]), {"y": 2})
    address, registers, results = code_of(builder.program([found["y"]]))
    registers[0] = 1.0
    run(address, registers)
    assert registers[results[0]] == 5.0


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
