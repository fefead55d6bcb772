"""Equations as a list of operations, and the tracing of a Python function into one.

This needs numpy alone, because the process of a guest imports it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

ADD, SUB, MUL, DIV, POW, NEG, ABS, SIGN, SQRT, EXP, LOG, SIN, COS, TAN, TANH, ATAN, ATAN2, MIN, MAX, LESS, LEQ, PICK = (
    range(22)
)
_ONE = {
    "abs": ABS, "sign": SIGN, "sqrt": SQRT, "exp": EXP, "log": LOG, "sin": SIN, "cos": COS, "tan": TAN, "tanh": TANH,
    "atan": ATAN, "arctan": ATAN, "absolute": ABS,
}  # fmt: skip
_TWO = {"min": MIN, "max": MAX, "atan2": ATAN2, "arctan2": ATAN2, "minimum": MIN, "maximum": MAX, "pow": POW}
FUNCTIONS = (*_ONE, *_TWO, "where", "clip")
"""Functions that an equation may call."""
_OF_NUMPY = {name: getattr(np, name, None) for name in (*_ONE, *_TWO, "square")}
NUMPY_FUNCTIONS = (
    *(name for name, f in _OF_NUMPY.items() if isinstance(f, np.ufunc) and f.__name__ in (name, "absolute")),
    *("where", "clip"),
)
"""Functions of numpy that a Python function may call on states, inputs and parameters."""
MOST_OPERATIONS = 2000


class EquationError(ValueError):
    """Is raised for an equation that cannot be used. The message names the equation and the cause."""


class Program(NamedTuple):
    """``operations`` (k, 5): code, result, three arguments, all registers. ``registers``: their first values, constants
    in place; the variables come first, in the order given. ``results``: registers of the results.
    """

    operations: NDArray[np.int64]
    registers: Array
    results: NDArray[np.int64]


@dataclass
class Builder:
    """Collects operations; equal ones are done once. ``names``: the variables, in the order of their registers."""

    names: tuple[str, ...]
    operations: list[tuple[int, int, int, int, int]] = field(default_factory=list[tuple[int, int, int, int, int]])
    values: list[float] = field(default_factory=list[float])
    known: dict[object, int] = field(default_factory=dict[object, int])

    def __post_init__(self) -> None:
        self.values = [0.0] * len(self.names)

    def constant(self, value: float) -> int:
        """The register of a number."""
        if not math.isfinite(value):
            raise EquationError(f"the number {value} is not finite")
        return self._register(("constant", value), value)

    def operation(self, code: int, a: int, b: int = 0, c: int = 0) -> int:
        """The register of a result."""
        key = (code, a, b, c)
        if key in self.known:
            return self.known[key]
        if len(self.operations) >= MOST_OPERATIONS:
            raise EquationError(f"more than {MOST_OPERATIONS} operations; use an FMU for a model of that size")
        result = self._register(key, 0.0)
        self.operations.append((code, result, a, b, c))
        return result

    def _register(self, key: object, value: float) -> int:
        if key not in self.known:
            self.known[key] = len(self.values)
            self.values.append(value)
        return self.known[key]

    def program(self, results: Sequence[int]) -> Program:
        """Return everything collected so far, as arrays."""
        operations = np.array(self.operations, np.int64).reshape(-1, 5)
        return Program(operations, np.array(self.values, np.float64), np.array(results, np.int64))


def called(builder: Builder, name: str, args: Sequence[int], where: str) -> int:
    """The register of a function's result. Raises EquationError."""
    if name in _ONE and len(args) == 1:
        return builder.operation(_ONE[name], args[0])
    if name in _TWO and len(args) == 2:
        return builder.operation(_TWO[name], args[0], args[1])
    if name == "where" and len(args) == 3:
        return builder.operation(PICK, args[0], args[1], args[2])
    if name == "clip" and len(args) == 3:
        return builder.operation(MIN, builder.operation(MAX, args[0], args[1]), args[2])
    raise EquationError(
        f"equation of '{where}': {name}() with {len(args)} arguments is unknown; known: {', '.join(FUNCTIONS)}"
    )


class Traced:
    """A number that is not known yet: what is done with it is written down."""

    __slots__ = ("builder", "register")
    __array_priority__ = 1000

    def __init__(self, builder: Builder, register: int) -> None:
        self.builder, self.register = builder, register

    def _with(self, code: int, other: object, turned: bool = False) -> Traced:
        a, b = self.register, register_of(self.builder, other)
        return Traced(
            self.builder, self.builder.operation(code, b, a) if turned else self.builder.operation(code, a, b)
        )

    def __add__(self, other: object) -> Traced:
        return self._with(ADD, other)

    def __radd__(self, other: object) -> Traced:
        return self._with(ADD, other, True)

    def __sub__(self, other: object) -> Traced:
        return self._with(SUB, other)

    def __rsub__(self, other: object) -> Traced:
        return self._with(SUB, other, True)

    def __mul__(self, other: object) -> Traced:
        return self._with(MUL, other)

    def __rmul__(self, other: object) -> Traced:
        return self._with(MUL, other, True)

    def __truediv__(self, other: object) -> Traced:
        return self._with(DIV, other)

    def __rtruediv__(self, other: object) -> Traced:
        return self._with(DIV, other, True)

    def __pow__(self, other: object) -> Traced:
        return self._with(POW, other)

    def __rpow__(self, other: object) -> Traced:
        return self._with(POW, other, True)

    def __neg__(self) -> Traced:
        return Traced(self.builder, self.builder.operation(NEG, self.register))

    def __pos__(self) -> Traced:
        return self

    def __abs__(self) -> Traced:
        return Traced(self.builder, self.builder.operation(ABS, self.register))

    def __lt__(self, other: object) -> Traced:
        return self._with(LESS, other)

    def __gt__(self, other: object) -> Traced:
        return self._with(LESS, other, True)

    def __le__(self, other: object) -> Traced:
        return self._with(LEQ, other)

    def __ge__(self, other: object) -> Traced:
        return self._with(LEQ, other, True)

    def __bool__(self) -> bool:
        raise EquationError(
            "a branch depends on a state, an input or a parameter; write it with numpy.where, and max and min as"
            " numpy.maximum and numpy.minimum"
        )

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: object, **options: object) -> Traced:
        known = _UFUNCS.get(ufunc.__name__)
        if method != "__call__" or options or known is None:
            raise EquationError(f"numpy.{ufunc.__name__} is unknown here; known: {', '.join(NUMPY_FUNCTIONS)}")
        code, turned = known
        args = [register_of(self.builder, x) for x in inputs]
        if turned:
            args.reverse()
        if ufunc.__name__ == "square":
            args = [args[0], args[0]]
        return Traced(self.builder, self.builder.operation(code, *args))

    def __array_function__(self, function: Any, types: object, args: Sequence[object], options: object) -> Traced:
        if options or function.__name__ not in ("where", "clip"):
            raise EquationError(f"numpy.{function.__name__} is unknown here; known: {', '.join(NUMPY_FUNCTIONS)}")
        registers = [register_of(self.builder, x) for x in args]
        return Traced(self.builder, called(self.builder, function.__name__, registers, "derivatives"))


_UFUNCS: Mapping[str, tuple[int, bool]] = {
    **{name: (code, False) for name, code in (*_ONE.items(), *_TWO.items())},
    "add": (ADD, False), "subtract": (SUB, False), "multiply": (MUL, False), "divide": (DIV, False),
    "power": (POW, False), "float_power": (POW, False), "negative": (NEG, False), "less": (LESS, False),
    "less_equal": (LEQ, False), "greater": (LESS, True), "greater_equal": (LEQ, True), "square": (MUL, False),
}  # fmt: skip


def register_of(builder: Builder, value: object) -> int:
    """The register of a traced value or of a plain number."""
    if isinstance(value, Traced):
        return value.register
    try:
        return builder.constant(float(cast(Any, value)))
    except (TypeError, ValueError):
        raise EquationError(f"{value!r} is no number") from None


def trace(builder: Builder, function: Callable[..., object], groups: Mapping[str, Sequence[str]]) -> dict[str, int]:
    """Registers of what ``function(t, states, inputs, parameters)`` returns by name, by calling it once with numbers
    that are not known yet. ``groups``: names of the states, inputs and parameters. Raises EquationError where the
    function does what no equation can (branches on a value, loops until something is reached, other libraries).
    """
    at = {name: i for i, name in enumerate(builder.names)}
    parts = [{n: Traced(builder, at[n]) for n in groups[g]} for g in ("states", "inputs", "parameters")]
    try:
        found = function(Traced(builder, at["t"]), *parts)
    except EquationError:
        raise
    except KeyError as error:
        known = "; ".join(f"{g}: {', '.join(groups[g]) or 'none'}" for g in ("states", "inputs", "parameters"))
        raise EquationError(f"derivatives asks for {error}; each value has a name, and there are {known}") from error
    except Exception as error:
        if Traced.__name__ in str(error):  # math.sin, scipy, float(...): they need the number itself
            raise EquationError(
                f"derivatives cannot be written as equations ({error}); in place of math and scipy use numpy's"
                f" {', '.join(NUMPY_FUNCTIONS)}"
            ) from error
        raise EquationError(
            f"derivatives(t, states, inputs, parameters) cannot be written as equations ({error!r})"
        ) from error
    if not isinstance(found, Mapping):
        example = ", ".join(f"'{s}': ..." for s in groups["states"])
        raise EquationError(f"derivatives must return {{{example}}}, got {type(found).__name__}")
    return {str(k): register_of(builder, v) for k, v in found.items()}


def builder_of(
    names: tuple[str, ...], operations: Sequence[Sequence[int]], registers: Array, results: Mapping[str, int]
) -> tuple[Builder, dict[str, int]]:
    """Return the builder and results that another process sent. ValueError for operations that reach beyond the
    registers: the machine code does not check them again.
    """
    rows = np.array(operations, np.int64).reshape(-1, 5)
    found = {str(name): int(register) for name, register in results.items()}
    if len(rows) > MOST_OPERATIONS or registers.size > len(names) + 3 * MOST_OPERATIONS:
        raise ValueError("too many operations")
    every = np.concatenate([rows[:, 1:].ravel(), np.array(list(found.values()), np.int64)])
    if np.any(rows[:, 0] < ADD) or np.any(rows[:, 0] > PICK) or np.any(every < 0) or np.any(every >= registers.size):
        raise ValueError("an operation that does not exist, or beyond the registers")
    if np.any(rows[:, 1] < len(names)) or registers.size < len(names):
        raise ValueError("an operation that writes to a variable")
    builder = Builder(names)
    builder.operations = [(a, b, c, d, e) for a, b, c, d, e in rows.tolist()]
    # a number where a variable stands would become a constant of the machine code
    builder.values = [0.0] * len(names) + registers[len(names) :].tolist()
    return builder, found
